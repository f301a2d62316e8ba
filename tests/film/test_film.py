"""Films from start to end: options that contradict, stopping and going on, light and events."""

import json
import os
import signal
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image, ImageSequence

from evsplat.body import BodyTrack, up_axis
from evsplat.capture import load_body_track, load_capture
from evsplat.errors import ConfigError, DataError, OutputError
from evsplat.events import open_recording
from evsplat.export import render_run, rendering
from evsplat.film import Film, FilmPlan, Look, plan
from evsplat.film.camera_path import camera_path_document
from evsplat.film.frame_cache import FilmFrame, FrameCache
from evsplat.methods.reconstruction import Rendering
from evsplat.pictures.video import write_animation

from ..limits import files_of_at_most

LAST_US = 9 * 40_000


class _Lamp:
    """Light that rises exponentially in time, the same for all pixels; a person at the left."""

    name = "lamp"

    def __init__(self, track: BodyTrack) -> None:
        self.track = track
        self.drawn: list[int] = []
        self.stop_after: int | None = None

    def render(self, camera, times_us, *, parts="all"):
        if self.stop_after is not None and len(self.drawn) >= self.stop_after:
            raise KeyboardInterrupt
        self.drawn += times_us
        linear = 0.05 * torch.exp(torch.tensor(times_us) / LAST_US * 2.0)
        shape = (len(times_us), camera.height, camera.width)
        alpha = torch.zeros(shape)
        alpha[..., : camera.width // 2] = 0.5
        rgb = (linear ** (1 / 2.2))[:, None, None, None].expand(*shape, 3)
        if parts == "human":
            rgb = rgb * alpha[..., None]
        return Rendering(rgb, alpha, alpha)

    def in_new_motion(self, track):
        return _Lamp(track)

    def elsewhere(self, *changes):
        return self

    at_any_size = elsewhere


@pytest.fixture
def lamp(tiny_capture, tmp_path, monkeypatch):
    """A run folder, its capture and its reconstruction."""
    capture = load_capture(tiny_capture())
    lamp = _Lamp(load_body_track(capture))
    loaded = SimpleNamespace(
        capture=capture, reconstruction=lamp, method="lamp", iteration=1, train_seconds=1.0
    )
    monkeypatch.setattr(rendering, "opened", lambda path, **_: loaded)
    return SimpleNamespace(run=tmp_path / "run", capture=capture, lamp=lamp, loaded=loaded)


def test_a_stopped_film_goes_on_where_it_was_and_equals_an_uninterrupted_one(lamp, tmp_path):
    whole = render_run(lamp.run, fps=100, out=tmp_path / "whole")
    count, lamp.lamp.drawn = len(lamp.lamp.drawn), []
    lamp.lamp.stop_after = count // 2
    out = tmp_path / "film"
    with pytest.raises(KeyboardInterrupt, match=rf"of {count} pictures are kept in .*partial"):
        render_run(lamp.run, fps=100, out=out)
    assert not out.exists()
    kept = len(list((tmp_path / "film.partial").glob("*.png")))
    assert 0 < kept < count
    lamp.lamp.stop_after, lamp.lamp.drawn = None, []
    render_run(lamp.run, fps=100, out=out)
    assert len(lamp.lamp.drawn) == count - kept
    assert not (tmp_path / "film.partial").exists()
    for path in whole.iterdir():
        assert (out / path.name).read_bytes() == path.read_bytes()


def test_pictures_of_other_options_or_a_further_trained_run_are_not_taken(lamp, tmp_path):
    behind = tmp_path / "behind.png"
    for change in ("options", "training", "background"):
        Image.new("RGB", (4, 4), "white").save(behind)
        background = str(behind) if change == "background" else None
        lamp.lamp.drawn, lamp.lamp.stop_after = [], 8
        with pytest.raises(KeyboardInterrupt):
            render_run(lamp.run, fps=100, out=tmp_path / change, background=background)
        lamp.lamp.drawn, lamp.lamp.stop_after = [], None
        Image.new("RGB", (4, 4), "grey").save(behind)
        lamp.loaded.iteration += change == "training"
        fps = 50 if change == "options" else 100
        render_run(lamp.run, fps=fps, out=tmp_path / change, background=background)
        assert len(lamp.lamp.drawn) == 1 + LAST_US * fps // 10**6


def test_events_of_exponential_light_come_at_an_even_rate(lamp, tmp_path):
    out, file = tmp_path / "events", tmp_path / "events.h5"
    render_run(lamp.run, show="events", fps=25, event_hz=400, out=out, events_out=file)
    camera = lamp.capture.cameras["main"]
    events = open_recording(file).read()
    # ln(0.05 e^(2 t)) with 1e-3 added rises by a little less than 2; thresholds are 0.2.
    rise = np.log(0.05 * np.exp(2) + 1e-3) - np.log(0.05 + 1e-3)
    pixels = camera.width * camera.height
    assert len(events) == pytest.approx(pixels * int(rise / 0.2), abs=pixels)
    assert (events.p == 1).all()
    per_pixel = np.diff(events.t[(events.x == 3) & (events.y == 4)])
    # The first thresholds take longer, for the 1e-3 counts for more in the dark.
    np.testing.assert_allclose(per_pixel[1:], 0.2 * LAST_US / 2, rtol=0.03)
    names = sorted(path.name for path in out.iterdir())
    assert names == [f"{index:05d}.png" for index in range(9)]
    picture = np.asarray(Image.open(out / names[1]))
    assert (picture[..., 0] >= picture[..., 2]).all()


@pytest.mark.parametrize(("event_hz", "slow"), [(60, 1), (110, 2), (75, 1), (10, 1)])
def test_events_are_made_of_no_fewer_pictures_a_second_than_asked_for(
    lamp, tmp_path, event_hz, slow
):
    """Of a whole number of them between two frames of the film, as few as that takes."""
    render_run(
        lamp.run, show="events", fps=25, slow=slow, event_hz=event_hz, out=tmp_path / "events"
    )
    steps_us = np.diff(sorted(set(lamp.lamp.drawn)))
    frames_hz = 25 * slow
    per_frame = next(count for count in range(1, 99) if count * frames_hz >= event_hz)
    np.testing.assert_allclose(steps_us, 1e6 / (per_frame * frames_hz), atol=1)


def test_beside_events_stand_the_recorded_ones(lamp, tmp_path):
    out = render_run(lamp.run, show="events", beside=True, fps=25, event_hz=50, out=tmp_path / "e")
    camera = lamp.capture.cameras["main"]
    first = np.asarray(Image.open(out / "00000.png"))
    assert first.shape == (camera.height, 2 * camera.width, 3)
    frames = sorted(lamp.capture.frames, key=lambda frame: frame.mid_us)
    recorded = lamp.capture.events.between(frames[0].mid_us, frames[0].mid_us + 40_000)
    signed = np.zeros((camera.height, camera.width))
    np.add.at(signed, (recorded.y, recorded.x), recorded.p)
    left = first[:, : camera.width].astype(int)
    assert ((left[..., 0] > left[..., 2])[signed > 0]).all()
    assert ((left[..., 0] < left[..., 2])[signed < 0]).all()


@pytest.mark.parametrize("ending", ["", ".webp", ".gif"])
def test_a_cut_out_person_keeps_colour_and_transparency(lamp, tmp_path, ending):
    out = tmp_path / f"person{ending}"
    render_run(lamp.run, parts="human", transparent=True, fps=10, out=out)
    if ending:
        pictures = [f.convert("RGBA") for f in ImageSequence.Iterator(Image.open(out))]
    else:
        pictures = [Image.open(path) for path in sorted(out.iterdir())]
    picture = np.asarray(pictures[0]).astype(int)
    half = picture.shape[1] // 2
    assert (picture[:, half + 2 :, 3] == 0).all()
    alpha = {"": 128, ".webp": 128, ".gif": 255}[ending]
    inside = picture[2:-2, 2 : half - 2]
    assert np.abs(inside[..., 3] - alpha).max() <= 2
    start = lamp.capture.frames[0].mid_us / LAST_US
    level = (0.05 * np.exp(2 * start)) ** (1 / 2.2) * 255
    assert np.abs(inside[..., :3] - level).max() < 4


def test_a_held_moment_is_one_time_from_many_places(lamp, tmp_path):
    out = render_run(lamp.run, at=0.1, seconds=0.5, fps=10, path="swing", out=tmp_path / "held")
    assert len(list(out.iterdir())) == 6
    assert set(lamp.lamp.drawn) == {lamp.capture.frames[0].mid_us + 100_000}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"transparent": True, "out": "a.mp4"}, "--transparent: mp4"),
        ({"transparent": True, "beside": True}, "--beside"),
        ({"show": "depth", "transparent": True}, "--transparent"),
        ({"motion": "walk", "beside": True}, "--beside"),
        ({"show": "events", "at": 0.1, "beside": True}, "--beside: no events were recorded"),
        ({"show": "depth", "beside": True, "out": "folder"}, "--beside: a folder holds depth"),
        ({"motion_fps": 20.0}, "--motion-fps: goes with --motion"),
        ({"in_place": True}, "--in-place: goes with --motion"),
        ({"motion": "walk", "motion_fps": 60.0}, "--motion-fps 60: motion walk has times of its"),
        ({"motion": "walk", "motion_fps": 0.0}, "--motion-fps 0: expected a number within"),
        ({"sensor": "davis346"}, "--sensor: goes with --show events"),
        ({"event_hz": 400.0, "show": "depth"}, "--event-hz: goes with --show events"),
        ({"what": "test", "slow": 4.0}, "--slow: films the sequence"),
        ({"at": 99.0}, "--at 99: expected 0 to .* s from the first mid-exposure"),
        ({"at": -0.01}, "--at -0.01: expected 0 to"),
        ({"at": 0.1, "slow": 2.0}, "--slow"),
        ({"what": "test", "path": "orbit"}, "--path: films the sequence"),
        ({"what": "test", "show": "events"}, "--show events: films the sequence"),
        ({"path": "nowhere.json"}, "--path nowhere.json"),
        ({"events_out": "e.h5"}, "--events: goes with --show events"),
        ({"events_out": "e.foo", "show": "events"}, "e.foo: the suffix names no format"),
        ({"fps": 60.0, "out": "a.gif"}, "a GIF plays"),
        ({"seconds": 0.0}, "--seconds 0"),
    ],
)
def test_contradicting_options_are_refused_before_anything_is_drawn(
    lamp, tmp_path, monkeypatch, options, message
):
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(ConfigError, match=message):
        render_run(lamp.run, **options)
    assert not lamp.lamp.drawn
    assert sorted(p for p in tmp_path.iterdir() if p.name != "run") == before


