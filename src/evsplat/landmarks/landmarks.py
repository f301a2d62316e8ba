"""`Landmarks`: named points of the person in the picture over time, and the usual sets of names.

Left and right are the person's own. Points that several sets share have one name in all of them
(``left_knee``), so that whoever reads landmarks looks them up by name.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int64


def _sides(*names: str) -> tuple[str, ...]:
    return tuple(f"{side}_{name}" for name in names for side in ("left", "right"))


_LIMBS = _sides("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
_FEET = tuple(
    f"{side}_{toe}" for side in ("left", "right") for toe in ("big_toe", "small_toe", "heel")
)
_FINGERS = ("hand_root",) + tuple(
    f"{finger}{joint}"
    for finger in ("thumb", "index", "middle", "ring", "pinky")
    for joint in "1234"
)

COCO_17 = ("nose", *_sides("eye", "ear"), *_LIMBS)
"""Key points of COCO, in its order."""

WHOLEBODY_133 = (
    *COCO_17,
    *_FEET,
    *(f"face_{index}" for index in range(68)),
    *(f"{side}_{finger}" for side in ("left", "right") for finger in _FINGERS),
)
"""Key points of COCO-WholeBody: body, feet, face, left and right hand."""

OPENPOSE_25 = (
    "nose",
    "neck",
    *(f"{side}_{joint}" for side in ("right", "left") for joint in ("shoulder", "elbow", "wrist")),
    "mid_hip",
    *(f"{side}_{joint}" for side in ("right", "left") for joint in ("hip", "knee", "ankle")),
    *("right_eye", "left_eye", "right_ear", "left_ear"),
    *_FEET,
)
"""Key points of OpenPose's BODY_25."""

BLAZEPOSE_33 = (
    "nose",
    *(f"{side}_eye{part}" for side in ("left", "right") for part in ("_inner", "", "_outer")),
    *_sides("ear"),
    *("mouth_left", "mouth_right"),
    *_sides("shoulder", "elbow", "wrist", "pinky", "index", "thumb"),
    *_sides("hip", "knee", "ankle", "heel", "foot_index"),
)
"""Landmarks of BlazePose (Bazarevsky et al., 2020), in its order."""

LIMB_POINTS = tuple(BLAZEPOSE_33.index(name) for name in _LIMBS)
"""Shoulders, elbows, wrists, hips, knees and ankles of BlazePose."""

SETS: dict[str, tuple[str, ...]] = {
    "coco17": COCO_17,
    "wholebody133": WHOLEBODY_133,
    "openpose25": OPENPOSE_25,
    "blazepose33": BLAZEPOSE_33,
}
"""Names of each set of points; each has another count."""


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Named points of one person in N pictures, in order of time."""

    times_us: Int64[np.ndarray, "N"]
    """On the camera's clock, ascending."""
    places: Float[np.ndarray, "N L 2"]
    """Pixels (x, y); the centre of the top left pixel is (0.5, 0.5), as in `evsplat.camera`."""
    sigma_px: Float[np.ndarray, "N L"]
    """Expected error of a place, pixels per axis."""
    seen: Float[np.ndarray, "N L"]
    """Confidence in 0..1; 0 where the point was not found, and its place means nothing."""
    world: Float[np.ndarray, "N L 3"] | None
    """Metres along the camera's axes (x right, y down, z forward) from the middle of the hips;
    None where whoever found the points tells no depth."""
    names: tuple[str, ...]
    """Of the L points."""

    def __post_init__(self) -> None:
        count = len(self.times_us), len(self.names)
        assert self.places.shape == (*count, 2), self.places.shape
        assert self.sigma_px.shape == self.seen.shape == count, (self.sigma_px.shape, count)
        assert self.world is None or self.world.shape == (*count, 3), self.world

    def __len__(self) -> int:
        """Count of pictures."""
        return len(self.times_us)

    def of_pictures(self, chosen: Bool[np.ndarray, "N"]) -> "Landmarks":
        """Those in some of the pictures."""
        return replace(
            self,
            times_us=self.times_us[chosen],
            places=self.places[chosen],
            sigma_px=self.sigma_px[chosen],
            seen=self.seen[chosen],
            world=None if self.world is None else self.world[chosen],
        )

    def index(self, name: str) -> int | None:
        """The place of a point in ``names``; None where this set lacks it."""
        return self.names.index(name) if name in self.names else None
