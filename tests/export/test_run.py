"""Which Gaussians of a run leave it, and what is said where that cannot be."""

from ast import literal_eval
from dataclasses import replace

import numpy as np
import pytest
import torch

from evsplat.body import up_axis
from evsplat.body.smpl_skeleton import JOINTS
from evsplat.capture import load_body_track
from evsplat.errors import ConfigError, DataError
from evsplat.export import export_run
from evsplat.models.smoothing import widened
from evsplat.models.solid_scene import SolidScene
from evsplat.render import render

from .clouds import read_ply


@pytest.mark.parametrize("parts", ["all", "human", "scene"])
def test_splats_draw_what_the_reconstruction_draws(reconstruction, parts):
    capture, model = reconstruction
    with torch.no_grad():
        # No light, no shadow: what is left is exact.
        model.model.shadow.share_logits.fill_(-50.0)
    frame = capture.frames[3]
    camera, times = capture.camera(frame), [frame.mid_us, frame.mid_us + 20_000]
    want = model.render(camera, times, parts=parts)
    layers = model.splats(camera, times, parts=parts)
    assert len(layers) == (2 if parts == "all" else 1)
    for time in range(2):
        one = [
            type(layer)(
                **{
                    k: None if v is None else v[min(time, len(v) - 1)][None]
                    for k, v in vars(layer.with_times()).items()
                }
            )
            for layer in layers
        ]
        still = one[1] if len(one) == 2 else None
        drawn = render(one[0], camera, static=still, low_pass=model.low_pass)
        torch.testing.assert_close(
            drawn.image[0, ..., :3].clamp(0, 1), want.rgb[time], atol=1e-5, rtol=0
        )
        torch.testing.assert_close(drawn.alpha[0], want.alpha[time], atol=1e-5, rtol=0)


def test_a_shadow_darkens_the_colours_of_the_scene(reconstruction, monkeypatch):
    capture, model = reconstruction
    frame = capture.frames[3]
    camera, times = capture.camera(frame), [frame.mid_us, frame.mid_us + 20_000]
    plain = model.splats(camera, times, parts="scene")[0].channels
    factors = torch.tensor([0.25, 0.75])[:, None, None]
    monkeypatch.setattr(
        model.model.shadow,
        "forward",
        lambda body, places, lamps: factors.expand(-1, *places.shape[:2]),
    )
    person, scene = model.splats(camera, times)
    torch.testing.assert_close(scene.channels[..., :3], plain[..., :3] * factors)
    assert torch.equal(scene.channels[..., 3], plain[..., 3].expand(2, -1))
    assert (person.channels[..., 3] == 1).all()


def test_ply_of_a_run_is_the_instant_asked_for_in_metres(run, reconstruction):
    capture, model = reconstruction
    frame = capture.frames[4]
    path = export_run(run.path, "ply", frame=frame.name)
    assert path == run.path / "exports" / f"frame-{frame.name}.ply"
    comments, columns = read_ply(path)
    assert f"time_us: {frame.mid_us}" in comments and "unit: metre" in comments
    person, scene = model.splats(capture.camera(frame), [frame.mid_us])
    centres = np.stack([columns[axis] for axis in "xyz"], axis=1)
    want = torch.cat([person.means[0], scene.means[0]]).detach().numpy()
    np.testing.assert_allclose(centres, want, atol=1e-6)
    assert (columns["semantic"][:150] == 1).all() and (columns["semantic"][150:] == 0).all()

    later = export_run(run.path, "ply", time_s=0.04, out=run.path / "later.ply", parts="human")
    comments, columns = read_ply(later)
    time_us = capture.frames[0].mid_us + 40_000
    assert f"time_us: {time_us}" in comments
    (person,) = model.splats(capture.camera(capture.frames[1]), [time_us], parts="human")
    np.testing.assert_allclose(columns["z"], person.means[0, :, 2].numpy(), atol=1e-6)


def test_files_hold_the_solid_scene(run, reconstruction):
    _, model = reconstruction
    as_trained = {"low_pass": model.low_pass}
    _, learned = read_ply(export_run(run.path, "ply", **as_trained))
    count = len(learned["x"]) - 150
    generator = torch.Generator().manual_seed(0)
    scales = 0.1 + torch.rand(count, 3, generator=generator)
    opacities, rgb = torch.rand(count, 4, generator=generator).split((1, 3), 1)
    turned = torch.eye(4)[:1].expand(count, 4)
    run.reconstruction = replace(model, solid=SolidScene(turned, scales, opacities[:, 0], rgb))
    _, made = read_ply(export_run(run.path, "ply", out=run.path / "solid.ply", **as_trained))
    found = 1 / (1 + np.exp(-made["opacity"][150:]))
    np.testing.assert_allclose(found, opacities[:, 0].numpy(), atol=1e-5)
    np.testing.assert_allclose(np.exp(made["scale_1"][150:]), scales[:, 1].numpy(), rtol=1e-5)
    for name, column in learned.items():
        rows = slice(None) if name in "xyz" else slice(150)
        np.testing.assert_array_equal(made[name][rows], column[rows])


