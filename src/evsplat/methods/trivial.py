"""Rows that need no reconstruction: what any method must beat; and a person before one of them."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.camera import Camera
from evsplat.capture import Frame, TrainingCapture
from evsplat.errors import DataError
from evsplat.methods.reconstruction import Parts, Reconstruction, Rendering


class MedianBackground:
    """The scene without the person: per-pixel temporal median of the training frames."""

    name = "median_background"

    def __init__(self, capture: TrainingCapture) -> None:
        if not capture.is_static_camera:
            raise DataError(
                f"{capture.path}: the camera moves, so that a pixel's median over time means "
                "nothing."
            )
        self._image = capture.median_background()
        self._camera = capture.camera(capture.frames[0])

    def render(self, camera: Camera, times_us: Sequence[int], *, parts: Parts = "all") -> Rendering:
        """The same picture at any time; only for the camera that recorded the capture."""
        if not same_view(camera, self._camera):
            raise DataError("median_background draws the recording camera only, not another one.")
        return _flat_rendering([self._image] * len(times_us), parts)


class OnMedianBackground:
    """A human-only reconstruction composited over the temporal median of the training frames.

    What the method shows of the person is neither helped nor hurt by a black surround then. Only
    for one camera that stands still, and for the view that it recorded; else a `DataError`.
    """

    def __init__(self, person: Reconstruction, capture: TrainingCapture) -> None:
        self._person, self._background = person, MedianBackground(capture)

    @property
    def name(self) -> str:
        """Name of the method, and that it stands before the median."""
        return f"{self._person.name} on median background"

    def render(self, camera: Camera, times_us: Sequence[int], *, parts: Parts = "all") -> Rendering:
        """See `Reconstruction`; the background shines through where the person is not opaque."""
        person = self._person.render(camera, times_us, parts=parts)
        if parts == "human":
            return person
        behind = self._background.render(camera, times_us)
        if parts == "scene":
            return behind
        through = (1 - person.alpha)[..., None]
        return replace(behind, rgb=person.rgb + through * behind.rgb, human=person.human)


class NearestFrame:
    """The blurry training frame nearest in time; of two equally near ones the earlier."""

    name = "nearest_frame"

    def __init__(self, capture: TrainingCapture) -> None:
        if not capture.train_frames:
            raise DataError(f"{capture.path}: no frame has split 'train'.")
        self._capture = capture

    def render(self, camera: Camera, times_us: Sequence[int], *, parts: Parts = "all") -> Rendering:
        """Frames of the same view where there are any (several cameras), else of the same size."""
        capture = self._capture
        seen = [(frame, capture.camera(frame)) for frame in capture.train_frames]
        frames = [frame for frame, view in seen if same_view(camera, view)] or [
            frame
            for frame, view in seen
            if (view.width, view.height) == (camera.width, camera.height)
        ]
        if not frames:
            raise DataError(
                f"nearest_frame: no training frame has {camera.width}x{camera.height} pixels."
            )
        nearest = [nearest_in_time(frames, time) for time in times_us]
        return _flat_rendering([capture.image(frame) for frame in nearest], parts)


TRIVIAL: dict[str, Callable[[TrainingCapture], Reconstruction]] = {
    kind.name: kind for kind in (MedianBackground, NearestFrame)
}
"""Rows that need no training, by name."""


def nearest_in_time(frames: Sequence[Frame], time_us: int) -> Frame:
    """Frame with mid-exposure nearest to ``time_us``; the earlier of two equally near ones."""
    return min(frames, key=lambda frame: (abs(frame.mid_us - time_us), frame.mid_us))


def same_view(first: Camera, second: Camera) -> bool:
    """Whether two cameras take the same picture: equal size, intrinsics and pose."""
    return (first.width, first.height) == (second.width, second.height) and all(
        torch.equal(a.cpu(), b.cpu())
        for a, b in (
            (first.K, second.K),
            (first.world_to_camera, second.world_to_camera),
        )
    )


def _flat_rendering(images: Sequence[Float[Tensor, "H W 3"]], parts: Parts) -> Rendering:
    """Pictures in which nothing is known to be the person."""
    rgb = torch.stack(list(images))
    alpha = torch.ones(rgb.shape[:3], dtype=rgb.dtype)
    human = torch.zeros_like(alpha)
    if parts == "human":
        return Rendering(torch.zeros_like(rgb), human, human)
    return Rendering(rgb, alpha, human)
