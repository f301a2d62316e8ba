"""A motion is corrected by pictures of it, by a known amount, and left where it is right."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from evsplat.body import BodyTrack
from evsplat.body.silhouette import silhouette
from evsplat.body.surface import vertex_normals
from evsplat.camera import Camera
from evsplat.capture import Frame, Policy, load_body_track, load_capture
from evsplat.errors import DataError
from evsplat.pictures import decode, encode, luminance
from evsplat.posing import refine as refining
from evsplat.posing.correction import Correction
from evsplat.posing.descent import Descent
from evsplat.posing.pieces import between
from evsplat.posing.refine import (
    JUDGED_FRAMES,
    LEAST_GAIN,
    _descended,
    _gain,
    _given_errors,
    _mean_gain,
    expected_errors,
    judge,
)
from evsplat.posing.surface_discs import SurfaceDiscs
from evsplat.posing.targets import Targets, find_targets, halved
from evsplat.posing.time_limit import TimeLimit

from ..seen import seen

TIMES = list(range(0, 400_001, 20_000))


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


@pytest.mark.parametrize("size", [0.2, 1.0])
def test_a_motion_errs_by_how_far_it_was_corrected(body, size):
    """A correction drawn from its prior, ``size`` times as large, gives errors of that size."""
    torch.manual_seed(2)
    rad, metres = 0.05, 0.02
    correction = correction_of(body, rad, metres)
    with torch.no_grad():
        correction.turns.normal_(std=size)
        correction.shifts.normal_(std=size)
    errors = _given_errors(correction, 40)
    assert errors.joint_rad.shape[0] == 40
    assert errors.source == "estimated" and not errors.typical
    assert errors.joint_rad == pytest.approx(np.full_like(errors.joint_rad, size * rad), rel=0.2)
    # Three axes of a handful of coordinates: a rough estimate, no axis far below the worst.
    assert size * metres / 3 < errors.root_m.max() < 3 * size * metres
    assert errors.root_m.min() >= 0.5 * errors.root_m.max()


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
    frame = Frame("0", 0, "main", "none", (0, 1), "train")
    camera = Camera(4, 4, torch.eye(3), torch.eye(4))
    coloured = torch.tensor([True, False])
    return Targets([0, 1], [frame] * 2, coloured, image, image, ones, ones, camera, "power")


def test_a_dressed_body_ends_where_the_discs_lie(body):
    look = SurfaceDiscs(body, 1500, torch.Generator().manual_seed(0))
    bare = look.dressed()
    torch.testing.assert_close(bare.rest_vertices, body.rest_vertices)
    with torch.no_grad():
        look.offsets += 2.0
    normals = vertex_normals(body.canonical_vertices(), body.faces)
    moved = look.dressed().canonical_vertices() - body.canonical_vertices()
    torch.testing.assert_close(moved, 0.02 * normals, rtol=0, atol=1e-5)
    with torch.no_grad():
        look.offsets.zero_()
        look.bone_offsets[3, 1] = 1.0
    dressed = look.dressed()
    moved = dressed.canonical_vertices() - body.canonical_vertices()
    wanted = 0.01 * body.weights[:, 3:4] * torch.tensor([0.0, 1.0, 0.0])
    torch.testing.assert_close(moved, wanted, rtol=0, atol=1e-5)
    torch.testing.assert_close(dressed.rest_joints, body.rest_joints)


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
        Frame(str(k), k, "main", "none", (t - 1, t + 1), "train") for k, t in enumerate(TIMES)
    ]
    weight = torch.ones(image.shape[:3])
    coloured = torch.ones(len(TIMES), dtype=torch.bool)
    targets = Targets(TIMES, frames, coloured, image, behind, weight, weight, camera, "power")
    return truth, Descent(correction, look, targets)


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_what_counts_about_somebody_turns_with_the_camera(body, rng, turns):
    """Before a camera on its side, or as somebody who lies, they are as tall as they are."""
    camera, track = front_camera(body, size=64), still_track(body)
    image = torch.from_numpy(rng.uniform(0.1, 0.9, (len(TIMES), 64, 64, 3))).float()
    ones, coloured = torch.ones(image.shape[:3]), torch.ones(len(TIMES), dtype=torch.bool)
    upright = Targets(TIMES, [], coloured, image, image, ones, ones, camera, "power")
    onto_side = torch.eye(4)
    onto_side[:2, :2] = torch.tensor([[0.0, -1], [1, 0]])
    pose = torch.linalg.matrix_power(onto_side, turns) @ camera.world_to_camera
    turned = image.rot90(-turns, (1, 2))
    on_side = Targets(
        TIMES, [], coloured, turned, turned, ones, ones,
        replace(camera, world_to_camera=pose), "power",
    )  # fmt: skip
    expected, found = upright.around(track), on_side.around(track)
    counts = expected.weight.rot90(-turns, (1, 2))
    assert 0.1 < float(counts.mean()) < 0.9
    assert float((found.weight == counts).float().mean()) > 0.99
    apart = (found.behind - expected.behind.rot90(-turns, (1, 2))).abs()
    assert float((apart < 1e-3).float().mean()) > 0.95


@pytest.mark.parametrize("carried", [False, True])
def test_differences_are_those_of_whole_pictures(body, carried):
    """Only pixels with a weight are looked at; values and gradients as if all were."""
    _, descent = staged(body, 1.0)
    targets = descent.targets
    weight = torch.rand(targets.weight.shape, generator=torch.Generator().manual_seed(3))
    coloured = targets.coloured.clone()
    coloured[1::2] = not carried
    targets = replace(targets, weight=weight * (weight > 0.7), coloured=coloured)
    drawn = descent.look.draw(*descent.correction.at(TIMES), targets.camera, targets.behind)
    square = (targets.as_seen(drawn) - targets.image).square().sum(-1) / 0.06**2
    expected = (torch.log1p(square / 2) * targets.weight).sum((1, 2))
    descent.discs = 500
    found = descent._differences(targets)
    torch.testing.assert_close(found, expected)
    parameters = [descent.correction.turns, descent.look.colours, descent.look.offsets]
    for one, other in zip(
        torch.autograd.grad(found.sum(), parameters),
        torch.autograd.grad(expected.sum(), parameters),
        strict=True,
    ):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-3 * float(other.abs().max()))


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
    descent.run(1, 1, first=True)
    misfits = descent.misfits(descent.targets)
    descent.run(1, 60, first=False)
    assert joint_px(descent, truth) < 0.5 * before
    assert descent.misfits(descent.targets).mean() < 0.5 * misfits.mean()
    aside = descent.targets.rows(range(0, len(TIMES), 3))
    gain, gain_error = _mean_gain(_gain(descent, aside))
    assert gain - 2 * gain_error > 0.3
    errors = descent.errors()
    errors.check(len(descent.correction.key_times), len(body.parents), "test")
    expected = descent.correction.joint_rad.numpy()
    told = errors.joint_rad[:, descent.correction.joints] / expected
    assert told.max() <= 1
    # half of the variance is left whatever pictures say; here they say nearly all
    assert told.min() >= 0.5**0.5
    assert np.median(told) < 0.9
    assert errors.joint_rad.max() < 0.08
    assert errors.root_m.max() < 0.02


def test_while_the_look_is_learned_the_motion_stays_and_has_no_gradient(body):
    found = []
    for whole in (False, True):
        _, descent = staged(body, 1.0)
        descent.discs = 500
        motion = descent.correction.turns, descent.correction.shifts
        if whole:
            descent._descend(descent._look_groups(), descent.targets, 1, 6)
        else:
            descent.learn_look(descent.targets, 1, 6)
        assert all((one.grad is not None) == whole and one.requires_grad for one in motion)
        assert not any(bool(one.any()) for one in motion)
        found.append(descent.look.state_dict())
    assert all(torch.equal(found[0][name], found[1][name]) for name in found[0])
    assert not torch.equal(found[0]["offsets"], torch.zeros(500))


def test_how_far_away_somebody_is_stays_as_unknown_as_their_size(body):
    """Two shares of one sum: each keeps c^2 s^2 / (c^2 + s^2), here all of it along the view.

    Besides there is left what limbs that lean make up for, of all that was expected.
    """
    _, descent = staged(body, 0.0)
    camera = descent.targets.camera
    _, transl = descent.correction.at(TIMES)
    hidden = descent.look.nearer_m(transl, camera)
    away = transl + body.rest_joints[0] - camera.center()
    torch.testing.assert_close(hidden, 0.015 * away)
    # Pictures of somebody larger by a share and of somebody nearer by it are the same.
    behind = descent.targets.behind[:1]
    with torch.no_grad():
        rotations, places = descent.correction.at([0])
        nearer = descent.look.draw(rotations, places - hidden[:1], camera, behind)
        plain = descent.look.draw(rotations, places, camera, behind)
        descent.look.nearer.fill_(1.0)
        larger = descent.look.draw(rotations, places, camera, behind)
        descent.look.nearer.zero_()
    assert (larger - nearer).abs().mean() < 0.1 * (larger - plain).abs().mean()
    variance = descent._distance(TIMES)
    view = torch.nn.functional.normalize(away, dim=1)
    s2 = hidden.square().sum(1)
    c2 = 0.02**2 * descent.correction.weights(TIMES).mean(0).square().sum()
    left = 0.3 * 0.02**2 + 1 / (1 / c2 + 1 / s2)
    torch.testing.assert_close(variance, view.square() * left[:, None])
    assert 0.3 < c2 / 0.02**2 < 0.9, "what lasts, and the mean of what does not"
    descent.discs = 500
    told = descent.errors().root_m
    along = np.sqrt((np.square(told) * view[0].square().detach().numpy()).sum(1))
    assert along.min() > 0.95 * float(variance.sum(1).min().sqrt())


def test_pictures_of_the_same_motion_hardly_move_it(body):
    truth, descent = staged(body, 0.0)
    descent.run(1, 60, first=True)
    assert joint_px(descent, truth) < 0.1


@pytest.mark.parametrize("wrong", [False, True])
def test_larger_pictures_are_asked_where_the_smallest_leave_it_open(body, wrong):
    """Those of the true motion say for certain that no other one is much better."""
    _, descent = staged(body, 1.0 if wrong else 0.0)
    limit, steps = TimeLimit(None, 1), (60, 10)
    track = still_track(body)
    found = _descended(track, descent.targets, limit, steps, 500, least_gain=LEAST_GAIN)
    assert (found.coarse is not found.better) == wrong
    gain, coarse_gain = _mean_gain(found.better)[0], _mean_gain(found.coarse)[0]
    assert (min(gain, 2 * gain - coarse_gain) > LEAST_GAIN) == wrong


def test_a_piece_of_a_motion_moves_as_the_whole(body):
    """Splines through keys around it: farther ones count less than a thousandth."""
    rng = np.random.default_rng(0)
    times = np.arange(60) * 40_000
    poses = 0.3 * rng.normal(size=(60, len(body.parents), 3))
    whole = BodyTrack(body, times, poses, rng.normal(size=(60, 3)))
    inside = np.linspace(times[20], times[39], 50).astype(np.int64).tolist()
    piece = between(whole, inside[0], inside[-1])
    assert len(piece.times_us) < 40
    for found, wanted in zip(piece.at(inside), whole.at(inside), strict=True):
        torch.testing.assert_close(found, wanted, rtol=0, atol=1e-3)


def test_a_verdict_takes_no_longer_for_a_longer_recording(tiny_capture, monkeypatch):
    """Pictures of so many training frames, and of what is held out between them."""
    asked = []

    def noted(track, capture, pictures, **options):
        asked.append(list(dict.fromkeys(picture.frame.index for picture in pictures)))
        return find_targets(track, capture, pictures, **options)

    monkeypatch.setattr(refining, "find_targets", noted)
    capture = seen(tiny_capture(frames=60))
    assert len(capture.train_frames) > JUDGED_FRAMES
    track = load_body_track(capture)
    verdict = judge(track, capture, steps=(2, 2), discs=100)
    frames = [capture.frames[index] for index in asked[0]]
    assert len(asked) == 1 and sum(frame.split == "train" for frame in frames) == JUDGED_FRAMES
    before, after = frames[0].mid_us, capture.frames[-1].mid_us - frames[-1].mid_us
    assert abs(before - after) <= 3 * (frames[1].mid_us - frames[0].mid_us)
    assert len(verdict.given_errors.joint_rad) == len(track.times_us)


def test_larger_pictures_are_made_smaller_for_a_verdict(tiny_capture):
    """Halved while both sides keep the least, as the camera is."""
    capture = seen(tiny_capture(width=64, height=48))
    track = load_body_track(capture)
    shrink = halved(capture.camera(capture.frames[0]), 12)
    whole, small = find_targets(track, capture), find_targets(track, capture, shrink=shrink)
    assert (small.camera.width, small.camera.height) == (16, 12)
    assert small.image.shape[1:3] == (12, 16) == small.behind.shape[1:3]
    means = torch.nn.functional.avg_pool2d(whole.image.permute(0, 3, 1, 2), 4)
    torch.testing.assert_close(small.image, means.permute(0, 2, 3, 1))


@pytest.mark.parametrize("how", [judge, refining.refine])
def test_before_a_moving_camera_no_picture_is_sharpened_in_vain(tiny_capture, monkeypatch, how):
    path = tiny_capture()
    document = json.loads((path / "capture.json").read_text())
    pose = np.array(document["cameras"]["main"]["world_to_camera"])
    for index, frame in enumerate(document["frames"]):
        pose[0, 3] += 0.01 * index
        frame["world_to_camera"] = pose.tolist()
    (path / "capture.json").write_text(json.dumps(document))
    monkeypatch.setattr(refining, "sharp_pictures", None)
    capture = load_capture(path).for_training(Policy())
    with pytest.raises(DataError, match="moving camera"):
        how(load_body_track(capture), capture)
