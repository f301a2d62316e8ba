"""The recorded event map between two frames beside the one that the reconstruction explains."""

from typing import Any

from jaxtyping import Float
from torch import Tensor

from evsplat.capture import Capture, Frame
from evsplat.evaluation.drawn import DrawnFrames, KeepPicture
from evsplat.evaluation.regions import Absent
from evsplat.events import count_map
from evsplat.names import file_stem
from evsplat.pictures import signed_map
from evsplat.pictures.light import log_brightness_change

_TRAIN_PAIRS_SHOWN = 3


def evaluate_event_maps(
    capture: Capture, frames: DrawnFrames, keep: KeepPicture
) -> dict[str, Any] | Absent:
    """Similarity and pictures of frame pairs: one per test frame and a few training pairs.

    Events between training frames are input of the training, those around test frames only where
    the policy shows them; the rendered maps show whether the reconstruction, as it draws
    ``frames``, explains them.
    """
    absent = _missing_input(capture)
    if absent is not None:
        return absent
    chosen = chosen_pairs(capture)
    if not chosen:
        return Absent("they are of two frames of one camera, of which no camera has two")
    pairs: list[dict[str, Any]] = []
    for before, after in chosen:
        given, rendered = _maps(capture, frames, before, after)
        stem = file_stem("events", before.name, after.name)
        # The brightest percent would make the rest invisible; both maps get the same scale.
        busy = given[given != 0].abs()
        scale = max(1.0, float(busy.quantile(0.95))) if len(busy) else 1.0
        paths = {}
        for kind, values in (("given", given), ("rendered", rendered)):
            paths[kind] = f"pictures/{stem}_{kind}.png"
            keep(paths[kind], signed_map(values, scale))
        norms = given.norm() * rendered.norm()
        pairs.append(
            {
                "frames": [before.name, after.name],
                # Of the test where one of the two frames was held out.
                "split": "test" if "test" in (before.split, after.split) else "train",
                # Cosine of the two maps as vectors.
                "similarity": float((given * rendered).sum() / norms) if norms > 0 else None,
                "full_scale": scale,
                "pictures": paths,
            }
        )
    return {
        "threshold_known": capture.contrast_threshold is not None,
        "mean_similarity": {split: _mean_similarity(pairs, split) for split in ("test", "train")},
        "pairs": pairs,
    }


def _missing_input(capture: Capture) -> Absent | None:
    """The reason why the capture has no event maps to compare, if there is one."""
    if capture.events is None:
        return Absent("the capture has no events")
    if not capture.events.has_polarity:
        return Absent("the events have no polarity")
    for camera in {frame.camera for frame in capture.frames}:
        size = (capture.cameras[camera].width, capture.cameras[camera].height)
        if size != (capture.events.width, capture.events.height):
            return Absent(f"camera {camera!r} and the event sensor differ in resolution")
    return None


def _maps(
    capture: Capture, frames: DrawnFrames, before: Frame, after: Frame
) -> tuple[Float[Tensor, "H W"], Float[Tensor, "H W"]]:
    """Events per pixel, with their sign, between two mid-exposures: recorded and rendered.

    Rendered is the change of log brightness over the contrast threshold.
    """
    assert capture.events is not None
    stream = capture.events.between(before.mid_us, after.mid_us)
    given = count_map(stream, capture.events.height, capture.events.width)
    first, second = (frames(frame).clamp(0, 1) for frame in (before, after))
    change = log_brightness_change(first, second, transfer=capture.transfer(before)).float()
    return given, change / _threshold(capture, given, change)


def chosen_pairs(capture: Capture) -> list[tuple[Frame, Frame]]:
    """Consecutive frames of one camera: each test frame with the one before, some training pairs.

    A first frame that is a test frame is paired with the one after.
    """
    test: list[tuple[Frame, Frame]] = []
    train: list[tuple[Frame, Frame]] = []
    for camera in dict.fromkeys(frame.camera for frame in capture.frames):
        frames = sorted(
            (frame for frame in capture.frames if frame.camera == camera),
            key=lambda frame: frame.mid_us,
        )
        for index, (before, after) in enumerate(zip(frames, frames[1:], strict=False)):
            first = index == 0 and before.split == "test"
            if after.split == "test" or first:
                test.append((before, after))
            elif before.split == "train":
                train.append((before, after))
    step = max(1, len(train) // _TRAIN_PAIRS_SHOWN)
    return test + train[step // 2 :: step][:_TRAIN_PAIRS_SHOWN]


def _threshold(capture: Capture, given: Tensor, change: Tensor) -> float:
    """Contrast threshold; where it is unknown, the one that makes both maps equally strong."""
    if capture.contrast_threshold is not None:
        return sum(capture.contrast_threshold) / 2
    return float(change.norm() / given.norm().clamp_min(1e-12)) or 1.0


def _mean_similarity(pairs: list[dict[str, Any]], split: str) -> float | None:
    values = [p["similarity"] for p in pairs if p["split"] == split and p["similarity"] is not None]
    return sum(values) / len(values) if values else None
