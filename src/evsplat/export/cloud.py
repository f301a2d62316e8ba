"""Gaussians as files hold them: centre, rotation, scale, opacity and one colour each."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from evsplat.body.rotations import matrix_to_quaternion, quaternion_multiply, quaternion_to_matrix
from evsplat.errors import DataError
from evsplat.pictures import Transfer, shown
from evsplat.render import Splats

CHANNELS = 4
"""Channels of exported splats: R, G, B, semantic attribute."""


@dataclass(frozen=True, eq=False)
class SplatCloud:
    """N Gaussians with one colour each, in the axes of the file."""

    means: Float32[np.ndarray, "N 3"]
    """Centres, metres."""
    quaternions: Float32[np.ndarray, "N 4"]
    """Unit, (w, x, y, z), w >= 0."""
    scales: Float32[np.ndarray, "N 3"]
    """Standard deviations along the rotated axes, metres, above 0."""
    opacities: Float32[np.ndarray, " N"]
    """Opacity of the Gaussian's centre, in [0, 1]."""
    rgb: Float32[np.ndarray, "N 3"]
    """sRGB; mostly in [0, 1], not clamped."""
    semantic: Float32[np.ndarray, " N"]
    """1 = person, 0 = scene."""
    seen: Float32[np.ndarray, " N"]
    """How certain training was of the person, 0 to 1; 1 where nothing tells, and of the scene."""

    def __len__(self) -> int:
        """Number of Gaussians."""
        return len(self.means)

    def rotated(self, rotation: Float[np.ndarray, "3 3"]) -> "SplatCloud":
        """The same Gaussians in turned axes: ``rotation`` maps old coordinates to new ones."""
        turn = torch.from_numpy(np.asarray(rotation, dtype=np.float64))
        quaternions = quaternion_multiply(
            matrix_to_quaternion(turn), torch.from_numpy(self.quaternions).double()
        )
        means = self.means.astype(np.float64) @ turn.numpy().T
        return replace(self, means=_float32(means), quaternions=_positive(quaternions))

    def shown(self, transfer: Transfer) -> "SplatCloud":
        """The same Gaussians with colours coded as sRGB where they were light."""
        rgb = shown(torch.from_numpy(self.rgb), transfer)
        return replace(self, rgb=_float32(rgb))


def cloud_of(splats: Splats, time: int = 0, seen: Float[Tensor, " N"] | None = None) -> SplatCloud:
    """One time of drawn Gaussians; ``channels`` are R, G, B and the semantic attribute.

    Skinning shears a Gaussian: its covariance is ``(L R S)(L R S)^T`` with any matrix L. The
    singular value decomposition ``L R S = U s V^T`` gives the rotation U and the scales s of the
    same covariance, without loss. Gaussians that are not finite are left out, as when drawing.
    """
    splats = splats.with_times()
    if splats.channels.shape[-1] != CHANNELS:
        raise DataError(
            f"Gaussians have {splats.channels.shape[-1]} channels, expected R, G, B, semantic."
        )

    def at(values: Tensor) -> Tensor:
        return values[min(time, len(values) - 1)].detach().cpu().double()

    quaternions, scales = at(splats.quaternions), at(splats.scales).abs()
    if splats.linear is not None:
        axes = at(splats.linear) @ quaternion_to_matrix(quaternions) * scales[:, None, :]
        turned, lengths = principal_axes(torch.nan_to_num(axes))
        quaternions, scales = torch.from_numpy(turned), torch.from_numpy(lengths)
    channels = at(splats.channels)
    cloud = SplatCloud(
        means=_float32(at(splats.means)),
        quaternions=_positive(quaternions),
        scales=_float32(scales),
        opacities=_float32(at(splats.opacities)),
        rgb=_float32(channels[:, :3]),
        semantic=_float32(channels[:, 3]),
        seen=_float32(torch.ones_like(channels[:, 3]) if seen is None else seen.cpu()),
    )
    values = (cloud.means, cloud.quaternions, cloud.scales, cloud.opacities[:, None], cloud.rgb)
    good = np.isfinite(np.concatenate(values, axis=1)).all(1) & (cloud.scales > 0).all(1)
    return SplatCloud(*(column[good] for column in vars(cloud).values()))


def principal_axes(
    axes: Float[Tensor, "N 3 3"],
) -> tuple[Float32[np.ndarray, "N 4"], Float32[np.ndarray, "N 3"]]:
    """Quaternions (w >= 0) and scales of the covariance ``axes axes^T`` of any matrix."""
    turned, scales, _ = torch.linalg.svd(axes)
    # A reflection of the axes leaves the covariance as it is, but is no rotation.
    turned[..., 2] *= torch.linalg.det(turned)[:, None].sign()
    return _positive(matrix_to_quaternion(turned)), _float32(scales)


def joined(clouds: list[SplatCloud]) -> SplatCloud:
    """All Gaussians of several clouds, in their order."""
    columns = zip(*(vars(cloud).values() for cloud in clouds), strict=True)
    return SplatCloud(*map(np.concatenate, columns))


def _positive(quaternions: Tensor) -> Float32[np.ndarray, "N 4"]:
    unit = torch.nn.functional.normalize(quaternions, dim=-1)
    return _float32(torch.where(unit[:, :1] < 0, -unit, unit))


def _float32(values: Tensor | np.ndarray) -> Float32[np.ndarray, "..."]:
    return np.asarray(values, dtype=np.float32)
