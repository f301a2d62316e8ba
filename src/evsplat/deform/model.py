"""What a model of person and scene is to the training loop and to whoever draws it."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.body import BodyTrack
from evsplat.capture import Camera, Frame
from evsplat.deform.drawing import Drawing
from evsplat.deform.lamps import Lamps
from evsplat.deform.shadow import BodyShadow
from evsplat.gaussians import PosedGaussians, Rows


class RowCache(Protocol):
    """Values per Gaussian that are looked up now and then, and kept between steps."""

    def rows_changed(self) -> None:
        """Row numbers mean other Gaussians now."""
        ...

    def state(self) -> dict[str, Tensor]:
        """What a resume needs."""
        ...

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Take back what `state` gave."""
        ...


class Model(Protocol):
    """A torch module that poses Gaussians at any time and draws them."""

    nominal: Tensor
    """Progress in nominal iterations, part of the saved state."""
    track: BodyTrack
    """The recorded motion and its body."""

    @property
    def device(self) -> torch.device:
        """Where the Gaussians are."""

    @property
    def sets(self) -> Mapping[str, Rows]:
        """Sets of Gaussians by the name of the submodule that they are; no row in two of them."""

    @property
    def row_caches(self) -> Mapping[str, RowCache]:
        """What is kept per Gaussian between steps, by the name it has in a checkpoint."""

    @property
    def shadow(self) -> BodyShadow | None:
        """Shadow of the person on the scene, where a model knows one."""

    @property
    def lamps(self) -> Lamps | None:
        """Where the light comes from, where a model knows it."""

    @property
    def low_pass(self) -> float:
        """What a pixel integrates over, px^2; see `evsplat.render.render`."""

    def training_drawing(
        self,
        times_us: Sequence[int],
        frame: Frame,
        camera: Camera,
        generator: torch.Generator,
    ) -> Drawing:
        """Pictures of a training step of ``frame``, with gradients of the projected centres.

        Whatever a method perturbs in training is drawn from ``generator``.
        """
        ...

    def at(
        self, times_us: Sequence[int], camera_center: Float[Tensor, "3"], *, hard_semantics: bool
    ) -> PosedGaussians:
        """All Gaussians in world space, as a trained model shows them.

        ``hard_semantics`` puts the class itself into the semantic channel.
        """
        ...

    def following(self, track: BodyTrack) -> "Model":
        """A copy whose person does what ``track`` says (same body, own times).

        What was learned of single frames does not belong to another motion and is left out.
        """
        ...

    def state_dict(self) -> dict[str, Any]:
        """All that is learned, the rows of the sets among it."""
        ...

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> Any:
        """Take back what `state_dict` gave; the sets have as many rows already."""
        ...
