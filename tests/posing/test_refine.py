"""A motion is corrected by pictures of it, by a known amount, and left where it is right."""

from pathlib import Path

import numpy as np
import pytest
import torch

from evsplat.body import BodyTrack, default_body
from evsplat.body.silhouette import silhouette
from evsplat.camera import Camera
from evsplat.capture import Frame
from evsplat.pictures import decode, encode, luminance
from evsplat.posing.correction import Correction
from evsplat.posing.descent import Descent
from evsplat.posing.refine import _gain, expected_errors
from evsplat.posing.surface_discs import SurfaceDiscs
from evsplat.posing.targets import Targets

TIMES = list(range(0, 400_001, 20_000))


@pytest.fixture(scope="module")
def body():
    return default_body()


def still_track(body, keys=11):
    times = np.linspace(0, 400_000, keys).astype(np.int64)
    return BodyTrack(body, times, np.zeros((keys, len(body.parents), 3)), np.zeros((keys, 3)))


def correction_of(body, rad=0.05, metres=0.02):
    return Correction(still_track(body), np.full(len(body.parents), rad), np.full(3, metres))


def front_camera(body, size=48):
    """Three metres in front of the body, which stands along z or y."""
    points = body.canonical_vertices()
    low, high = points.amin(0), points.amax(0)
    tall = int((high - low).argmax())
    down = -torch.eye(3)[tall]
    forward = torch.eye(3)[3 - tall]
    pose = torch.eye(4)
    pose[:3, :3] = torch.stack([torch.linalg.cross(down, forward), down, forward])
    pose[:3, 3] = -pose[:3, :3] @ ((low + high) / 2 - 3 * forward)
    focal = 1.4 * size
    K = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]])
    return Camera(size, size, K, pose)


def test_without_coordinates_the_motion_is_the_given_one(body):
    correction = correction_of(body)
    for found, given in zip(correction.at(TIMES), correction.track.at(TIMES), strict=True):
        torch.testing.assert_close(found, given, rtol=0, atol=1e-6)


def test_the_prior_has_the_expected_size_at_all_times(body):
    variance = correction_of(body).weights(TIMES).square().sum(1)
    assert variance.mean() == pytest.approx(1, rel=0.05)
    assert variance.min() > 0.6
    assert variance.max() < 1.6


def test_the_first_coordinate_moves_all_times_alike(body):
    first = correction_of(body).weights(TIMES)[:, 0]
    assert first.abs().min() > 0.5 * first.abs().max()


def test_the_corrected_track_is_the_correction_at_the_keys(body):
    torch.manual_seed(0)
    correction = correction_of(body)
    with torch.no_grad():
        correction.turns.normal_()
        correction.shifts.normal_()
    track = correction.corrected()
    keys = track.times_us.tolist()
    for found, wanted in zip(track.at(keys), correction.at(keys), strict=True):
        torch.testing.assert_close(found, wanted.detach(), rtol=0, atol=1e-5)


def test_keys_far_apart_get_more_between_them(body):
    found = Correction(
        still_track(body, 3), np.full(len(body.parents), 0.1), np.full(3, 0.1)
    ).corrected()
    assert {0, 200_000, 400_000} <= set(found.times_us.tolist())
    assert np.diff(found.times_us).max() <= 40_000


def test_where_nobody_says_limbs_err_more_than_the_trunk(body):
    joint_rad, root_m = expected_errors(still_track(body))
    assert joint_rad[0] < joint_rad.max()
    assert (root_m > 0).all()


def test_discs_take_the_colours_of_the_pixels_that_show_them(body):
    look = SurfaceDiscs(body, 500, torch.Generator().manual_seed(1))
    camera = front_camera(body)
    motion = still_track(body).at([0])
    red = torch.tensor([0.8, 0.1, 0.2]).expand(1, camera.height, camera.width, 3)
    look.colour_from(*motion, camera, red)
    torch.testing.assert_close(look.colours.detach(), red[0, 0, :1].expand(500, 3))


