"""What moves in a recording, in coarse maps: events, and differences to the background."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32
from tqdm import tqdm

from evsplat.capture import Frame, TrainingCapture
from evsplat.errors import DataError
from evsplat.events import EventStore, EventStream, polarity_counts
from evsplat.inspection.figure import Coarse
from evsplat.pictures import shown
from evsplat.spread import evenly_spread

MOST_FRAMES = 32
EVENT_REACH_US = 10_000
"""Events so long before and after mid-exposure count: longer, and fast limbs smear."""
CHANGED = 0.15
"""Difference to the background, in coded values, that counts in full."""
_FEWEST_FOR_BACKGROUND = 3
_FEWEST_EVENTS = 100
"""Of all frames looked at: fewer lie where chance puts them, and fit somewhere else as well as
where the person is."""


def looked_at(capture: TrainingCapture) -> tuple[Frame, ...]:
    """At most `MOST_FRAMES` training frames of one camera, evenly spread."""
    if not capture.train_frames:
        raise DataError(
            f"{capture.path / 'capture.json'}: has no frame of split 'train', expected at least "
            "one; change the split, or train with --use everything."
        )
    name = capture.train_frames[0].camera
    frames = [frame for frame in capture.train_frames if frame.camera == name]
    return tuple(evenly_spread(frames, MOST_FRAMES))


def stands(frames: Sequence[Frame]) -> bool:
    """True where the camera of the frames does not move."""
    return all(frame.world_to_camera is None for frame in frames)


def movement(
    capture: TrainingCapture,
    frames: Sequence[Frame],
    coarse: Coarse,
    pictures: Float32[np.ndarray, "K 3 h w"] | None,
) -> dict[str, Float32[np.ndarray, "K h w"]]:
    """What moves about the mid-exposure of each frame, per map pixel, 0 or more.

    "events": how many there are; "frames": difference to the median of the ``pictures``
    (`small_pictures`), 1 at most. What the capture lacks is left out, as are differences where the
    camera moves, which has no ``pictures``, a handful of events, and what is the same everywhere.
    """
    found = {}
    if pictures is not None:
        found["frames"] = _differences(pictures)
    # events are of the first frame's camera
    if capture.events is not None and frames[0].camera == capture.frames[0].camera:
        counts = _event_counts(capture, frames, coarse)
        if counts.sum() >= _FEWEST_EVENTS:
            found["events"] = counts
    return {name: maps for name, maps in found.items() if np.ptp(maps, axis=(1, 2)).any()}


def event_window(events: EventStore, frame: Frame) -> EventStream:
    """Events within `EVENT_REACH_US` of mid-exposure, as far as they may be read."""
    start, end = events.readable_around(frame.mid_us)
    first, last = frame.mid_us - EVENT_REACH_US, frame.mid_us + EVENT_REACH_US
    return events.between(max(start, first), min(end, last))


def small_pictures(
    capture: TrainingCapture, frames: Sequence[Frame], coarse: Coarse
) -> Float32[np.ndarray, "K 3 h w"]:
    """The frames' values in maps, coded also where the camera stores light as it stands."""
    small = []
    for frame in tqdm(frames, "pictures", unit="picture", leave=False, disable=None):
        # light as it stands makes other limits of what a shadow is
        channels = shown(capture.image(frame), capture.transfer(frame)).unbind(-1)
        small.append(np.stack([coarse.shrunk(channel) for channel in channels]))
    return np.stack(small)


def _differences(pictures: Float32[np.ndarray, "K 3 h w"]) -> Float32[np.ndarray, "K h w"]:
    if len(pictures) < _FEWEST_FOR_BACKGROUND:
        return np.zeros_like(pictures[:, 0])
    differences = np.abs(pictures - np.median(pictures, axis=0)).max(axis=1)
    return np.minimum(differences / CHANGED, 1).astype(np.float32)


def _event_counts(
    capture: TrainingCapture, frames: Sequence[Frame], coarse: Coarse
) -> Float32[np.ndarray, "K h w"]:
    events, maps = capture.events, []
    assert events is not None
    for frame in frames:
        camera = capture.camera(frame)
        stream = event_window(events, frame)
        counts = polarity_counts(stream, camera.height, camera.width).sum(0)
        maps.append(coarse.shrunk(counts) * coarse.pixel**2)
    return np.stack(maps)
