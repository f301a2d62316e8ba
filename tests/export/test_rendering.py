"""Which instants are drawn, from where, and what arrives on disk."""

import json
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from evsplat.body import BodyTrack, default_body
from evsplat.capture import Camera, Frame
from evsplat.capture.camera_track import CameraTrack
from evsplat.errors import ConfigError, DataError
from evsplat.export import render_run, rendering
from evsplat.export.rendering import FILM_HEIGHT
from evsplat.film import Film, FilmPlan
from evsplat.film.frame_cache import FilmFrame
from evsplat.methods.reconstruction import Rendering

WIDTH, HEIGHT = 20, 14
MIDS_US = (36_000, 116_000, 196_000, 276_000)


def _pose(angle: float, x: float) -> torch.Tensor:
    pose = torch.eye(4)
    pose[:3, :3] = torch.from_numpy(Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix())
    pose[:3, 3] = -pose[:3, :3] @ torch.tensor([x, 0.0, -3.0])
    return pose


def _camera(width: int = WIDTH, height: int = HEIGHT) -> Camera:
    K = torch.tensor([[30.0, 0, width / 2], [0, 30.0, height / 2], [0, 0, 1]])
    return Camera(width, height, K, _pose(0.0, 0.0))


class _Recording:
    """The part of a capture that drawing needs: frame k is a flat grey of level 10 k."""

    def __init__(self, *, moving: bool = False) -> None:
        self.path = Path("recording")
        self.cameras = {"main": _camera(), "side": _camera(10, 7)}
        self.frames = tuple(
            Frame(
                f"f{k}",
                k,
                "main",
                f"{k}.png",
                (mid - 36_000, mid + 36_000),
                "test" if k == 2 else "train",
                world_to_camera=_pose(0.2 * k, float(k)) if moving else None,
            )
            for k, mid in enumerate(MIDS_US)
        )
        self.is_static_camera = not moving

    def transfer(self, frame: Frame) -> str:
        return "power"

    def shown(self, values: torch.Tensor) -> torch.Tensor:
        return values

    def camera(self, frame: Frame) -> Camera:
        camera = self.cameras[frame.camera]
        if frame.world_to_camera is None:
            return camera
        return Camera(camera.width, camera.height, camera.K, frame.world_to_camera)

    def cameras_at(self, name: str, times_us: list[int]) -> tuple[Camera, ...]:
        frames = [frame for frame in self.frames if frame.camera == name]
        return CameraTrack(self.cameras[name], frames).at(times_us)

    def camera_at(self, name: str, time_us: int) -> Camera:
        return self.cameras_at(name, [time_us])[0]

    def image(self, frame: Frame) -> torch.Tensor:
        return torch.full((HEIGHT, WIDTH, 3), 10 * frame.index / 255)


