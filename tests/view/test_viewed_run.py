"""A run as the viewer draws it: still pictures are those of the run, whatever was drawn before."""

import json
import shutil
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from evsplat.capture import load_capture
from evsplat.errors import DataError
from evsplat.film import Look
from evsplat.film.surroundings import CalmRoom
from evsplat.training.reconstruction import GaussianReconstruction
from evsplat.training.run import Run
from evsplat.training_sign import training_in
from evsplat.view import viewed_run
from evsplat.view.compositor import comparisons
from evsplat.view.posing import HeldPose, PoseSlider, turned
from evsplat.view.request import Motion
from evsplat.view.viewed_run import ViewedRun, load_newest

from ..small_model import built, small_config

DEFORMED = {
    "paper": ("networks.non_rigid_start=0",),
    "evsplat": ("shade_start=0",),
    "hugs": (),
}


@pytest.fixture(name="run", params=DEFORMED)
def _run(tiny_capture, request, rng):
    """A run of a method whose networks say something."""
    torch.manual_seed(int(rng.integers(1 << 31)))
    method, capture = request.param, load_capture(tiny_capture())
    config = small_config(method, *DEFORMED[method])
    model = built(method, capture, *DEFORMED[method]).model
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if "logits" not in name:
                parameter.add_(0.05 * torch.randn_like(parameter))
    rows = model.sets.values()
    counts = {
        "human": sum(part.human_count for part in rows),
        "scene": sum(part.scene_count for part in rows),
    }
    made = GaussianReconstruction(method, model)
    facts = (capture, made, 0, 0.0, "cpu", counts, False)
    return Run(Path("none"), config, method, config.policy, *facts)


def _views(run):
    """Instants and cameras, back and forth, as somebody looks around."""
    cameras, frames = list(run.capture.cameras.values()), run.capture.frames
    for camera in (cameras[0], cameras[1], cameras[0]):
        for frame in (frames[0], frames[2], frames[3], frames[0]):
            yield camera, frame.mid_us


def test_a_still_picture_is_that_of_the_run_bit_for_bit(run):
    viewed, look, motion = ViewedRun(run, "it"), Look(), Motion()
    for camera, time_us in _views(run):
        for _ in range(3):
            viewed.picture(camera, time_us + 500, motion, look, draft=True)
        found = viewed.picture(camera, time_us, motion, look, draft=False)
        expected = run.reconstruction.render(camera, [time_us]).rgb[0].numpy()
        assert np.array_equal(found, expected)


def test_a_window_with_more_pixels_than_were_recorded_shows_gaussians_as_wide(run):
    camera, time_us = next(_views(run))
    made = replace(run.reconstruction, recorders=(camera,))
    viewed = ViewedRun(replace(run, reconstruction=made), "it")
    window = camera.resized(3 * camera.width, 3 * camera.height)
    found = viewed.picture(window, time_us, Motion(), Look(), draft=False)
    assert np.array_equal(found, made.at_any_size().render(window, [time_us]).rgb[0].numpy())
    assert not np.array_equal(found, made.render(window, [time_us]).rgb[0].numpy())


def test_drafts_of_a_view_that_stands_still_become_its_picture(run):
    viewed, look, motion = ViewedRun(run, "it"), Look(), Motion()
    (camera, first), (_, second), *_ = _views(run)
    # Shadows stay a little softer.
    drafted = replace(run.reconstruction, shadow_step_px=4)
    expected = drafted.render(camera, [second]).rgb[0].numpy()
    viewed.picture(camera, first, motion, look, draft=False)
    errors = []
    for _ in range(40):
        draft = viewed.picture(camera, second, motion, look, draft=True)
        errors.append(np.abs(draft - expected).mean())
    start = run.reconstruction.render(camera, [first]).rgb[0].numpy()
    assert errors[0] < 0.5 * np.abs(start - expected).mean()
    assert errors[-1] < 1e-6


@pytest.mark.parametrize("run", ["hugs"], indirect=True)
def test_what_neither_pose_nor_view_changes_is_computed_once(run):
    computed = []
    for name in ("triplane", "skinning", "geometry", "appearance"):
        network = getattr(run.reconstruction.model.human, name)
        network.register_forward_hook(lambda *_, name=name: computed.append(name))
    viewed = ViewedRun(run, "it")
    for camera, time_us in _views(run):
        viewed.picture(camera, time_us, Motion(), Look(), draft=False)
    assert sorted(computed) == ["appearance", "geometry", "skinning", "triplane"]


