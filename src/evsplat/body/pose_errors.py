"""How far the key poses of a track err, and where they come from."""

from dataclasses import dataclass
from typing import Literal, Self, get_args

import numpy as np
from jaxtyping import Float

from evsplat.errors import DataError

PoseSource = Literal["exact", "markers", "estimated"]
"""Where key poses come from: ``exact`` ones made the pictures themselves, ``markers`` were measured
with markers or fitted to several views, ``estimated`` ones come from the pictures of one camera."""

POSE_SOURCES: tuple[PoseSource, ...] = get_args(PoseSource)
_TYPICAL = {"exact": (0.0, 0.0), "markers": (0.02, 0.01), "estimated": (0.1, 0.05)}
"""Radians per axis of each joint and metres per axis of the root, where a source gives no numbers.
Orders of magnitude: 0.1 rad at shoulder and elbow move a wrist by 5 cm, which estimators err by."""


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Standard deviations of what P key poses of J joints err by, and their source."""

    source: PoseSource
    joint_rad: Float[np.ndarray, "P J"]
    """Rotation of each joint, radians per axis; of the root, orientation in the world."""
    root_m: Float[np.ndarray, "P 3"]
    """Place of the root along the axes of the world, metres."""
    typical: bool = False
    """True where nobody gave numbers: those above are then typical of the source only."""

    @classmethod
    def typical_of(cls, source: PoseSource, poses: int, joints: int) -> Self:
        """Errors typical of a source, where nothing more is known of ``poses`` key poses."""
        radians, metres = _TYPICAL[source]
        joint_rad, root_m = np.full((poses, joints), radians), np.full((poses, 3), metres)
        return cls(source, joint_rad, root_m, typical=True)

    def check(self, poses: int, joints: int, where: str) -> None:
        """A `DataError` that begins with ``where``, unless they fit that many poses and joints."""
        if self.source not in POSE_SOURCES:
            raise DataError(
                f"{where}: the poses' source is {self.source!r}, expected one of "
                f"{', '.join(POSE_SOURCES)}."
            )
        for name, value, shape in (
            ("errors.joint_rad", self.joint_rad, (poses, joints)),
            ("errors.root_m", self.root_m, (poses, 3)),
        ):
            if np.shape(value) != shape:
                raise DataError(f"{where}: {name} has shape {np.shape(value)}, expected {shape}.")
            if not (np.isfinite(value) & (np.asarray(value) >= 0)).all():
                raise DataError(f"{where}: {name} must hold finite numbers of at least 0.")
