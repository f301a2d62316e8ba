"""Contract of a model of person and scene, and the base of those that follow a body track."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Protocol

import torch
from jaxtyping import Float
from torch import Tensor, nn

from evsplat.body import BodyTrack
from evsplat.body.rotations import axis_angle_to_matrix
from evsplat.capture import Camera, Frame
from evsplat.gaussians import Rows
from evsplat.models.drawing import Drawing
from evsplat.models.layers import Layers


class RowCache(Protocol):
    """Values per Gaussian that are looked up now and then, and kept between steps."""

    def rows_changed(self) -> None:
        """Row numbers mean other Gaussians now."""
        ...

    def state(self) -> dict[str, Tensor]:
        """Tensors that a resume needs."""
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
        """Device of the Gaussians."""

    @property
    def sets(self) -> Mapping[str, Rows]:
        """Sets of Gaussians by the name of the submodule that they are; no row in two of them."""

    @property
    def row_caches(self) -> Mapping[str, RowCache]:
        """Values kept per Gaussian between steps, by the name they have in a checkpoint."""

    @property
    def low_pass(self) -> float:
        """Variance of the filter of a pixel, px^2; see `evsplat.render.render`."""

    @property
    def depends_on_view(self) -> bool:
        """Whether what `at` gives depends on where the camera is."""

    def training_drawing(
        self,
        times_us: Sequence[int],
        frame: Frame,
        cameras: Sequence[Camera],
        generator: torch.Generator,
    ) -> Drawing:
        """Pictures of a training step of ``frame``, with gradients of the projected centres.

        ``cameras``: one per time; the same object at all times where it stands still.
        Whatever a method perturbs in training is drawn from ``generator``.
        """
        ...

    def at(
        self, times_us: Sequence[int], camera_center: Float[Tensor, "3"], *, hard_semantics: bool
    ) -> Layers:
        """All Gaussians in world space, as a trained model shows them.

        ``hard_semantics`` puts the class itself into the semantic channel.
        """
        ...

    def following(self, track: BodyTrack) -> "Model":
        """A copy whose person does what ``track`` says (same body, own times).

        What was learned of single frames does not belong to another motion and is left out.
        """
        ...

    def parameters(self) -> Iterator[Tensor]:
        """All that is learned."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """All that is learned, the rows of the sets among it."""
        ...

    def requires_grad_(self, requires_grad: bool = True) -> Any:
        """Whether anything of it is learned from now on; what follows from the rest is kept."""
        ...

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> Any:
        """Take back what `state_dict` gave; the sets have as many rows already."""
        ...


def nearest_time(times_us: Sequence[int], frame: Frame) -> int:
    """Index of the time that is nearest to the middle of a frame's exposure."""
    return min(range(len(times_us)), key=lambda index: abs(times_us[index] - frame.mid_us))


class PoseResidual(Protocol):
    """Learned errors of a track's poses."""

    def residual(self, times_us: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Axis-angle vectors (T, J, 3), radians, and shifts of the root (T, 3), metres."""
        ...

    def forget(self) -> None:
        """Set all residuals to zero."""
        ...


class PosedModel(nn.Module):
    """Base of models whose person follows a body track, with learned pose residuals or none.

    ``nominal`` stays on the host, which reads it, when the module moves to another device.
    """

    nominal: Tensor

    def __init__(self, track: BodyTrack) -> None:
        """``track``: the recorded motion; moves along with the module."""
        super().__init__()
        self.track = track
        self.residual: PoseResidual | None = None
        self.residual_start = 0.0
        """Nominal iteration from which the residual is learned and applied."""
        self.register_buffer("nominal", torch.zeros((), dtype=torch.float64))
        self.register_buffer("_place", torch.zeros(0), persistent=False)

    def _apply(self, fn: Any, recurse: bool = True) -> "PosedModel":
        nominal = self.nominal
        super()._apply(fn, recurse)
        self.nominal = nominal
        self.track = self.track.to(self.device)
        return self

    @property
    def device(self) -> torch.device:
        """Device of the Gaussians."""
        return self.get_buffer("_place").device

    @property
    def residual_active(self) -> bool:
        """Whether training has reached the start of the pose residual."""
        return self.residual is not None and float(self.nominal) >= self.residual_start

    @property
    def depends_on_view(self) -> bool:
        """True, as colours are a network's that sees the direction."""
        return True

    def stay_together(self) -> None:
        """Nothing; for models whose weights are tied to single points of the surface."""

    def pose(self, times_us: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Local rotations (T, J, 3, 3) and bone transforms canonical to world (T, J, 4, 4)."""
        rotations, translation = self.track.at(torch.as_tensor(times_us))
        if self.residual is not None and self.residual_active:
            turn, shift = self.residual.residual(times_us)
            # From the right: about the joint's own axes, before its parents turn it.
            rotations = rotations @ axis_angle_to_matrix(turn)
            translation = translation + shift
        return rotations, self.track.body.canonical_to_world(rotations, translation)