def test_the_folder_that_one_is_in_is_no_name_for_a_film(lamp, tmp_path, monkeypatch):
    (tmp_path / "film").mkdir()
    monkeypatch.chdir(tmp_path / "film")
    with pytest.raises(ConfigError, match=r"--out \.: has no name of its own"):
        render_run(lamp.run, out=".")
    assert not list((tmp_path / "film").iterdir())


def test_where_not_even_the_plan_has_room_no_folder_is_left(lamp, tmp_path):
    with files_of_at_most(0):
        with pytest.raises(OutputError, match=r"film\.mp4\.partial/plan\.json: not written"):
            render_run(lamp.run, out=tmp_path / "in" / "film.mp4")
    assert not (tmp_path / "in").exists()


def test_a_folder_in_the_way_of_kept_pictures_is_left_alone(lamp, tmp_path):
    mine = tmp_path / "film.mp4.partial"
    mine.mkdir()
    (mine / "notes.txt").write_text("keep")
    with pytest.raises(DataError, match=r"film\.mp4\.partial: is in the way"):
        render_run(lamp.run, out=tmp_path / "film.mp4")
    assert (mine / "notes.txt").read_text() == "keep"


def test_a_folder_where_events_shall_be_is_refused_before_anything_is_drawn(lamp, tmp_path):
    (tmp_path / "e.h5").mkdir()
    with pytest.raises(DataError, match=r"e\.h5: is a folder; give the name of a file"):
        render_run(lamp.run, show="events", events_out=tmp_path / "e.h5", out=tmp_path / "film")
    assert not lamp.lamp.drawn


