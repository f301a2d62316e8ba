"""`evsplat restore`: a capture with sharp pictures in place of the blurry ones."""

from pathlib import Path
from typing import Any

from tqdm import tqdm

import evsplat
from evsplat.capture import Policy, load_capture
from evsplat.capture.derive import derived_capture, training_frames_first
from evsplat.config import to_dict
from evsplat.errors import ConfigError
from evsplat.files import refuse_existing, try_target
from evsplat.restore.base import RESTORERS


def restore_capture(
    path: Path | str,
    out: Path | str,
    *,
    method: str = "edi",
    policy: Policy | None = None,
    **options: Any,
) -> Path:
    """Write a capture with restored pictures to ``out``, whole or not at all; gives ``out``.

    Everything but the pictures is that of the capture at ``path``. The pictures are sharp at
    mid-exposure, so their exposures shrink to one microsecond there; what was done, and the
    exposures as recorded, is in ``provenance.restored``. ``options`` are those of the restorer.

    Training frames are restored from what ``policy`` lets training see, so that nothing held out
    gets into them. Held-out frames, which no training opens, are restored after them from
    everything, but with what the restorer took from the training frames (thresholds).

    Raises:
        ConfigError: No restorer has that name.
        DataError: ``out`` exists, or the capture lacks what the restorer needs.
    """
    if method not in RESTORERS:
        raise ConfigError(f"no restorer is named {method!r}, expected {' or '.join(RESTORERS)}.")
    refuse_existing(Path(out))
    try_target(out)
    capture = load_capture(path)
    seen = capture.for_training(policy or Policy())
    restorer = RESTORERS[method](seen, **options)
    with derived_capture(capture, out, without=("image",)) as making:
        pictures = training_frames_first(capture, seen, restorer.restore)
        for frame, picture in tqdm(pictures, "restore", len(capture.frames), unit="frame"):
            making.set_picture(frame, "image", picture)
            making.entry(frame)["exposure_us"] = [frame.mid_us, frame.mid_us + 1]
        making.document["provenance"] = {
            **capture.provenance,
            "restored": {
                "from": capture.name,
                "with": restorer.name,
                "policy": to_dict(seen.policy),
                **restorer.provenance(),
                "recorded_exposure_us": {
                    frame.name: list(frame.exposure_us) for frame in capture.frames
                },
                "evsplat": evsplat.__version__,
            },
        }
    return Path(out)
