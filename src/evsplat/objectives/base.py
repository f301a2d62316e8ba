"""The base of objectives: they name times, and compare what was rendered there."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Generic, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.capture import Frame, TrainingCapture
from evsplat.devices import DeviceCache
from evsplat.models.drawing import Drawing
from evsplat.models.layers import Layers
from evsplat.models.model import Model
from evsplat.pictures import CodedPictures, Transfer

ModelType = TypeVar("ModelType", bound=Model)


@dataclass(frozen=True)
class Step(Generic[ModelType]):
    """One training step: renders of the union of all times that the objectives asked for."""

    capture: TrainingCapture
    model: ModelType
    frame: Frame
    """The drawn training frame."""
    times_us: tuple[int, ...]
    """Sorted and distinct; the order of the pictures below."""
    drawing: Drawing
    """The pictures and what they were drawn from."""
    nominal: float
    """Progress in nominal iterations (of 15,000)."""
    generator: torch.Generator
    """Randomness of the step; part of the checkpoint."""
    data: DeviceCache
    """Recorded data on the model's device."""

    @property
    def rgb(self) -> tuple[Float[Tensor, "H W 3"], ...]:
        """Rendered pictures, coded as the recorded ones are."""
        return self.drawing.rgb

    @property
    def semantic(self) -> tuple[Float[Tensor, "H W"], ...]:
        """The soft attribute composited with the colour's weights, in [0, 1]."""
        return self.drawing.semantic

    @property
    def layers(self) -> Layers:
        """The Gaussians in the world, as they were drawn."""
        return self.drawing.layers

    @property
    def transfer(self) -> Transfer:
        """The curve of the frame's camera, by which the pictures are coded."""
        return self.capture.transfer(self.frame)

    @cached_property
    def pictures(self) -> CodedPictures:
        """The rendered pictures, by their light."""
        return CodedPictures(self.rgb, self.transfer)

    def index(self, time_us: int) -> int:
        """Place of a time among the pictures."""
        return self.times_us.index(time_us)

    def observed(self, frame: Frame) -> Float[Tensor, "H W 3"]:
        """The recorded picture of a frame, on the model's device."""
        if frame.name not in self._observed:
            self._observed[frame.name] = self.data.get(*picture(self.capture, frame))
        return self._observed[frame.name]

    @cached_property
    def _observed(self) -> dict[str, Tensor]:
        return {}


def picture(capture: TrainingCapture, frame: Frame) -> tuple[Hashable, Callable[[], Tensor]]:
    """Key and source of a frame's recorded picture, as `DeviceCache` takes them."""
    return ("image", frame.name), partial(capture.image, frame)


class Objective:
    """A loss with one or several named terms, before weighting.

    By default it asks for no renders and remembers nothing between steps.
    """

    def times(self, frame: Frame, nominal: float) -> Sequence[int]:
        """Times, microseconds, whose renders the objective needs for a drawn frame."""
        return ()

    def prefetch(self, frame: Frame, nominal: float, data: DeviceCache) -> None:
        """Ask for the recorded data that the loss of a later step, of ``frame``, will need."""

    def loss(self, step: Step) -> dict[str, Tensor]:
        """Named scalar terms, unweighted; a term that does not apply is left out."""
        raise NotImplementedError

    def rows_changed(self) -> None:
        """Called after Gaussians were added, removed or moved between the classes."""

    def state(self) -> dict[str, Tensor]:
        """Values that a checkpoint must hold for a resume to repeat the same steps."""
        return {}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Take back what `state` gave."""


class OfMiddle(Objective):
    """Base of objectives that compare the middle of the drawn frame's exposure with its picture."""

    def __init__(self, capture: TrainingCapture) -> None:
        """Pictures are those of ``capture``."""
        self.capture = capture

    def times(self, frame: Frame, nominal: float) -> Sequence[int]:
        """The middle of the drawn frame's exposure."""
        return (frame.mid_us,)

    def prefetch(self, frame: Frame, nominal: float, data: DeviceCache) -> None:
        """The recorded picture."""
        data.prefetch(*picture(self.capture, frame))


class LookedUp(Objective):
    """Base of objectives that look a value up per Gaussian and keep it for some steps.

    ``refresh`` steps, or until densification: centres move slowly.
    """

    name: str
    """Name of the value in a checkpoint."""

    def __init__(self, *, refresh: int) -> None:
        """Nothing is looked up before the first step."""
        self.refresh, self.age = refresh, 0
        self.kept = torch.zeros(0, 0)

    def looked_up(self, find: Callable[[], Tensor], device: torch.device) -> Tensor:
        """What ``find`` gives or gave, in this step."""
        if self.age == 0 or self.age >= self.refresh:
            self.kept, self.age = find(), 0
        self.age += 1
        self.kept = self.kept.to(device)  # after a resume
        return self.kept

    def rows_changed(self) -> None:
        """Row numbers mean other Gaussians now."""
        self.age = 0

    def state(self) -> dict[str, Tensor]:
        """The value and how many steps ago it was looked up."""
        return {self.name: self.kept, "age": torch.tensor(self.age)}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Take back what `state` gave."""
        self.kept, self.age = state[self.name], int(state["age"])