def test_a_film_that_another_process_makes_is_refused_and_left_alone(lamp, tmp_path):
    out = tmp_path / "film.mp4"
    with FrameCache.held(tmp_path / "film.mp4.partial", "of the other") as other:
        before = sorted(other.path.iterdir())
        for fps in (25.0, 50.0):
            busy = rf"film\.mp4\.partial: process {os.getpid()} makes this film; wait for its end"
            with pytest.raises(ConfigError, match=busy):
                render_run(lamp.run, fps=fps, out=out)
        assert sorted(other.path.iterdir()) == before
    assert not out.exists()
    (other.path / ".filming").touch()  # of one that was killed
    assert render_run(lamp.run, fps=25, out=out).is_file()
    assert not other.path.exists()


@pytest.mark.parametrize("text", ["{", "[" * 100_000], ids=["broken", "deep"])
def test_a_broken_plan_of_kept_pictures_is_named(lamp, tmp_path, text):
    folder = tmp_path / "film.mp4.partial"
    folder.mkdir()
    (folder / "plan.json").write_text(text)
    with pytest.raises(DataError, match=r"plan\.json: not valid JSON"):
        render_run(lamp.run, out=tmp_path / "film.mp4")


@pytest.mark.parametrize("ending", [".gif", ".webp"])
@pytest.mark.parametrize("fps", [12.0, 30.0])
def test_animations_last_as_long_as_they_should(tmp_path, ending, fps):
    rng = np.random.default_rng(int(fps))
    pictures = rng.integers(0, 256, (13, 16, 24, 3), dtype=np.uint8)
    path = tmp_path / f"a{ending}"
    assert write_animation(path, pictures, fps=fps) == 13
    with Image.open(path) as image:
        durations = [f.copy().info["duration"] for f in ImageSequence.Iterator(image)]
        assert image.info["loop"] == 0
    assert len(durations) == 13
    assert sum(durations) == pytest.approx(13 / fps * 1000, abs=45)


