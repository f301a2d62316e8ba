"""The avatar moves as the model does, up to what it says that it drops."""

import base64
import json
import math
import re
import shutil
import subprocess
from dataclasses import replace
from importlib.resources import files
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from evsplat.body.rotations import matrix_to_quaternion
from evsplat.capture import load_body_track, load_capture
from evsplat.errors import DataError
from evsplat.export import export_run
from evsplat.export.avatar import (
    FourBones,
    avatar_document,
    avatar_of,
    clip_of,
    four_bones,
    recorded_clip,
)
from evsplat.export.bake import _elsewhere, measure_loss
from evsplat.export.cloud import cloud_of
from evsplat.models.at_rest import SkinnedGaussians, mean_at_rest
from evsplat.render import Splats
from evsplat.training.reconstruction import GaussianReconstruction

from ..body.helpers import reference_bones
from ..small_model import built
from .clouds import SH_C0, covariances, read_ply

SEEDS = pytest.mark.parametrize("seed", [0, 1, 2])


def _views(capture):
    return [(frame.mid_us, capture.camera(frame)) for frame in capture.train_frames]


def _skinned(track, count: int, seed: int) -> SkinnedGaussians:
    rng = np.random.default_rng(seed)
    joints = len(track.body.parents)
    weights = rng.random((count, joints)) ** 3
    weights /= weights.sum(1, keepdims=True)

    def tensor(values) -> torch.Tensor:
        return torch.from_numpy(np.float32(values))

    return SkinnedGaussians(
        track.body,
        tensor(rng.normal(size=(count, 3))),
        torch.nn.functional.normalize(tensor(rng.normal(size=(count, 4))), dim=-1),
        tensor(np.exp(rng.uniform(-6, -3, (count, 3)))),
        tensor(rng.random(count)),
        tensor(rng.random((count, 3))),
        tensor(weights),
        None,
    )


