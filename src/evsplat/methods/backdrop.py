"""A person without a scene, put before the recording's own background."""

from collections.abc import Sequence
from dataclasses import replace

from evsplat.capture import Camera, TrainingCapture
from evsplat.methods.reconstruction import Parts, Reconstruction, Rendering
from evsplat.methods.trivial import MedianBackground


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