def test_file_names_say_what_is_in_them():
    assert Film().file_name() == "sequence.mp4"
    assert Film(what="test", parts="human").file_name() == "test-human"
    assert Film(path="orbit", show="depth").file_name() == "sequence-orbit-depth.mp4"
    assert Film(motion="poses/walk.npz", transparent=True).file_name() == (
        "sequence-walk-transparent.webp"
    )


def test_films_of_two_cameras_have_two_names_whatever_the_cameras_are_called():
    cameras = (None, "cam.1", "cam.2", "cam", "rgb", "all")
    names = [Film(camera=camera).file_name() for camera in cameras]
    assert len(set(names)) == len(cameras)
    assert Film(camera="left", path="paths/slow.json").file_name() == "sequence-left-slow.mp4"


@pytest.mark.parametrize("path", ["orbit", "swing"])
def test_the_camera_turns_about_the_vertical_of_the_recording_whatever_the_motion(
    tiny_capture, monkeypatch, path
):
    capture = load_capture(tiny_capture())
    recorded = load_body_track(capture)
    poses = np.zeros((2, len(recorded.body.parents), 3))
    across = (int(up_axis(recorded).abs().argmax()) + 1) % 3
    poses[:, 0, across] = np.pi / 2  # a somersault: head and feet are level
    lying = BodyTrack(recorded.body, np.array([0, 400_000]), poses, np.zeros((2, 3)))
    up = up_axis(recorded)
    assert float(up @ up_axis(lying)) == 0
    monkeypatch.setattr(plan, "load_motion_of", lambda *_, **__: lying)
    film = Film(path=path, motion="somersault")
    frames = FilmPlan.of(film, capture, _Lamp(recorded)).frames
    heights = torch.stack([frame.camera.center() for frame in frames]).double() @ up.double()
    assert len(frames) > 5 and float(heights.max() - heights.min()) < 1e-4