@SEEDS
def test_mean_at_rest_undoes_any_skinning(seed):
    """Closed form: one rest person under random affine maps comes back as it was."""
    rng = np.random.default_rng(seed)
    count, times = 40, 5
    rest, scales = rng.normal(size=(count, 3)), np.exp(rng.uniform(-6, -3, (count, 3)))
    quaternions = rng.normal(size=(count, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    colours = rng.random((times, count, 3))

    def at(times_us, center, *, hard_semantics):
        assert hard_semantics
        maps = np.tile(np.eye(4), (count, 1, 1))
        maps[:, :3] += 0.3 * rng.normal(size=(count, 3, 4))
        world = np.einsum("nij,nj->ni", maps[:, :3, :3], rest) + maps[:, :3, 3]
        signs = rng.choice([-1.0, 1.0], size=(count, 1))
        given = (world, signs * quaternions, scales, np.ones(count), colours[times_us[0]])
        human = Splats(*(torch.from_numpy(values)[None] for values in given))
        human = replace(human, opacities=human.opacities[0])
        return SimpleNamespace(human=human, transforms=torch.from_numpy(maps)[None])

    seen = []
    model = SimpleNamespace(
        track=SimpleNamespace(body=SimpleNamespace(to=lambda device: None)),
        device=torch.device("cpu"),
        at=at,
        skinning_weights=lambda points: seen.append(points) or torch.ones(count, 1),
        surface_light=lambda: None,
    )
    camera = SimpleNamespace(center=lambda: torch.zeros(3))
    mean = mean_at_rest(model, [(time, camera) for time in range(times)])
    np.testing.assert_allclose(mean.means, rest, atol=1e-5)
    np.testing.assert_allclose(mean.scales, scales, rtol=1e-5)
    np.testing.assert_allclose(np.abs((mean.quaternions * quaternions).sum(1)), 1, atol=1e-6)
    np.testing.assert_allclose(mean.rgb, colours.mean(0), atol=1e-6)
    assert torch.equal(seen[0], mean.means)


@pytest.mark.parametrize("method", ["paper", "evsplat", "avatar3dgs", "hugs"])
def test_a_model_without_pose_dependence_is_its_avatar(tiny_capture, method):
    """Before the non-rigid network is switched on skinning is all that moves; HUGS has no more."""
    capture = load_capture(tiny_capture())
    # The person's own shadow is of its pose.
    settings = ("self_shadow=false",) if method == "evsplat" else ()
    model = built(method, capture, *settings).model
    if method == "evsplat":
        with torch.no_grad():
            model.shading.coefficients.normal_(std=0.1)
            model.shading.intensities.normal_(std=0.3)
    source = GaussianReconstruction(method, model)
    frame = capture.frames[8]
    camera = capture.camera(frame)
    mean = source.at_rest(_views(capture))
    (person,) = source.splats(camera, [frame.mid_us], parts="human")
    avatar = mean.posed(source.pose([frame.mid_us])[1])
    want, got = (cloud_of(splats) for splats in (person, avatar))
    np.testing.assert_allclose(got.means, want.means, atol=1e-5)
    shapes = [covariances(cloud.quaternions, cloud.scales) for cloud in (want, got)]
    np.testing.assert_allclose(shapes[1], shapes[0], atol=1e-5 * np.abs(shapes[0]).max())
    np.testing.assert_allclose(got.opacities, want.opacities, atol=1e-6)
    if method in ("hugs", "evsplat"):
        # Colours of their own, under no light or under one that the avatar has.
        np.testing.assert_allclose(got.rgb, want.rgb, atol=1e-5)
        assert (mean.light is None) == (method == "hugs")


@SEEDS
def test_four_bones_in_255ths_are_the_heaviest_and_sum_to_one(reconstruction, seed):
    track = load_body_track(reconstruction[0])
    rng = np.random.default_rng(seed)
    weights = rng.random((300, 9)) ** 4
    weights /= weights.sum(1, keepdims=True)
    gaussians = _skinned(track, 300, seed)
    avatar = avatar_of(replace(gaussians, weights=torch.from_numpy(np.float32(weights))))
    bones, shares = avatar.skin.bones.astype(int), avatar.skin.weights
    assert (shares.astype(int).sum(1) == 255).all()
    want = np.sort(weights, axis=1)[:, -4:]
    got = np.sort(np.take_along_axis(weights, bones, axis=1), axis=1)
    np.testing.assert_allclose(got, want, rtol=1e-6)
    exact = weights[np.arange(300)[:, None], bones] / want.sum(1, keepdims=True)
    assert np.abs(shares / 255 - exact).max() < 1 / 255
    dense = np.zeros((300, 9))
    np.put_along_axis(dense, bones, shares / 255, axis=1)
    np.testing.assert_allclose(avatar.gaussians.weights, dense, atol=1e-7)
    assert avatar.elsewhere is None


@pytest.mark.parametrize("joints", [2, 4])
def test_a_body_of_few_joints_keeps_its_weights(reconstruction, joints):
    gaussians = _skinned(load_body_track(reconstruction[0]), 50, 0)
    weights = torch.rand(50, joints, generator=torch.Generator().manual_seed(0))
    weights /= weights.sum(1, keepdim=True)
    sizes = torch.linspace(0.05, 1, 50)
    avatar = avatar_of(replace(gaussians, weights=weights), (weights.flip(1), sizes))
    assert (avatar.gaussians.weights - weights).abs().max() < 1 / 255
    assert (avatar.elsewhere.skin.dense(joints) - weights.flip(1)).abs().max() < 1 / 255
    assert np.abs(avatar.elsewhere.sizes / 255 - sizes.numpy()).max() <= 0.501 / 255


def test_the_document_has_weights_and_sizes_of_poses_that_were_not_recorded(run):
    """Those with which films draw other motions, where they are others."""
    source = run.reconstruction
    rows = source.model.gaussians.human
    with torch.no_grad():
        source.model.gaussians.scales_log[rows][3] = math.log(0.3)
    page = export_run(run.path, "avatar", out=run.path / "dancer")
    document = json.loads((page.parent / "avatar.json").read_text(encoding="utf-8"))
    means = source.model.gaussians.means[rows]
    moving = source.in_new_motion(source.track).model
    even = moving.skinning_weights(means)
    assert (even - source.model.skinning_weights(means)).abs().max() > 0.01
    elsewhere = document["skin"]["elsewhere"]
    bones, weights = (
        np.frombuffer(base64.b64decode(elsewhere[name]), "u1").reshape(-1, 4)
        for name in ("bones", "weights")
    )
    kept = FourBones(bones.copy(), weights.copy()).dense(even.shape[1])
    assert (kept - four_bones(even).dense(even.shape[1])).abs().max() == 0
    sizes = np.frombuffer(base64.b64decode(elsewhere["sizes"]), "u1") / 255
    drawn, learned = (m.gaussians.scales_log[rows].exp().detach() for m in (moving, source.model))
    assert sizes[3] < 0.5
    np.testing.assert_allclose(sizes[:, None] * learned.numpy(), drawn.numpy(), rtol=0.05)


@pytest.mark.parametrize("smaller", [True, False])
def test_sizes_of_other_motions_are_kept_where_weights_are_the_same(smaller):
    means, weights = torch.zeros(3, 3), torch.ones(3, 1)

    def model(*sizes):
        scales = torch.tensor(sizes)[None, :, None].expand(1, 3, 3)
        human = SimpleNamespace(scales=scales)
        return SimpleNamespace(
            device="cpu",
            skinning_weights=lambda _: weights,
            at=lambda *_, **__: SimpleNamespace(human=human),
        )

    track = SimpleNamespace(times_us=[0])
    new = SimpleNamespace(model=model(0.1, 0.05 if smaller else 0.1, 0.2))
    recorded = model(0.1, 0.1, 0.2)
    source = SimpleNamespace(model=recorded, track=track, in_new_motion=lambda _: new)
    found = _elsewhere(source, SimpleNamespace(means=means, weights=weights))
    if not smaller:
        assert found is None
    else:
        assert torch.equal(found[0], weights)
        torch.testing.assert_close(found[1], torch.tensor([1, 0.5, 1]))


def test_a_body_of_too_many_joints_is_told(reconstruction):
    gaussians = _skinned(load_body_track(reconstruction[0]), 5, 0)
    with pytest.raises(DataError, match="300 joints"):
        avatar_of(replace(gaussians, weights=torch.full((5, 300), 1 / 300)))


def test_the_recorded_clip_is_the_motion_that_the_method_has(reconstruction):
    capture, source = reconstruction
    mids = [frame.mid_us for frame in capture.frames]
    clip = recorded_clip(source, (mids[0], mids[-1]))
    body = source.track.body
    assert len(clip.rotations) == 1 + int((mids[-1] - mids[0]) * 60 / 1e6)
    for key in (0, 5, len(clip.rotations) - 1):
        turns = Rotation.from_quat(clip.rotations[key][:, [1, 2, 3, 0]]).as_matrix()
        rotations = torch.from_numpy(np.float32(turns))
        bones = body.canonical_to_world(rotations, torch.from_numpy(clip.transl[key]))
        want = source.pose([mids[0] + round(key * 1e6 / 60)])[1][0]
        torch.testing.assert_close(bones, want, atol=2e-6, rtol=0)
    # Neighbours on one side: a player may interpolate them as they are.
    assert ((clip.rotations[1:] * clip.rotations[:-1]).sum(-1) > 0).all()


def _decoded(document: dict, key: int) -> np.ndarray:
    """Bones canonical to world of the first clip's key, as docs/export.md says, in float64."""
    skeleton, clip = document["skeleton"], document["clips"][0]

    def numbers(text: str, *shape: int) -> np.ndarray:
        return np.frombuffer(base64.b64decode(text), "<f4").reshape(clip["count"], *shape)

    quaternions = numbers(clip["rotations"], len(skeleton["names"]), 4)[key]
    poses = Rotation.from_quat(quaternions[:, [1, 2, 3, 0]]).as_rotvec()
    transl = numbers(clip["transl"], 3)[key]
    bones = reference_bones(skeleton["parents"], skeleton["rest"], poses, transl)
    return bones @ np.array(skeleton["rest_from_canonical"])


def test_the_document_says_how_the_skeleton_moves(reconstruction):
    capture, source = reconstruction
    track = source.track
    document = _document(capture, source)
    for key in (0, 7):
        want = track.bones([round(key * 1e6 / 60) + int(track.times_us[0])])[0]
        np.testing.assert_allclose(_decoded(document, key), want, atol=2e-6)
    assert document["unit"] == "metre" and sum(np.abs(document["up"])) == 1


def _document(capture, source) -> dict:
    avatar = avatar_of(_skinned(source.track, 20, 3))
    clips = [clip_of("again", source.track)]
    camera = capture.camera(capture.frames[0])
    return avatar_document(
        avatar, clips, track=source.track, camera=camera, transfer="power", facts={"a": 1}
    )


@pytest.mark.skipif(shutil.which("node") is None, reason="needs Node.js to run the page's script")
def test_the_page_moves_the_skeleton_as_the_document_says(reconstruction, tmp_path):
    """skeleton.js between two keys: slerp of the joints, then forward kinematics."""
    document = _document(*reconstruction)
    turn = [20.0, -40.0, 75.0]
    (tmp_path / "document.json").write_text(json.dumps(document))
    script = (files("evsplat") / "data" / "player" / "skeleton.js").read_text(encoding="utf-8")
    script += """
    const { readFileSync } = require("fs");
    const given = JSON.parse(readFileSync(process.argv[2]));
    const floats = (text) => new Float32Array(new Uint8Array(Buffer.from(text, "base64")).buffer);
    const clip = given.clips[0];
    Object.assign(clip, { rotations: floats(clip.rotations), transl: floats(clip.transl) });
    const skeleton = new Skeleton(given.skeleton);
    const plain = skeleton.bones(skeleton.at(clip, 3.25 / clip.rate_hz));
    skeleton.offsets[1] = TURN;
    const turned = skeleton.bones(skeleton.at(clip, 3.25 / clip.rate_hz));
    console.log(JSON.stringify([[...plain], [...turned]]));
    """.replace("TURN", json.dumps(turn))
    (tmp_path / "run.cjs").write_text(script)
    command = ["node", "run.cjs", "document.json"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    got = np.array(json.loads(done.stdout)).reshape(2, -1, 3, 4)

    skeleton, clip = document["skeleton"], document["clips"][0]
    joints = len(skeleton["names"])
    rotations = np.frombuffer(base64.b64decode(clip["rotations"]), "<f4").reshape(-1, joints, 4)
    transl = np.frombuffer(base64.b64decode(clip["transl"]), "<f4").reshape(-1, 3)
    ends = [Rotation.from_quat(rotations[k][:, [1, 2, 3, 0]]) for k in (3, 4)]
    between = ends[0] * Rotation.from_rotvec(0.25 * (ends[0].inv() * ends[1]).as_rotvec())
    place = 0.75 * transl[3] + 0.25 * transl[4]
    for moved, extra in zip(got, ([0, 0, 0], turn), strict=True):
        offsets = np.zeros((joints, 3))
        offsets[1] = extra
        poses = (between * Rotation.from_rotvec(np.radians(offsets))).as_rotvec()
        bones = reference_bones(skeleton["parents"], skeleton["rest"], poses, place)
        want = bones @ np.array(skeleton["rest_from_canonical"])
        np.testing.assert_allclose(moved[:-1], want[:, :3], atol=1e-5)
        # What follows no bone stays.
        np.testing.assert_array_equal(moved[-1], np.eye(4)[:3])


@pytest.mark.skipif(shutil.which("node") is None, reason="needs Node.js to run the page's script")
def test_the_page_shares_correctives_as_we_do(reconstruction, tmp_path):
    """skeleton.js against `Correctives.shares`, at recorded poses and beside them."""
    capture, source = reconstruction
    rest = source.with_correctives(source.at_rest(_views(capture)), _views(capture))
    assert rest.correctives is not None
    avatar = avatar_of(rest)
    camera = capture.camera(capture.frames[0])
    document = avatar_document(
        avatar, [], track=source.track, camera=camera, transfer="power", facts={}
    )
    rotations = source.pose([frame.mid_us for frame in capture.frames[:3]])[0]
    turns = Rotation.from_rotvec([0.1, -0.2, 0.05]).as_matrix()
    rotations = torch.cat([rotations, rotations @ torch.from_numpy(turns).float()])
    quaternions = matrix_to_quaternion(rotations.double())
    given = {"correctives": document["correctives"], "poses": quaternions.tolist()}
    (tmp_path / "given.json").write_text(json.dumps(given))
    script = (files("evsplat") / "data" / "player" / "skeleton.js").read_text(encoding="utf-8")
    script += """
    const { readFileSync } = require("fs");
    const given = JSON.parse(readFileSync("given.json"));
    const bytes = new Uint8Array(Buffer.from(given.correctives.linear, "base64"));
    const made = new Correctives({ ...given.correctives, linear: new Float32Array(bytes.buffer) });
    console.log(JSON.stringify(given.poses.map((pose) => made.shares(pose))));
    """
    (tmp_path / "run.cjs").write_text(script)
    done = subprocess.run(["node", "run.cjs"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    want = rest.correctives.shares(rotations)
    torch.testing.assert_close(torch.tensor(json.loads(done.stdout)), want, atol=1e-5, rtol=1e-4)


def test_correctives_bring_the_avatar_to_the_model(reconstruction):
    """An untrained own shadow darkens with the pose: skinning drops that, the fields keep it."""
    capture, source = reconstruction
    with torch.no_grad():
        source.model.shading.intensities.fill_(0.5)
    rest = source.at_rest(_views(capture))
    views = [(frame.mid_us, capture.camera(frame)) for frame in capture.frames]
    plain = measure_loss(source, avatar_of(rest), capture)
    kept = measure_loss(source, avatar_of(source.with_correctives(rest, views)), capture)
    assert kept.avatar_to_model.person > plain.avatar_to_model.person + 1
    assert "8 correctives" in kept.sentence()


def test_loss_is_that_of_the_avatar_and_nothing_else(reconstruction):
    capture, source = reconstruction
    avatar = avatar_of(source.at_rest(_views(capture)))
    loss = measure_loss(source, avatar, capture)
    assert loss.frames == len([f for f in capture.frames if f.split == "test"])
    assert loss.model_to_truth is not None and loss.avatar_to_truth is not None
    assert f"{loss.avatar_to_model.person:.2f} dB" in loss.sentence()
    # Colours far off must show, on the person more than on the frame.
    wrong = replace(avatar, gaussians=replace(avatar.gaussians, rgb=1 - avatar.gaussians.rgb))
    worse = measure_loss(source, wrong, capture)
    assert worse.avatar_to_model.person < loss.avatar_to_model.person - 3
    assert worse.avatar_to_model.person < worse.avatar_to_model.full
    assert worse.model_to_truth == loss.model_to_truth


def test_a_frame_in_which_nobody_is_drawn_leaves_the_loss_finite(reconstruction, monkeypatch):
    """Its mask is where somebody was seen, and poses may be far off."""
    capture, source = reconstruction
    avatar = avatar_of(source.at_rest(_views(capture)))
    last, camera_of = capture.test_frames[-1], capture.camera

    def turned_away(frame):
        camera = camera_of(frame)
        if frame is not last:
            return camera
        behind = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
        return replace(camera, world_to_camera=behind @ camera.world_to_camera)

    monkeypatch.setattr(capture, "camera", turned_away)
    loss = measure_loss(source, avatar, capture)
    assert loss.frames == len(capture.test_frames)
    assert math.isfinite(loss.avatar_to_model.person) and math.isfinite(loss.avatar_to_model.full)


def test_the_package_is_complete_and_needs_no_network(run):
    run.capture.name = "two </script> <!--<script> ends"
    page = export_run(run.path, "avatar", parts="all", out=run.path / "dancer")
    assert page == run.path / "dancer" / "index.html"
    names = {path.name for path in page.parent.iterdir()}
    assert names == {"index.html", "avatar.json", "gaussians.ply", "scene.ply", "README.txt"}
    text = page.read_text(encoding="utf-8")
    assert not re.search(r"""https?:|\bsrc=|\bhref=|\bimport\b|url\(""", text)
    assert text.count("<script") == text.count("</script>") == 2
    (data,) = re.findall(r'id="data">(.*?)</script>', text, re.DOTALL)
    embedded = json.loads(data)
    document = json.loads((page.parent / "avatar.json").read_text(encoding="utf-8"))
    assert {key: embedded[key] for key in document} == document
    assert document["capture"] == run.capture.name
    assert [clip["name"] for clip in document["clips"]] == ["recorded"]
    assert "Dropped" in document["note"] and document["loss_db"]["frames"] == 3
    rows = np.frombuffer(base64.b64decode(embedded["person"]["values"]), "<f4").reshape(-1, 14)
    assert len(rows) == embedded["person"]["count"] == document["skin"]["count"] == 150
    frame = run.capture.frames[0]
    (scene,) = run.reconstruction.splats(run.capture.camera(frame), [frame.mid_us], parts="scene")
    around = np.frombuffer(base64.b64decode(embedded["scene"]["values"]), "<f4").reshape(-1, 14)
    np.testing.assert_allclose(around[:, :3], cloud_of(scene).means, atol=1e-6)
    with pytest.raises(DataError, match="already"):
        export_run(run.path, "avatar", out=run.path / "dancer")


def test_files_of_light_are_coded_and_the_page_is_told(run):
    described = run.capture.path / "capture.json"
    document = json.loads(described.read_text(encoding="utf-8"))
    for camera in document["cameras"].values():
        camera["transfer"] = "linear"
    described.write_text(json.dumps(document), encoding="utf-8")
    run.capture = load_capture(run.capture.path)
    page = export_run(run.path, "avatar", parts="all", out=run.path / "dancer")
    text = page.read_text(encoding="utf-8")
    (data,) = re.findall(r'id="data">(.*?)</script>', text, re.DOTALL)
    embedded = json.loads(data)
    assert embedded["transfer"] == "linear"
    for name, file in (("person", "gaussians.ply"), ("scene", "scene.ply")):
        rows = np.frombuffer(base64.b64decode(embedded[name]["values"]), "<f4").reshape(-1, 14)
        light = rows[:, 11:].astype(np.float64).clip(0)
        # IEC 61966-2-1.
        want = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
        _, columns = read_ply(page.parent / file)
        got = 0.5 + SH_C0 * np.stack([columns[f"f_dc_{k}"] for k in range(3)], axis=1)
        np.testing.assert_allclose(got, want, atol=1e-5)


def test_the_person_at_rest_is_a_file_too(run):
    path = export_run(run.path, "ply", canonical=True)
    assert path.name == "canonical.ply"
    _, columns = read_ply(path)
    mean = run.reconstruction.at_rest(_views(run.capture))
    centres = np.stack([columns[axis] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(centres, mean.means, atol=1e-6)
    scales = np.exp(np.stack([columns[f"scale_{k}"] for k in range(3)], 1))
    got = covariances(np.stack([columns[f"rot_{k}"] for k in range(4)], 1), scales)
    want = covariances(mean.quaternions.numpy(), mean.scales.numpy())
    np.testing.assert_allclose(got, want, atol=1e-7)