def test_a_pose_file_without_a_rate_is_exported_at_the_one_that_is_given(
    run, tmp_path, monkeypatch
):
    path = tmp_path / "mine.npz"
    poses = np.zeros((4, 3 * JOINTS["smpl"]))
    np.savez(path, poses=poses, trans=np.zeros((4, 3)), betas=np.zeros(10))
    with pytest.raises(ConfigError, match="give --motion-fps"):
        export_run(run.path, "bvh", motion=str(path))
    asked = []

    def load(name, recorded, *, fps):
        asked.append((name, fps))
        return recorded

    monkeypatch.setattr("evsplat.export.skeleton.load_motion_of", load)
    export_run(run.path, "bvh", motion=str(path), motion_fps=20.0)
    assert asked == [(str(path), 20.0)]


@pytest.mark.parametrize(("up", "axis"), [("y", (0, 1, 0)), ("z", (0, 0, 1))])
def test_up_turns_the_world_and_says_how(run, up, axis):
    _, plain = read_ply(export_run(run.path, "ply"))
    comments, turned = read_ply(export_run(run.path, "ply", up=up, out=run.path / "up.ply"))
    (line,) = [text for text in comments if text.startswith("world_to_file_rotation: ")]
    rotation = np.array(literal_eval(line.partition(": ")[2]))
    world_up = up_axis(load_body_track(run.capture)).numpy()
    np.testing.assert_allclose(rotation @ world_up, axis, atol=1e-6)
    before, after = (np.stack([file[a] for a in "xyz"], axis=1) for file in (plain, turned))
    np.testing.assert_allclose(after, before @ rotation.T, atol=1e-5)


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        ("obj", {}, "obj: unknown format; choose one of ply"),
        ("ply", {"out": "a.spz"}, "ends in .ply"),
        ("ply", {"frame": "nothing"}, "no such frame; they are 0000 to 0009"),
        ("ply", {"time_s": -0.1}, "expected 0 to 0.36 s"),
        ("ply", {"time_s": 0.1, "frame": "0000"}, "give one of them"),
        ("ply", {"camera": "left"}, "only main, side"),
        ("spz", {"up": "z"}, "RUB"),
        ("gltf", {"up": "z"}, r"\+Y up"),
        ("html", {"frame": "0000"}, "^--frame: format html has no use"),
        ("bvh", {"parts": "human"}, "^--parts: format bvh has no use"),
        ("skeleton", {"camera": "cam"}, "^--camera: format skeleton has no use"),
        ("avatar", {"up": "y"}, "--up: format avatar has no use"),
        ("avatar", {"canonical": True}, "--canonical: format avatar has no use"),
        ("ply", {"motion": "walk"}, "--motion: format ply has no use"),
        ("ply", {"canonical": True, "time_s": 0.1}, "at no time"),
        ("ply", {"canonical": True, "low_pass": 0.3}, "--low-pass: .*--canonical"),
        ("avatar", {"parts": "scene"}, "no skeleton"),
        ("avatar", {"out": "a.ply"}, "ends in .html or is a folder"),
        ("avatar", {"motion": "swimming"}, "neither a file nor one of"),
        ("avatar", {"camera": "left"}, "only main, side"),
        ("gltf", {"fps": 30.0}, "--fps: format gltf has no use"),
        ("bvh", {"motion_fps": 30.0}, "--motion-fps: goes with --motion"),
        ("bvh", {"motion": "walk", "motion_fps": 30.0}, "--motion-fps 30: motion walk has times"),
        ("html", {"fps": 0.1}, "--fps 0.1: expected a number within 1 and 120"),
    ],
)
def test_bad_options_are_one_sentence_and_write_nothing(run, kind, options, message):
    with pytest.raises((ConfigError, DataError), match=message):
        export_run(run.path, kind, **options)
    assert not list(run.path.iterdir())


@pytest.mark.parametrize("out", [None, "mine"])
def test_an_avatar_that_is_there_is_told_before_the_work(run, monkeypatch, tmp_path, out):
    def worked(*arguments, **options):
        raise AssertionError("the run was read")

    monkeypatch.setattr("evsplat.export.run.opened", worked)
    folder = run.path / "exports" / "avatar" if out is None else tmp_path / out
    folder.mkdir(parents=True)
    (folder / "index.html").touch()
    with pytest.raises(DataError, match="already"):
        export_run(run.path, "avatar", out=None if out is None else folder)
    assert [path.name for path in folder.iterdir()] == ["index.html"]


def test_larger_pictures_show_gaussians_as_wide_as_the_recorded_ones(reconstruction):
    """In films and elsewhere; pictures of the recorded size stay bit for bit."""
    capture, model = reconstruction
    frame = capture.frames[3]
    camera, time = capture.camera(frame), [frame.mid_us]
    model = replace(model, recorders=(camera,))
    larger = camera.resized(4 * camera.width, 4 * camera.height)
    for shown in (
        model.at_any_size(),
        model.elsewhere(),
        model.at_any_size().following(model.track),
    ):
        assert torch.equal(shown.render(camera, time).rgb, model.render(camera, time).rgb)
        for made, thin in zip(shown.splats(larger, time), model.splats(larger, time), strict=True):
            wide = widened(thin, model.low_pass, larger, [camera])
            assert (wide.scales > thin.scales).all()
            torch.testing.assert_close(made.scales, wide.scales)
