"""The Gaussian set: parameters, semantic attribute, start, densification."""

from evsplat.gaussians.densify import DensifyConfig, Edit, ScreenStatistics, densify
from evsplat.gaussians.flip import BodyFrames, flip_labels
from evsplat.gaussians.gaussian_set import (
    ATTRIBUTES,
    FEATURE_DIM,
    GaussianSet,
    OneClassRows,
    Part,
    Rows,
    Shape,
)
from evsplat.gaussians.posed import PosedGaussians, PosedHuman, StaticScene
from evsplat.gaussians.row_adam import RowAdam

__all__ = [
    "ATTRIBUTES",
    "FEATURE_DIM",
    "BodyFrames",
    "DensifyConfig",
    "Edit",
    "GaussianSet",
    "OneClassRows",
    "Part",
    "PosedGaussians",
    "PosedHuman",
    "RowAdam",
    "Rows",
    "ScreenStatistics",
    "Shape",
    "StaticScene",
    "densify",
    "flip_labels",
]
