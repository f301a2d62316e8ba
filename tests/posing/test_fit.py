"""Motions fitted to landmarks of known ones."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.posing.moving import CAMERA, SPAN_US, landmarks, motion, stick_figure

from evsplat.camera import Camera
from evsplat.errors import DataError
from evsplat.posing.fit import FitSettings, fit_focal, fit_landmarks
from evsplat.posing.kinematics import pose
from evsplat.posing.problem import State
from evsplat.posing.rig import default_rig, make_rig

TIMES = np.arange(50_000, 800_000, 100_000)
MEASURED = tuple(
    f"{side}_{part}"
    for part in ("upper_arm", "forearm", "hand", "thigh", "shin", "foot")
    for side in ("left", "right")
) + ("neck", "head")
"""The 14 joints that errors are measured at: a limb's is where that part begins."""


def _fit(marks, camera: Camera = CAMERA, **options):
    settings = FitSettings(height_m=default_rig().stature, knot_s=0.08)
    return fit_landmarks(marks, [camera] * len(marks), SPAN_US, settings=settings, **options)


def _errors(fit) -> tuple[float, float]:
    """Mean distance of joints, pixels and metres."""
    rig = default_rig()
    index = [rig.joint(name) for name in MEASURED]
    true = pose(rig, motion(TIMES), torch.zeros(10, dtype=torch.float64)).joints[:, index]
    found = fit.joints(TIMES)[:, index]
    pixels = CAMERA.project(found)[0] - CAMERA.project(true)[0]
    return float(pixels.norm(dim=-1).mean()), float((found - true).norm(dim=-1).mean())


def test_the_gradient_of_the_price_is_that_of_finite_differences():
    marks = landmarks(6)
    fit = _fit(marks, flips=False)
    # Its direction of depth is held fixed in the derivatives: left out here.
    problem = replace(fit.problem, settings=replace(fit.problem.settings, depth=0.0), _kept={})
    generator = torch.Generator().manual_seed(0)
    draw = lambda like: torch.randn(like.shape, generator=generator, dtype=torch.float64)  # noqa: E731
    state = State(
        fit.state.control + 0.1 * draw(fit.state.control),
        fit.state.shared + 0.1 * draw(fit.state.shared),
    )
    price, normal = problem.linearised(state)
    assert problem.price(state) == pytest.approx(price, rel=1e-12)
    for _ in range(3):
        way, shared = draw(state.control), draw(state.shared)
        step = lambda s: problem.price(State(state.control + s * way, state.shared + s * shared))  # noqa: B023, E731
        slope = float((normal.gradient * way).sum() + normal.shared_gradient @ shared)
        assert (step(1e-5) - step(-1e-5)) / 2e-5 == pytest.approx(slope, rel=1e-5)


def test_a_known_motion_is_found_again():
    pixels, metres = _errors(_fit(landmarks(), flips=False))
    assert pixels < 0.6
    assert metres < 0.04


def test_without_depths_the_picture_still_fits():
    pixels, _ = _errors(_fit(landmarks(world=False), flips=False))
    assert pixels < 1.0


def test_smpl_s_skeleton_is_fitted_as_well():
    rig = make_rig(stick_figure, "smpl", 1)
    fit = fit_landmarks(landmarks(), [CAMERA] * 24, SPAN_US, rig=rig, flips=False)
    true = pose(default_rig(), motion(TIMES), torch.zeros(10, dtype=torch.float64)).joints
    track = fit.track(TIMES)
    found = track.body.joint_transforms(*track.at(TIMES))[..., :3, 3].double()
    limbs = [name for name in MEASURED if name not in ("neck", "head")]
    off = (
        CAMERA.project(found[:, [rig.joint(name) for name in limbs]])[0]
        - CAMERA.project(true[:, [default_rig().joint(name) for name in limbs]])[0]
    )
    assert off.norm(dim=-1).mean() < 3


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_of_somebody_who_lies_landmarks_count_as_of_somebody_upright(rng, turns):
    """Before a camera on its side the same is seen, turned: its fit is the same one."""
    upright = landmarks()
    erring = upright.places + rng.normal(0, 2, upright.places.shape)
    upright = replace(upright, places=erring, sigma_px=0 * upright.sigma_px)
    expected = _fit(upright, flips=False)
    tall = np.median(np.ptp(upright.places[..., 1], axis=1))
    sigma = expected.problem.evidence.sigma_px
    np.testing.assert_allclose(sigma, 0.012 * tall, rtol=0.03)

    onto_side = np.linalg.matrix_power([[0, -1, 0], [1, 0, 0], [0, 0, 1]], turns)
    world_to_camera = CAMERA.world_to_camera.clone()
    world_to_camera[:3] = torch.tensor(onto_side, dtype=torch.float32) @ world_to_camera[:3]
    places = (upright.places - 128) @ onto_side[:2, :2].T + 128
    assert upright.world is not None
    lying = replace(upright, places=places, world=upright.world @ onto_side.T)
    found = _fit(lying, replace(CAMERA, world_to_camera=world_to_camera), flips=False)
    torch.testing.assert_close(found.problem.evidence.sigma_px, sigma)
    torch.testing.assert_close(found.joints(TIMES), expected.joints(TIMES), rtol=0, atol=2e-3)


def test_errors_grow_with_those_of_the_landmarks():
    marks = landmarks(noise_px=1.0)
    sure = _fit(marks, flips=False).errors(TIMES)
    unsure = _fit(replace(marks, sigma_px=4 * marks.sigma_px), flips=False).errors(TIMES)
    assert (unsure.joint_rad.max(1) > sure.joint_rad.max(1)).all()
    assert (unsure.root_m > sure.root_m).all()
    assert (sure.joint_rad[:, 0] > 0).all()


def test_the_track_has_the_fitted_joints_and_errors():
    fit = _fit(landmarks(), flips=False)
    track = fit.track(TIMES)
    joints = track.body.joint_transforms(*track.at(TIMES))[..., :3, 3].double()
    torch.testing.assert_close(joints, fit.joints(TIMES), rtol=0, atol=1e-4)
    assert track.errors is not None
    assert track.errors.source == "estimated"


def test_the_focal_length_is_found_as_well_as_is_told():
    """Of a camera whose focal length is 300 pixels, taken for another one."""
    for usual in (220.0, 400.0):
        K = torch.tensor([[usual, 0, 128], [0, usual, 128], [0, 0, 1]])
        fit = _fit(landmarks(), Camera(256, 256, K, CAMERA.world_to_camera), flips=False)
        found = fit_focal(fit, usual)
        off = abs(np.log(found.focal_px / 300))
        assert off < 0.7 * abs(np.log(usual / 300))
        assert 0.4 * off < found.std_share < 0.4  # what lenses differ by, had nothing been seen
        views = found.fit.problem.evidence.views
        torch.testing.assert_close(views.focal_px, torch.full_like(views.focal_px, found.focal_px))


def test_too_few_pictures_are_one_sentence():
    with pytest.raises(DataError, match="found in 3 pictures, expected at least 4"):
        _fit(landmarks(3))
