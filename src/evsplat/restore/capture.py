"""`evsplat restore`: a capture with sharp pictures in place of the blurry ones."""

from pathlib import Path
from typing import Any

from tqdm import tqdm

import evsplat
from evsplat.capture import load_capture
from evsplat.capture.derive import derived_capture
from evsplat.errors import ConfigError
from evsplat.restore.base import RESTORERS


def restore_capture(
    path: Path | str, out: Path | str, *, method: str = "edi", **options: Any
) -> Path:
    """Write a capture with restored pictures to ``out``, whole or not at all; gives ``out``.

    Everything but the pictures is that of the capture at ``path``. The pictures are sharp at
    mid-exposure, so their exposures shrink to one microsecond there; what was done, and the
    exposures as recorded, is in ``provenance.restored``. ``options`` are those of the restorer.

    Raises:
        ConfigError: No restorer has that name.
        DataError: ``out`` exists, or the capture lacks what the restorer needs.
    """
    if method not in RESTORERS:
        raise ConfigError(f"no restorer is named {method!r}, expected {' or '.join(RESTORERS)}.")
    capture = load_capture(path)
    restorer = RESTORERS[method](capture, **options)
    with derived_capture(capture, out, without=("image",)) as making:
        pictures = restorer.restore(capture)
        for frame, picture in tqdm(pictures, "restore", len(capture.frames), unit="frame"):
            making.set_picture(frame, "image", picture)
            making.entry(frame)["exposure_us"] = [frame.mid_us, frame.mid_us + 1]
        making.document["provenance"] = {
            **capture.provenance,
            "restored": {
                "from": capture.name,
                "with": restorer.name,
                **restorer.provenance(),
                "recorded_exposure_us": {
                    frame.name: list(frame.exposure_us) for frame in capture.frames
                },
                "evsplat": evsplat.__version__,
            },
        }
    return Path(out)