@pytest.mark.parametrize("seen_by", ["recorder", "another", "one key"])
def test_the_edge_of_what_was_recorded_is_soft_from_wherever_else_it_is_seen(
    tiny_capture, tmp_path, monkeypatch, seen_by
):
    """A camera that stands still and did not record is elsewhere too, and is not the recorder."""
    capture = load_capture(tiny_capture())
    path = tmp_path / "path.json"
    path.write_text(json.dumps(camera_path_document([capture.cameras["side"]])))
    asked = {"recorder": {}, "another": {"camera": "side"}, "one key": {"path": str(path)}}
    made = []
    monkeypatch.setattr(_Lamp, "elsewhere", lambda lamp, *changes: made.extend(changes) or lamp)
    FilmPlan.of(Film(**asked[seen_by]), capture, _Lamp(load_body_track(capture)))
    rooms = [change.__self__ for change in made if change.__name__ == "soften"]
    assert len(rooms) == (seen_by != "recorder")
    assert all(room.recording is capture.camera_at("main", 0) for room in rooms)


def test_films_are_of_any_size(tiny_capture, monkeypatch):
    capture = load_capture(tiny_capture())
    made = _Lamp(load_body_track(capture))
    monkeypatch.setattr(_Lamp, "at_any_size", lambda _: made)
    for path in (None, "orbit"):
        plan = FilmPlan.of(Film(path=path), capture, _Lamp(load_body_track(capture)))
        assert plan.reconstruction is made


def test_a_film_stops_at_the_first_picture_that_cannot_be_kept(lamp, tmp_path, monkeypatch):
    """Pictures are written beside the drawing of the next ones, which must not go on for hours."""
    whole = render_run(lamp.run, fps=200, out=tmp_path / "whole")
    count, lamp.lamp.drawn = len(list(whole.iterdir())), []

    def full(self, frame, exposure):
        raise OutputError(f"{self.file(frame)}: no room left on the disk.")

    monkeypatch.setattr(FrameCache, "_write", full)
    with pytest.raises(OutputError, match=r"partial/00000\.png: no room left"):
        render_run(lamp.run, fps=200, out=tmp_path / "film")
    assert len(lamp.lamp.drawn) <= 16 < count
    assert not (tmp_path / "film").exists()


def test_pictures_being_written_are_finished_before_a_second_ctrl_c_is_heard(
    lamp, tmp_path, monkeypatch
):
    write, main = FrameCache._write, threading.main_thread().ident

    def again(self, frame, exposure):
        if frame.name == "00004":
            signal.pthread_kill(main, signal.SIGINT)
        time.sleep(0.05)
        write(self, frame, exposure)

    monkeypatch.setattr(FrameCache, "_write", again)
    lamp.lamp.stop_after = 8
    with pytest.raises(KeyboardInterrupt, match=r"Stopped; 8 of \d\d pictures"):
        render_run(lamp.run, fps=100, out=tmp_path / "film")
    kept = sorted(path.name for path in (tmp_path / "film.partial").iterdir())
    assert kept == [*(f"{k:05d}.png" for k in range(8)), "plan.json"]


def test_frames_in_memory_are_those_on_the_disk_which_memory_does_not_hold(
    lamp, tmp_path, monkeypatch
):
    camera = lamp.capture.cameras["main"]
    monkeypatch.setattr(
        "evsplat.film.frame_cache._KEPT_BYTES", 5 * camera.width * camera.height * 3
    )
    times = [1_000 * k for k in range(12)]
    frames = [FilmFrame(f"{k:05d}", time, time, camera) for k, time in enumerate(times)]
    cache = FrameCache(tmp_path / "kept", "digest")
    cache.fill(lamp.lamp, Look(), frames)
    shown = [cache.read(frame) for frame in frames]
    on_disk = FrameCache(tmp_path / "kept", "digest")
    assert all((one == on_disk.read(f)).all() for one, f in zip(shown, frames, strict=True))
    for frame in frames:
        cache.file(frame).unlink()
    assert all(cache.read(frame) is one for frame, one in zip(frames[:5], shown, strict=False))
    with pytest.raises(DataError, match="00005"):
        cache.read(frames[5])


@pytest.mark.parametrize("name", ["../a", "/tmp/evsplat-a", "a/b"])
def test_pictures_are_kept_in_their_folder_only(lamp, tmp_path, name):
    cache = FrameCache(tmp_path / "kept", "digest")
    frame = FilmFrame(name, 0, 0, lamp.capture.cameras["main"])
    with pytest.raises(DataError, match="is no name for a picture"):
        cache.fill(lamp.lamp, Look(), [frame])
    assert lamp.lamp.drawn == []