class _Clock:
    """A reconstruction whose grey level tells the time: one level per millisecond."""

    name = "clock"
    track = BodyTrack(default_body(), np.zeros(1), np.zeros((1, 31, 3)), np.zeros((1, 3)))

    def at_any_size(self):
        return self

    def render(self, camera, times_us, *, parts="all"):
        levels = torch.tensor([time / 1000 / 255 for time in times_us])
        rgb = levels[:, None, None, None].expand(-1, camera.height, camera.width, 3)
        human = torch.zeros_like(rgb[..., 0])
        if parts == "human":
            return Rendering(rgb * 0, human, human)
        return Rendering(rgb, human + 1, human)


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A folder that `load_run` takes for a run of the clock on the recording."""
    loaded = SimpleNamespace(
        capture=_Recording(), reconstruction=_Clock(), method="clock", iteration=1, train_seconds=1
    )
    monkeypatch.setattr(rendering, "opened", lambda path, **_: loaded)
    path = tmp_path / "run"
    path.mkdir()
    return path


def planned(recording: _Recording, **options) -> list[FilmFrame]:
    return FilmPlan.of(Film(**options), recording, _Clock()).frames


@pytest.mark.parametrize("rate_hz", [12.5, 30.0, 240.0, 1000.0])
def test_sequence_spans_first_to_last_mid_exposure_at_the_rate(rate_hz):
    frames = planned(_Recording(), fps=rate_hz)
    times = np.array([frame.time_us for frame in frames])
    assert times[0] == MIDS_US[0]
    assert MIDS_US[-1] - 1e6 / rate_hz < times[-1] <= MIDS_US[-1]
    np.testing.assert_allclose(np.diff(times), 1e6 / rate_hz, atol=1)
    assert len({frame.name for frame in frames}) == len(frames)


def test_test_frames_are_drawn_at_mid_exposure_under_their_names():
    frames = planned(_Recording(), what="test")
    assert [(frame.name, frame.time_us) for frame in frames] == [("f2", MIDS_US[2])]


def test_no_test_frame_is_told():
    recording = _Recording()
    recording.frames = tuple(f for f in recording.frames if f.split == "train")
    with pytest.raises(DataError, match="split 'test'"):
        planned(recording, what="test")


@pytest.mark.parametrize("rate_hz", [12.5, 30.0, 240.0])
def test_a_moving_camera_is_where_it_was_at_each_time(rate_hz):
    frames = planned(_Recording(moving=True), fps=rate_hz, parts="human")
    for frame in frames:
        passed = (frame.time_us - MIDS_US[0]) / (MIDS_US[1] - MIDS_US[0])
        found = frame.camera.world_to_camera
        torch.testing.assert_close(found, _pose(0.2 * passed, passed), atol=1e-5, rtol=0)


def test_video_shows_the_asked_times_in_slow_motion_beside_the_blurry_frame(run):
    path = render_run(run, fps=25, slow=4, beside=True, background="black")
    assert path == run / "renders" / "sequence-beside.mp4"
    expected = planned(_Recording(), fps=100)
    with av.open(str(path)) as container:
        assert container.streams.video[0].average_rate == 25
        pictures = [frame.to_ndarray(format="gray") for frame in container.decode(video=0)]
    assert len(pictures) == len(expected) == 25
    for picture, frame in zip(pictures, expected, strict=True):
        # Both halves as high as videos are, of even width.
        half = round(WIDTH * FILM_HEIGHT / HEIGHT / 2) * 2
        assert picture.shape == (FILM_HEIGHT, 2 * half)
        # Grey is luma: limited range is undone, and the codec may be off by two levels.
        distances = [abs(mid - frame.time_us) for mid in MIDS_US]
        assert abs(picture[:, 90 : half - 90].mean() - 10 * np.argmin(distances)) < 2.5
        right = picture[:, half + 90 : -90].mean()
        assert abs(right - min(frame.time_us / 1000, 255)) < 2.5


def test_pictures_are_exact_and_a_second_call_replaces_them(run):
    path = render_run(run, what="test")
    assert path == run / "renders" / "test"
    pixels = np.asarray(Image.open(path / "f2.png"))
    assert pixels.shape == (HEIGHT, WIDTH, 3)
    assert (pixels == 196).all()
    assert render_run(run, what="test") == path
    assert [p.name for p in path.iterdir()] == ["f2.png"]


def test_out_chooses_video_or_pictures_and_parts_and_camera_are_obeyed(run, tmp_path):
    folder = render_run(run, out=tmp_path / "png", fps=12.5, parts="human", camera="side")
    pictures = [np.asarray(Image.open(path)) for path in sorted(folder.iterdir())]
    assert len(pictures) == 4
    assert all(p.shape == (7, 10, 3) and not p.any() for p in pictures)
    video = render_run(run, what="test", out=tmp_path / "test.mp4")
    with av.open(str(video)) as container:
        assert sum(1 for _ in container.decode(video=0)) == 1
    with pytest.raises(DataError, match="not empty"):
        render_run(run, out=folder)


@pytest.mark.parametrize("ending", ["mp4", "webp"])
def test_a_film_too_wide_for_its_format_is_refused_before_it_is_drawn(run, tmp_path, ending):
    keys = [{"at": 0, "eye": [0, 0, -3], "target": [0, 0, 0], "up": [0, -1, 0], "fov_y_deg": 40}]
    path = {"format": "evsplat-camera-path", "version": 1, "width": 40, "height": 10, "keys": keys}
    (tmp_path / "path.json").write_text(json.dumps(path))
    given = {"path": str(tmp_path / "path.json"), "out": tmp_path / f"film.{ending}"}
    with pytest.raises(ConfigError, match=r"17280 pixels wide, expected 1638. at most.*--size"):
        render_run(run, size=4320, parts="human", **given)
    assert [file.name for file in tmp_path.iterdir() if "film" in file.name] == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fps": 0}, "--fps 0"),
        ({"fps": 0.0004}, "--fps 0.0004: expected a number within 0.01 and 1000"),
        ({"slow": -1}, "--slow -1"),
        ({"slow": float("nan")}, "--slow nan"),
        ({"camera": "top"}, "only main, side"),
        ({"out": "film.avi"}, "--out film.avi: a film is an .mp4, .webp or .gif, or a folder"),
    ],
)
def test_impossible_options_name_themselves(run, options, message):
    with pytest.raises(ConfigError, match=message):
        render_run(run, **options)
    assert not list(run.iterdir())
