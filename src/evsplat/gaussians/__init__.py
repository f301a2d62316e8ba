"""The Gaussian set: parameters, semantic attribute, start, densification."""

from evsplat.gaussians.adam import Adam, step_together
from evsplat.gaussians.densify import DensifyLimits, ScreenStatistics, densify
from evsplat.gaussians.flip import BodyFrames, flip_labels
from evsplat.gaussians.gaussian_set import (
    FEATURE_DIM,
    GaussianSet,
    OneClassRows,
    Part,
    Rows,
    Shape,
)
from evsplat.gaussians.row_adam import RowAdam

__all__ = [
    "FEATURE_DIM",
    "Adam",
    "BodyFrames",
    "DensifyLimits",
    "GaussianSet",
    "OneClassRows",
    "Part",
    "RowAdam",
    "Rows",
    "ScreenStatistics",
    "Shape",
    "densify",
    "flip_labels",
    "step_together",
]
