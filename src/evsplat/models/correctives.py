"""What poses do to a person beyond skinning, as linear correctives that a page can play."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int8
from torch import Tensor

COMPONENTS = 8
"""Most correctives; each costs four bytes per Gaussian."""
_OFFSET_WEIGHT = 30.0
"""Of a metre beside a brightness of 1: a centimetre counts as much as a third of the colour."""
_RIDGE = 0.03
"""Of the regression, relative to the mean square of the poses: joints turn together in a motion."""
_REACH = 0.5
"""Norm of what exceeds the range at which 1/e is left; a joint 30 degrees beyond: 0.7."""
_STEPS = 127


@dataclass(frozen=True, eq=False)
class Correctives:
    """K fields over H Gaussians whose shares are linear in the rotations of the J joints.

    Pose correctives of SMPL (Loper et al. 2015, eq. 9) in few components: the features of a pose
    are the entries of ``R_j - I``, row after row, the root's among them because lamps do not turn
    with the person. Features and shares are kept inside the range of the baked poses, and the
    further the features lie outside, the less of the fields is left: a fit tells nothing of poses
    far from all that it has seen.
    """

    low: Float[Tensor, " F"]
    """Least of each feature among the baked poses; F = 9 J."""
    high: Float[Tensor, " F"]
    linear: Float[Tensor, "F K"]
    constant: Float[Tensor, " K"]
    least: Float[Tensor, " K"]
    """Least share among the baked poses."""
    most: Float[Tensor, " K"]
    values: Int8[Tensor, "K H 4"]
    reach: float
    """Norm of the excess of the features at which 1/e is left."""
    steps: Float[Tensor, "K 4"]
    """Size of one step of ``values``: metres, metres, metres, brightness."""

    def shares(self, rotations: Float[Tensor, "T J 3 3"]) -> Float[Tensor, "T K"]:
        """How much of each field a pose, rotations against the parents, calls for."""
        given = _features(rotations)
        features = given.clamp(self.low, self.high)
        shares = (features @ self.linear + self.constant).clamp(self.least, self.most)
        excess = (given - features).square().sum(-1, keepdim=True)
        return shares * (-excess / self.reach**2).exp()

    def at(
        self, rotations: Float[Tensor, "T J 3 3"]
    ) -> tuple[Float[Tensor, "T H 3"], Float[Tensor, "T H 1"]]:
        """Offsets of canonical centres, metres, and factors (at least 0) on the colours."""
        fields = self.values.float() * self.steps[:, None]
        changes = torch.einsum("tk,khc->thc", self.shares(rotations), fields)
        return changes[..., :3], (1 + changes[..., 3:]).clamp_min(0)


def _features(rotations: Float[Tensor, "T J 3 3"]) -> Float[Tensor, "T F"]:
    return (rotations - torch.eye(3)).flatten(1)


def bake_correctives(
    changes: Float[Tensor, "T H 4"], rotations: Float[Tensor, "T J 3 3"]
) -> Correctives:
    """Fields that show ``changes`` at the poses best, and their regression.

    A change is an offset of the centre, canonical metres, and a relative brightness.

    The fields are the principal components about zero, the shares a ridge regression on the
    features: in as many unknowns as there are poses, by the kernel of the features.
    """
    weight = changes.new_tensor([_OFFSET_WEIGHT] * 3 + [1.0])
    weighted = (changes * weight).flatten(1).double()
    # By the small matrix of the T poses: H is in the thousands.
    vectors = torch.linalg.eigh(weighted @ weighted.T).eigenvectors
    kept = vectors[:, -min(COMPONENTS, len(changes)) :].flip(1)
    fields = (kept.T @ weighted).unflatten(1, changes.shape[1:]) / weight.double()

    features = _features(rotations).double()
    middle, mean = features.mean(0), kept.mean(0)
    spread = features - middle
    kernel = spread @ spread.T
    ridge = _RIDGE * float(kernel.diagonal().mean()) + 1e-12
    solved = torch.linalg.solve(kernel + ridge * torch.eye(len(kernel)).double(), kept - mean)
    linear = spread.T @ solved

    steps = fields.abs().amax(1).clamp_min(1e-12) / _STEPS
    return Correctives(
        low=features.amin(0).float(),
        high=features.amax(0).float(),
        linear=linear.float(),
        constant=(mean - middle @ linear).float(),
        least=kept.amin(0).float(),
        most=kept.amax(0).float(),
        reach=_REACH,
        values=(fields / steps[:, None]).round().to(torch.int8),
        steps=steps.float(),
    )
