import numpy as np
import pytest

from evsplat.body import default_body
from evsplat.body.make import default_betas_for_stature
from evsplat.body.skeleton import find_skeleton
from evsplat.body.smpl import ENVIRONMENT
from evsplat.body.smpl_skeleton import (
    NAMES,
    PARENTS,
    STATURE_M,
    approximate_rest_joints,
    rest_joints,
    rest_pelvis,
)
from evsplat.errors import DataError, WeightsError


@pytest.fixture(autouse=True)
def no_models(monkeypatch):
    monkeypatch.delenv(ENVIRONMENT, raising=False)


def limb_directions(joints):
    limbs = find_skeleton(list(PARENTS), NAMES).limbs
    pairs = (("upper_arm", "forearm"), ("forearm", "hand"), ("thigh", "shin"), ("shin", "foot"))
    ends = [(f"{side}_{a}", f"{side}_{b}") for side in ("left", "right") for a, b in pairs]
    bones = np.array([joints[limbs[end]] - joints[limbs[start]] for start, end in ends])
    return bones / np.linalg.norm(bones, axis=1, keepdims=True)


def test_average_proportions_are_a_straight_t_pose_of_that_stature():
    joints = approximate_rest_joints("smpl")
    arm, leg = [1, 0, 0], [0, -1, 0]
    expected = np.array([arm, arm, leg, leg, np.negative(arm), np.negative(arm), leg, leg])
    assert np.allclose(limb_directions(joints), expected, atol=1e-12)
    taller = approximate_rest_joints("smpl", 2 * STATURE_M)
    assert np.allclose(taller - taller[0], 2 * (joints - joints[0]))
    assert np.allclose(taller[0], joints[0])


def test_smplx_joints_of_the_optional_table_follow_the_shape(caplog):
    pytest.importorskip("mannequin", reason="needs the extra smplx-joints")
    rng = np.random.default_rng(0)
    one, other = rng.normal(size=(2, 10))
    neutral = rest_joints("smplx")
    assert not caplog.records
    shaped = [rest_joints("smplx", betas) - neutral for betas in (one, other, one + other)]
    assert np.abs(shaped[0]).max() > 1e-3
    assert np.allclose(shaped[0] + shaped[1], shaped[2], atol=1e-6)
    assert np.allclose(rest_joints("smplx", one[:3]), rest_joints("smplx", [*one[:3], 0, 0]))
    # what docs/poses.md says of the average: limbs within 18.5 degrees, the pelvis within 1 cm
    average = approximate_rest_joints("smplx")
    angles = np.degrees(np.arccos((limb_directions(neutral) * limb_directions(average)).sum(1)))
    assert angles.max() < 18.5 and angles[[2, 3, 6, 7]].max() < 8.5
    assert np.abs(neutral[0] - average[0]).max() < 0.01


def test_a_model_asked_for_is_not_replaced_by_an_average(tmp_path):
    with pytest.raises(WeightsError, match="holds no file of SMPL"):
        rest_joints("smpl", body_models=tmp_path)
    with pytest.raises(DataError, match="expected three numbers in metres"):
        rest_pelvis("smpl", np.zeros(10), given=(0.0, float("nan"), 0.0))


@pytest.mark.parametrize("stature_m", [1.5, 1.7, 1.95])
def test_the_shipped_body_grows_to_the_stature(stature_m):
    betas = default_betas_for_stature(stature_m)
    height = default_body(betas).rest_vertices[:, 2]
    assert float(height.max() - height.min()) == pytest.approx(stature_m, abs=1e-3)
    assert np.abs(betas).max() < 3


def test_an_impossible_stature_is_refused():
    with pytest.raises(DataError, match="stature is 17.0 m, expected 1.4 to 2.1"):
        default_betas_for_stature(17.0)