def test_gaussians_of_an_instant_are_those_that_are_drawn(run):
    viewed = ViewedRun(run, "it")
    # The body of the small capture has no limbs that are recognised.
    slider = PoseSlider("arm", "bend", (2,), np.array([0.0, 0.0, 1.0]), False, 60)
    viewed.__dict__["sliders"] = (slider,)
    (camera, time_us), *_ = _views(run)
    angles = (30.0,)
    viewed.picture(camera, time_us, Motion(None, angles), Look(), draft=True)
    cloud = viewed.cloud(camera, time_us, Motion(None, angles), "human")
    track = run.reconstruction.track
    rotations, transl = track.at([time_us])
    pose = HeldPose(track)
    pose.hold(turned(viewed.sliders, angles, rotations[0])[None], transl)
    model = run.reconstruction.in_new_motion(pose).model
    with torch.no_grad():
        expected = model.at([time_us], camera.center(), hard_semantics=True).human
    np.testing.assert_allclose(cloud.means, expected.means[0].numpy(), atol=1e-6)
    at_rest = viewed.cloud(camera, time_us, Motion(), "human")
    assert np.abs(at_rest.means - cloud.means).max() > 0.02
    np.testing.assert_allclose(cloud.rgb, expected.channels[0, :, :3].numpy(), atol=1e-6)
    everything = viewed.cloud(camera, time_us, Motion(), "all")
    assert len(everything) == run.gaussians["human"] + run.gaussians["scene"]
    assert everything.semantic.sum() == run.gaussians["human"]


def test_from_elsewhere_holes_show_a_room_and_the_rest_what_films_show(run):
    viewed, time_us = ViewedRun(run, "it"), run.capture.frames[0].mid_us
    camera = next(iter(run.capture.cameras.values()))
    turned_away = camera.world_to_camera.clone()
    turned_away[[0, 2]] *= -1
    away = replace(camera, world_to_camera=turned_away)
    empty = viewed.picture(away, time_us, Motion(), Look(), draft=False, elsewhere=True)
    assert empty.min() > 0.2
    track = run.reconstruction.track
    recording = camera if run.capture.is_static_camera else None
    room = CalmRoom.of(track, track, recording)
    assert np.abs(empty - room.behind(away, time_us).numpy()).max() < 0.05
    drawn = run.reconstruction.elsewhere(room.clear, room.soften)
    drawn = replace(drawn, backdrop=None)
    expected = Look(surroundings=room).expose(drawn, camera, [time_us])[0] / 255
    found = viewed.picture(camera, time_us, Motion(), Look(), draft=False, elsewhere=True)
    assert np.abs(found - expected).max() < 0.05


def test_recorded_pictures_that_are_taken_as_sharp_are_one_choice_to_compare_with(tiny_capture):
    path = tiny_capture()
    assert comparisons(load_capture(path), ["b"]) == ["blurry input", "sharp truth", "b"]
    for picture in (path / "images").iterdir():
        shutil.copy(picture, path / "sharp")
    assert comparisons(load_capture(path), ["b"]) == ["recorded picture", "b"]
    shutil.rmtree(path / "sharp")
    document = json.loads((path / "capture.json").read_text())
    for frame in document["frames"]:
        del frame["sharp"]
    (path / "capture.json").write_text(json.dumps(document))
    assert comparisons(load_capture(path), []) == ["blurry input"]


def test_a_training_that_ends_before_its_first_step_is_waited_for_and_told(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(viewed_run, "_POLL_S", 0.01)
    begun, failed, waiting = threading.Event(), threading.Event(), threading.Event()
    monkeypatch.setattr(viewed_run, "watch", lambda path: waiting.set())

    def train():
        with training_in(tmp_path / "run"):
            begun.set()
            failed.wait(60)

    training = threading.Thread(target=train)
    training.start()
    assert begun.wait(60)
    fail = threading.Thread(target=lambda: (waiting.wait(60), failed.set()))
    fail.start()
    with pytest.raises(DataError, match="ended before its first step"):
        load_newest(tmp_path / "run", "cpu")
    training.join()
    fail.join()
    told = capsys.readouterr().out
    assert told.count("waiting for it") == 1
