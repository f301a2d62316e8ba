"""How people hold their limbs: a Gaussian over the turns of a rig's rows, from shipped motions."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.errors import DataError
from evsplat.posing.rig import ROWS
from evsplat.untrusted.arrays import read_plain_npz

_FLOOR_RAD = 0.12
"""Spread of every direction that no motion shows: mocap of few people leaves out much."""


@dataclass(frozen=True, eq=False)
class PosePrior:
    """Mean and inverse covariance of the rows' vectors, radians; D = 3 x rows."""

    mean: Float[Tensor, "D"]
    precision: Float[Tensor, "D D"]
    lowest: dict[str, float]
    """Least bend of knees and elbows about their hinge (`HINGES`), radians, by row."""


HINGES = {
    **{"left_shin": (1.0, 0.0, 0.0), "right_shin": (1.0, 0.0, 0.0)},
    **{"left_forearm": (-0.7, 0.0, -0.7), "right_forearm": (-0.7, 0.0, 0.7)},
}
"""Axes about which a knee or an elbow bends, positive when it closes."""
_STRAIGHTER = 0.1
"""Radians by which a joint may be straighter than in any motion."""


def pose_prior(*, without: Sequence[str] = ()) -> PosePrior:
    """The prior learned from all motions that ship but those named, mirrored ones among them.

    Raises:
        DataError: a name is of no motion that ships, or none is left.
    """
    table = _table()
    names = [str(name) for name in table["motions"]]
    for name in without:
        if name not in names:
            raise DataError(f"prior: no motion is named {name!r}, expected {', '.join(names)}.")
    kept = np.array([name not in without for name in names])
    if not kept.any():
        raise DataError("prior: every motion is left out; leave one in.")
    weight = table["seconds"][kept].astype(np.float64)
    weight /= weight.sum()
    mean = np.einsum("m,md->d", weight, table["mean"][kept].astype(np.float64))
    second = np.einsum("m,mde->de", weight, table["second"][kept].astype(np.float64))
    spread = second - np.outer(mean, mean) + _FLOOR_RAD**2 * np.eye(len(mean))
    straightest = table["straightest"][kept].min(0)
    return PosePrior(
        mean=torch.from_numpy(mean),
        precision=torch.from_numpy(np.linalg.inv(spread)),
        lowest={
            name: float(least) - _STRAIGHTER
            for name, least in zip(HINGES, straightest, strict=True)
        },
    )


def statistics(
    rows: Float[np.ndarray, "T R 3"],
) -> tuple[
    Float[np.ndarray, "D"],
    Float[np.ndarray, "D D"],
    Float[np.ndarray, "4"],
]:
    """Mean, second moment and straightest hinges of a motion and its mirror image."""
    both = np.concatenate((rows, mirrored(rows)))
    flat = both.reshape(len(both), -1)
    axes = np.array([HINGES[name] for name in HINGES])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    bends = np.einsum("tra,ra->tr", both[:, [ROWS.index(name) for name in HINGES]], axes)
    return flat.mean(0), flat.T @ flat / len(flat), bends.min(0)


def mirrored(rows: Float[np.ndarray, "T R 3"]) -> Float[np.ndarray, "T R 3"]:
    """The poses seen in a mirror: left and right exchanged (x points to the left at rest)."""
    swap = {"left": "right", "right": "left"}
    other = [
        ROWS.index("_".join((swap.get(side, side), *rest)) if rest else side)
        for side, *rest in (name.split("_") for name in ROWS)
    ]
    return rows[:, other] * np.array([1.0, -1.0, -1.0])


@cache
def _table() -> dict[str, np.ndarray]:
    resource = files("evsplat") / "data" / "posing" / "prior.npz"
    return read_plain_npz(Path(str(resource)))
