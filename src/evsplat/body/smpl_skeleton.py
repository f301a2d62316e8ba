"""The skeleton of the SMPL family, from the user's model file or approximated without it."""

import logging
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from jaxtyping import Float

from evsplat.body.canonical import SMPL_PARENTS
from evsplat.body.smpl import smpl_body
from evsplat.errors import DataError, WeightsError
from evsplat.untrusted.arrays import read_plain_npz

_log = logging.getLogger(__name__)

JOINTS = {"smpl": 24, "smplh": 52, "smplx": 55}
"""Joints of each model; the first 22 are the same in all."""
NAMES = (
    *("pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2"),
    *("left_ankle", "right_ankle", "spine3", "left_foot", "right_foot", "neck"),
    *("left_collar", "right_collar", "head", "left_shoulder", "right_shoulder"),
    *("left_elbow", "right_elbow", "left_wrist", "right_wrist"),
)
"""The 22 joints without hands and face."""
PARENTS = SMPL_PARENTS[: len(NAMES)]
STATURE_M = 1.70
_PELVIS_M = {"smpl": (0.0, -0.22, 0.03), "smplh": (0.0, -0.22, 0.03), "smplx": (0.0, -0.35, 0.01)}
"""The neutral pelvis in the model's own axes, rounded to a centimetre."""

# Height above the floor and distance from the middle as shares of the stature: segment lengths of
# Drillis and Contini as in Winter, Biomechanics and Motor Control of Human Movement, figure 4.1.
# Legs straight down, arms straight to the sides: the T-pose as it is defined.
_HIP, _KNEE, _ANKLE, _SHOULDER = 0.530, 0.285, 0.039, 0.818
_HALF_SHOULDERS, _UPPER_ARM, _FOREARM = 0.1295, 0.186, 0.146
_MIDDLE = {
    **{"pelvis": 0.575, "spine1": 0.630, "spine2": 0.690, "spine3": 0.735},
    **{"neck": 0.830, "head": 0.885},
}
_SIDES = {
    **{"hip": (0.05, _HIP, 0.0), "knee": (0.05, _KNEE, 0.0), "ankle": (0.05, _ANKLE, 0.0)},
    **{"foot": (0.05, 0.01, 0.07), "collar": (0.045, 0.795, 0.0)},
    "shoulder": (_HALF_SHOULDERS, _SHOULDER, 0.0),
    "elbow": (_HALF_SHOULDERS + _UPPER_ARM, _SHOULDER, 0.0),
    "wrist": (_HALF_SHOULDERS + _UPPER_ARM + _FOREARM, _SHOULDER, 0.0),
}


def rest_joints(
    model: str,
    betas: Float[np.ndarray, "B"] | None = None,
    gender: str = "neutral",
    *,
    body_models: Path | str | None = None,
    source: str = "poses",
) -> Float[np.ndarray, "22 3"]:
    """Rest joints of a subject in the model's own axes (x left, y up, z forward), metres.

    From the model's file where it is found (``body_models`` or the environment, as `smpl_body`);
    else, for SMPL-X, from the joint table of the optional package mannequin-x; else from average
    proportions of somebody 1.70 m tall, where ``betas`` do not count, which is logged.
    """
    try:
        body = smpl_body(model, betas, gender=gender, path=body_models, source=source)
    except WeightsError as error:
        if body_models is not None:
            raise
        if model == "smplx" and find_spec("mannequin") is not None:
            return _calibrated_rest_joints(betas)
        _log.warning(
            "%s: no %s model, so average proportions stand for this person's; limbs can be off by "
            "several degrees. %s%s",
            source,
            model.upper(),
            error,
            " Or: pip install 'evsplat[smplx-joints]'." if model == "smplx" else "",
        )
        return approximate_rest_joints(model)
    return body.rest_joints[: len(NAMES)].double().numpy()


def _calibrated_rest_joints(betas: Float[np.ndarray, "B"] | None) -> Float[np.ndarray, "22 3"]:
    """SMPL-X joints as a linear function of ten betas, from mannequin-x (Apache-2.0)."""
    file = files("mannequin") / "assets" / "smplx_calibration.npz"
    table = read_plain_npz(Path(str(file)))
    rest, directions = table["joint_rest"], table["joint_dirs"]
    shape = np.zeros(directions.shape[-1])
    given = np.zeros(0) if betas is None else np.asarray(betas, np.float64).ravel()[: len(shape)]
    shape[: len(given)] = given
    return (rest + directions @ shape)[: len(NAMES)].astype(np.float64)


def approximate_rest_joints(
    model: str = "smpl", stature_m: float = STATURE_M
) -> Float[np.ndarray, "22 3"]:
    """Joints of a T-pose with average proportions, the pelvis where the model has it."""
    joints = np.empty((len(NAMES), 3))
    for index, name in enumerate(NAMES):
        side, _, part = name.partition("_")
        if part:
            across, height, forward = _SIDES[part]
            joints[index] = (across if side == "left" else -across), height, forward
        else:
            joints[index] = 0.0, _MIDDLE[name], 0.0
    return (joints - joints[0]) * stature_m + np.array(_PELVIS_M[model])


def rest_pelvis(
    model: str,
    betas: Float[np.ndarray, "B"],
    gender: str = "neutral",
    *,
    given: tuple[float, float, float] | None = None,
    body_models: Path | str | None = None,
    source: str = "poses",
) -> Float[np.ndarray, "3"]:
    """The rest root joint that a file's translation refers to: ``given``, or of `rest_joints`."""
    if given is not None:
        pelvis = np.asarray(given, np.float64)
        if pelvis.shape != (3,) or not np.isfinite(pelvis).all():
            raise DataError(f"{source}: rest_pelvis is {given}, expected three numbers in metres.")
        return pelvis
    return rest_joints(model, betas, gender, body_models=body_models, source=source)[0]