@pytest.mark.parametrize(("size", "count"), [(128, 1_500), (128, 3_000), (256, 3_000)])
def test_drawn_discs_end_where_the_body_does(body, size, count):
    look = SurfaceDiscs(body, 3_000, torch.Generator().manual_seed(1))
    camera = front_camera(body, size)
    track = still_track(body)
    behind = torch.zeros(1, size, size, 3)
    with torch.no_grad():
        look.colours.fill_(1)
        drawn = look.draw(*track.at([0]), camera, behind, count)[0, ..., 0]
    inside = silhouette(track.vertices(0), body.faces, camera).float()
    assert float(drawn.sum()) == pytest.approx(float(inside.sum()), rel=0.05)
    assert (drawn - inside).abs().sum() < 0.2 * inside.sum()


def grey_and_coloured():
    """Two pictures of one colour, the second carried by events."""
    image = torch.tensor([0.2, 0.5, 0.9]).expand(2, 4, 4, 3).clone()
    ones = torch.ones(2, 4, 4)
    frame = Frame("0", 0, "main", Path("none"), (0, 1), "train")
    camera = Camera(4, 4, torch.eye(3), torch.eye(4))
    coloured = torch.tensor([True, False])
    return Targets([0, 1], [frame] * 2, coloured, image, image, ones, ones, camera, "power")


def test_carried_pictures_tell_luminance_alone():
    targets = grey_and_coloured()
    seen = targets.as_seen(targets.image)
    assert torch.equal(seen[0], targets.image[0])
    light = luminance(decode(targets.image[1]))
    torch.testing.assert_close(seen[1], encode(light)[..., None].expand(4, 4, 3))


def test_smaller_targets_keep_what_is_alike():
    targets = grey_and_coloured()
    small = targets.rows([1, 0]).smaller(2)
    assert small.coloured.tolist() == [False, True]
    assert small.camera.width == 2
    torch.testing.assert_close(small.image, targets.image[:, :2, :2])


def staged(body, size):
    """A correction at zero, and drawings of the motion that one of ``size`` deviations makes."""
    look = SurfaceDiscs(body, 500, torch.Generator().manual_seed(1))
    correction = correction_of(body)
    generator = torch.Generator().manual_seed(2)
    camera = front_camera(body)
    behind = torch.full((len(TIMES), camera.height, camera.width, 3), 0.3)
    with torch.no_grad():
        look.colours.copy_(torch.rand(500, 3, generator=generator))
        for values in (correction.turns, correction.shifts):
            values.copy_(size * torch.randn(values.shape, generator=generator))
        truth = correction.at(TIMES)
        image = look.draw(*truth, camera, behind)
        correction.turns.zero_()
        correction.shifts.zero_()
    frames = [
        Frame(str(k), k, "main", Path("none"), (t - 1, t + 1), "train") for k, t in enumerate(TIMES)
    ]
    weight = torch.ones(image.shape[:3])
    coloured = torch.ones(len(TIMES), dtype=torch.bool)
    targets = Targets(TIMES, frames, coloured, image, behind, weight, weight, camera, "power")
    return truth, Descent(correction, look, targets)


@torch.no_grad()
def joint_px(descent, truth):
    """Mean distance of the joints from the true ones across the view; along it little shows."""
    body, camera = descent.look.body, descent.targets.camera
    found = body.joint_transforms(*descent.correction.at(TIMES))[..., :3, 3]
    wanted = body.joint_transforms(*truth)[..., :3, 3]
    return float((camera.project(found)[0] - camera.project(wanted)[0]).norm(dim=-1).mean())


def test_pictures_of_another_motion_correct_it_and_are_explained_better(body):
    truth, descent = staged(body, 1.0)
    before = joint_px(descent, truth)
    stage = descent.run(1, 60, first=True)
    assert joint_px(descent, truth) < 0.5 * before
    assert stage.after < 0.5 * stage.before
    gain, gain_error = _gain(descent, descent.targets.rows(range(0, len(TIMES), 3)))
    assert gain - 2 * gain_error > 0.3
    errors = descent.errors()
    errors.check(len(descent.correction.key_times), len(body.parents), "test")
    assert errors.joint_rad.max() < 0.08
    assert errors.root_m.max() < 0.02


def test_pictures_of_the_same_motion_hardly_move_it(body):
    truth, descent = staged(body, 0.0)
    descent.run(1, 60, first=True)
    assert joint_px(descent, truth) < 0.1
