"""Your own recording: parts found, paired by time and index, and what is missing named."""

import json
import re
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from evsplat.body.smpl import ENVIRONMENT
from evsplat.capture import Capture, load_body_track, load_capture
from evsplat.errors import ConfigError, DataError, EvsplatError
from evsplat.importers import import_capture

from . import trees
from .person import View, save, write_smpl

COUNT, PERIOD_US, EXPOSURE_US = trees.FRAMES, 40_000, 30_000
VIEW = View((128, 136), trees.zju_views()["1"].K, trees.zju_views()["1"].world_to_camera)


def write_recording(root: Path) -> np.ndarray:
    """Pictures, events (t, x, y, p, on their own clock), AMASS poses and a camera."""
    person = trees.zju_person()
    for index in range(COUNT):
        picture, mask = trees.drawn(VIEW, person, index)
        save(root / "images" / f"shot{index}.png", picture)
        save(root / "masks" / f"shot{index}.png", mask)
    rng = np.random.default_rng(2)
    count = 400
    t = np.sort(rng.integers(5_000, COUNT * PERIOD_US, count))
    x, y = rng.integers(0, 128, count), rng.integers(0, 136, count)
    rows = np.stack([t, x, y, rng.integers(0, 2, count)], axis=1)
    np.savetxt(root / "events.csv", rows, "%d", ",", header="t,x,y,p", comments="")
    np.savez(
        root / "poses.npz",
        poses=person.poses.reshape(COUNT, 72),
        trans=person.transl,
        betas=person.betas,
        gender="neutral",
    )
    K = VIEW.K + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    camera = {"K": K.tolist(), "world_to_camera": VIEW.world_to_camera.tolist()}
    (root / "camera.json").write_text(json.dumps({"width": 128, "height": 136, **camera}))
    return rows


@pytest.fixture
def recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.delenv(ENVIRONMENT, raising=False)
    (tmp_path / "mine").mkdir()
    write_recording(tmp_path / "mine")
    return tmp_path / "mine"


def worst_miss(capture: Capture, shrink: int = 1) -> float:
    track = load_body_track(capture)
    worst = 0.0
    for frame in capture.frames:
        row = int(frame.name.removeprefix("shot"))
        seen, _ = capture.camera(frame).project(track.vertices(frame.mid_us))
        person = VIEW.pixels(trees.zju_person().vertices(row), distorted=False) + 0.5
        worst = max(worst, float(np.abs(shrink * seen.numpy() - person).max()))
    return worst


def test_parts_are_found_and_put_together(recording: Path, tmp_path: Path, monkeypatch) -> None:
    models = write_smpl(tmp_path / "models")
    options = {"fps": 25.0, "exposure_us": 30_000.0, "start_us": 16_000, "clock_offset_us": -700}
    import_capture("folder", recording, tmp_path / "out", smpl=models, **options)
    monkeypatch.setenv(ENVIRONMENT, str(models))
    capture = load_capture(tmp_path / "out")
    assert [frame.name for frame in capture.frames] == [f"shot{i}" for i in range(COUNT)]
    for index, frame in enumerate(capture.frames):
        start = 16_000 + index * PERIOD_US - EXPOSURE_US // 2
        assert frame.exposure_us == (start, start + EXPOSURE_US)
        assert capture.mask(frame) is not None
    assert worst_miss(capture) < 0.01
    assert capture.body_file.source is None
    assert capture.events is not None and len(capture.events) == 400
    assert not capture.events_simulated and capture.contrast_threshold is None
    rows = np.loadtxt(recording / "events.csv", delimiter=",", skiprows=1)
    window = capture.events.between(50_000, 90_000)
    chosen = rows[(rows[:, 0] - 700 >= 50_000) & (rows[:, 0] - 700 < 90_000)]
    assert np.array_equal(window.t, chosen[:, 0] - 700)
    assert np.array_equal(window.p, 2 * chosen[:, 3] - 1)


def test_exposures_of_a_list_and_pictures_without_a_pose(
    recording: Path, tmp_path: Path, monkeypatch
) -> None:
    models = write_smpl(tmp_path / "models")
    starts = np.array([7, 41_000, 80_500, 121_000, 160_000, 203_000])
    np.savetxt(recording / "exposures.txt", np.stack([starts, starts + 9_000], axis=1), "%d")
    person = trees.zju_person()
    np.savez(
        recording / "poses.npz",
        poses=person.poses[:4].reshape(4, 72),
        trans=person.transl[:4],
        betas=person.betas,
        gender="neutral",
    )
    import_capture("folder", recording, tmp_path / "out", smpl=models, pose_source="estimated")
    monkeypatch.setenv(ENVIRONMENT, str(models))
    capture = load_capture(tmp_path / "out")
    assert capture.body_file.source == "estimated"
    assert [frame.exposure_us[0] for frame in capture.frames] == starts[:4].tolist()
    assert worst_miss(capture) < 0.01
    assert any("2 pictures without a pose" in note for note in capture.provenance["notes"])


def test_a_part_of_the_pictures_has_their_poses_masks_and_events(
    rng: np.random.Generator, recording: Path, tmp_path: Path, monkeypatch
) -> None:
    models = write_smpl(tmp_path / "models")
    first = int(rng.integers(1, COUNT - 2))
    options = {"fps": 25.0, "exposure_us": 30_000.0, "start_us": 16_000}
    frames = (first, first + 2)
    import_capture("folder", recording, tmp_path / "out", smpl=models, frames=frames, **options)
    monkeypatch.setenv(ENVIRONMENT, str(models))
    capture = load_capture(tmp_path / "out")
    assert [frame.name for frame in capture.frames] == [f"shot{first}", f"shot{first + 1}"]
    assert capture.frames[0].mid_us == 16_000 + first * PERIOD_US
    assert worst_miss(capture) < 0.01
    assert all(capture.mask(frame) is not None for frame in capture.frames)
    assert len(capture.body_file.times_us) == 2
    rows = np.loadtxt(recording / "events.csv", delimiter=",", skiprows=1)
    begin, end = capture.frames[0].exposure_us[0], capture.frames[1].exposure_us[1]
    assert capture.events is not None
    assert len(capture.events) == ((rows[:, 0] >= begin) & (rows[:, 0] < end)).sum() > 0


def test_a_recording_is_made_smaller_with_its_camera_masks_and_events(
    rng: np.random.Generator, recording: Path, tmp_path: Path, monkeypatch
) -> None:
    models = write_smpl(tmp_path / "models")
    factor = int(rng.integers(2, 5))
    wide, high = 128 // factor, 136 // factor
    options = {"fps": 25.0, "exposure_us": 30_000.0, "start_us": 16_000, "contrast": (0.4, 0.2)}
    import_capture("folder", recording, tmp_path / "out", smpl=models, shrink=factor, **options)
    monkeypatch.setenv(ENVIRONMENT, str(models))
    capture = load_capture(tmp_path / "out")
    camera = capture.camera(capture.frames[0])
    assert (camera.width, camera.height) == (wide, high)
    assert worst_miss(capture, factor) < 0.01
    for frame in capture.frames:
        whole = np.array(Image.open(recording / "images" / f"{frame.name}.png"), dtype=float)
        places = [
            whole[y::factor, x::factor][:high, :wide] for x in range(factor) for y in range(factor)
        ]
        assert np.abs(np.array(Image.open(frame.image)) - np.mean(places, axis=0)).max() <= 0.5
        mask = capture.mask(frame)
        assert mask is not None and mask.shape == (high, wide) and 0.05 < mask.mean() < 0.9
    rows = np.loadtxt(recording / "events.csv", delimiter=",", skiprows=1).astype(int)
    kept = rows[(rows[:, 1] < wide * factor) & (rows[:, 2] < high * factor)]
    assert capture.events is not None
    events = capture.events.between(0, 1_000_000)
    assert np.array_equal(
        np.stack([events.t, events.x, events.y]).T, kept[:, :3] // [1, factor, factor]
    )
    # an event of one of the pixels is its share of what their mean changes by
    assert capture.contrast_threshold == pytest.approx((0.4 / factor**2, 0.2 / factor**2))


@pytest.mark.parametrize("held", ["level", "on end"])
def test_events_of_a_finer_sensor_are_moved_into_the_pictures_before_they_are_made_smaller(
    rng: np.random.Generator, recording: Path, tmp_path: Path, held: str
) -> None:
    """Those are upright, as of a camera that was held on end and whose files say so."""
    if held == "on end":
        exif = Image.Exif()
        exif[0x0112] = 6  # orientation: to be turned clockwise
        for path in sorted((recording / "images").iterdir()):
            turned = Image.fromarray(np.rot90(np.array(Image.open(path))))
            turned.save(path.with_suffix(".jpg"), exif=exif)
            path.unlink()
    scale, right, down = rng.uniform(1.2, 1.6), *rng.uniform(-6, 6, 2)
    away = np.array([[scale, 0, right], [0, scale, down], [0, 0, 1]])
    rows = np.loadtxt(recording / "events.csv", delimiter=",", skiprows=1).astype(int)
    t, p = rows[:, 0], rows[:, 3]
    x, y = (rng.integers(0, side, len(t)) for side in (205, 218))
    lines = np.stack([t, x, y, p], axis=1)
    header = "t,x@205,y@218,p"
    np.savetxt(recording / "events.csv", lines, "%d", ",", header=header, comments="")
    np.savetxt(tmp_path / "H.txt", np.linalg.inv(away))
    options = {"fps": 25.0, "exposure_us": 30_000.0, "start_us": 16_000, "no_poses": True}
    with pytest.raises(ConfigError, match="205x218 pixels, .* move them there by --homography"):
        import_capture("folder", recording, tmp_path / "out", **options)
    options |= {"homography": tmp_path / "H.txt"}
    for shrink in (1, 2):
        import_capture("folder", recording, tmp_path / f"by {shrink}", shrink=shrink, **options)
        capture = load_capture(tmp_path / f"by {shrink}")
        camera = capture.cameras["main"]
        assert (camera.width, camera.height) == (128 // shrink, 136 // shrink)
        assert capture.events is not None
        events = capture.events.between(0, 1 << 40)
        there = np.rint([(x - right) / scale, (y - down) / scale]).astype(int)
        kept = ((there >= 0) & (there < [[128], [136]])).all(0)
        assert np.array_equal(events.t, t[kept])
        assert np.array_equal([events.x, events.y], there[:, kept] // shrink)
        share = f"{(~kept).sum() / len(t):.1%} of them fell outside and were left out"
        assert any("128x136 pixels by H.txt" in n and share in n for n in _notes(capture))
        assert not any("size of the sensor" in note for note in _notes(capture))


def _notes(capture: Capture) -> list[str]:
    return capture.provenance["notes"]


@pytest.mark.parametrize(
    ("shrink", "said"),
    [(0, "above 0"), (13, "left 9x10, .* at least 11"), (999, "left 0x0, .* 11")],
)
def test_a_recording_is_not_made_too_small(
    recording: Path, tmp_path: Path, shrink: int, said: str
) -> None:
    options = {"fps": 25.0, "exposure_us": 30_000.0, "no_poses": True}
    with pytest.raises(EvsplatError, match=said):
        import_capture("folder", recording, tmp_path / "out", shrink=shrink, **options)
    assert not (tmp_path / "out").exists()


def test_pictures_without_a_mask_are_counted(recording: Path, tmp_path: Path) -> None:
    (recording / "masks" / "shot3.png").unlink()
    import_capture("folder", recording, tmp_path / "out", fps=25.0, exposure_us=3e4)
    capture = load_capture(tmp_path / "out")
    assert [capture.mask(frame) is None for frame in capture.frames].index(True) == 3
    assert f"1 of {COUNT} pictures have no mask" in capture.provenance["notes"]


ODD = {
    "milliseconds": (
        "t,x,y,p\n" + "".join(f"{t},1,2,{t % 2}\n" for t in range(240)),
        {},
        "events.csv covers 0.1% of the pictures' time .*--clock-offset-us auto .*unit of the times",
    ),
    "one polarity": (
        "t,x,y,p\n" + "".join(f"{t * 1000},1,2,1\n" for t in range(-20, 240)),
        {},
        "all 260 of events.csv are brighter, as no scene makes them",
    ),
    "no polarity, of a sensor of another size": (
        "".join(f"{t % 60},{t % 50},{t * 1000},0,0\n" for t in range(240)),
        {},
        "events.csv has no polarity, so it was left out",
    ),
    "an exposure in milliseconds": (
        "t,x,y,p\n" + "".join(f"{t * 1000},1,2,{t % 2}\n" for t in range(-20, 240)),
        {"exposure_us": 30.0},
        "exposure: 30 microseconds, in which nothing blurs",
    ),
}


@pytest.mark.parametrize("what", ODD)
def test_what_is_odd_but_possible_is_a_note(recording: Path, tmp_path: Path, what: str) -> None:
    text, options, note = ODD[what]
    (recording / "events.csv").write_text(text)
    options = {"fps": 25.0, "exposure_us": 3e4, "no_poses": True, "start_us": 0} | options
    import_capture("folder", recording, tmp_path / "out", **options)
    notes = load_capture(tmp_path / "out").provenance["notes"]
    assert [bool(re.search(note, said)) for said in notes].count(True) == 1, notes
    others = [ODD[other][2] for other in ODD if other != what]
    assert not any(re.search(other, said) for other in others for said in notes), notes


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"transl": None}, "transl: found nothing, expected an array of real numbers"),
        ({"model": None}, "model: found '', expected one of rig, default, smpl"),
        ({"times_us": np.array(["a"] * COUNT)}, "times_us: found 6 of <U1, expected"),
        ({"times_us": np.zeros(0, np.int64)}, "times_us: found no pose|poses: found"),
        ({"weights": np.zeros((3, 2))}, "weights: found 3x2"),
    ],
)
def test_a_rig_is_held_to_what_a_captures_body_is(
    recording: Path, tmp_path: Path, tiny_capture: Callable, change: dict[str, Any], message: str
) -> None:
    tiny = load_capture(tiny_capture(frames=COUNT))
    (recording / "poses.npz").unlink()
    arrays = {**np.load(tiny.path / "body.npz")} | change
    kept = {name: value for name, value in arrays.items() if value is not None}
    np.savez(recording / "body.npz", **kept)
    options = {"fps": 25.0, "exposure_us": 3e4, "start_us": 15_000}
    with pytest.raises(DataError, match=f"body.npz: ({message})") as caught:
        import_capture("folder", recording, tmp_path / "out", pose_source="exact", **options)
    assert str(recording) in str(caught.value) and not (tmp_path / "out").exists()


def test_poses_of_another_time_are_refused(
    recording: Path, tmp_path: Path, tiny_capture: Callable
) -> None:
    tiny = load_capture(tiny_capture(frames=COUNT))
    (recording / "poses.npz").unlink()
    shutil.copy(tiny.path / "body.npz", recording / "body.npz")
    options = {"fps": 25.0, "exposure_us": 3e4, "start_us": 10**9}
    with pytest.raises(DataError, match="body.npz: has no pose at the middle of any of the 6 exp"):
        import_capture("folder", recording, tmp_path / "out", pose_source="exact", **options)
    assert not (tmp_path / "out").exists()


def test_a_rig_of_ones_own(recording: Path, tmp_path: Path, tiny_capture: Callable) -> None:
    """body.npz as in a capture goes through as it is."""
    tiny = load_capture(tiny_capture(frames=COUNT))
    (recording / "poses.npz").unlink()
    target = recording / "body.npz"
    errors = {"pose_std_rad": np.full((COUNT, 3), 0.25), "transl_std_m": np.full((COUNT, 3), 0.5)}
    np.savez(target, **np.load(tiny.path / "body.npz"), **errors)
    options: dict[str, Any] = {"fps": 25.0, "exposure_us": 3e4, "start_us": 15_000}
    with pytest.raises(DataError, match="body.npz: says how far its poses err .*--pose-source"):
        import_capture("folder", recording, tmp_path / "out", **options)
    import_capture("folder", recording, tmp_path / "out", pose_source="markers", **options)
    body = load_capture(tmp_path / "out").body_file
    assert body.errors is not None and body.errors.source == "markers"
    assert (body.errors.joint_rad == 0.25).all() and (body.errors.root_m == 0.5).all()
    assert body.model == "rig" and np.array_equal(body.poses, tiny.body_file.poses)
    assert np.array_equal(body.rest_vertices, tiny.body_file.rest_vertices)


@pytest.mark.parametrize("how", ["absent", "not wanted"])
def test_without_poses_the_body_is_left_out(recording: Path, tmp_path: Path, how: str) -> None:
    options: dict[str, Any] = {"fps": 25.0, "exposure_us": 3e4, "transfer": "linear"}
    if how == "absent":
        (recording / "poses.npz").unlink()
        (recording / "camera.json").unlink()
    else:
        options |= {"no_poses": True}
    import_capture("folder", recording, tmp_path / "out", **options)
    capture = load_capture(tmp_path / "out")
    assert not capture.has_body and len(capture.frames) == COUNT
    assert capture.transfer(capture.frames[0]) == "linear"
    assert capture.events is not None and len(capture.events) == 400
    origin = {"absent": "guessed", "not wanted": "calibrated"}[how]
    assert capture.provenance["focal"] == origin


def exposures(order: Sequence[int] = range(COUNT), scale: float = 1.0) -> str:
    starts = [PERIOD_US * index for index in order]
    return "".join(f"{t * scale:g} {(t + EXPOSURE_US) * scale:g}\n" for t in starts)


def rewrite_camera(root: Path, **changes) -> None:
    path = root / "camera.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


FAULTS = {
    "no exposure": (lambda root: None, {"fps": 25.0}, ConfigError, "give --exposure-us, or"),
    "no pictures": (
        lambda root: (root / "images").rename(root / "shots"),
        {},
        DataError,
        "images: not found, expected a folder of pictures, or one video",
    ),
    "no rate": (lambda root: None, {"exposure_us": 1e4}, ConfigError, "--fps"),
    "poses and none": (
        lambda root: None,
        {"fps": 25.0, "exposure_us": 3e4, "no_poses": True, "poses": Path("poses.npz")},
        ConfigError,
        "--poses poses.npz: contradicts --no-poses",
    ),
    "no camera": (
        lambda root: (root / "camera.json").unlink(),
        {},
        DataError,
        "camera.json: not found, expected the camera",
    ),
    "another size": (
        lambda root: rewrite_camera(root, width=64),
        {},
        DataError,
        "camera.json: width: found 64, expected 128 as the pictures have",
    ),
    "bad K": (
        lambda root: rewrite_camera(root, K=[1, 2]),
        {},
        DataError,
        "camera.json: K: found .*expected 3x3 finite numbers",
    ),
    "K that is no number": (
        lambda root: rewrite_camera(root, K=[[float("inf"), 0, 1], [0, 1, 1], [0, 0, 1]]),
        {},
        DataError,
        "camera.json: K: found .*expected 3x3 finite numbers",
    ),
    "K too large for a number": (
        lambda root: rewrite_camera(root, K=[[10**400, 0, 1], [0, 1, 1], [0, 0, 1]]),
        {},
        DataError,
        "camera.json: K: found .*expected 3x3 finite numbers",
    ),
    "a time of another year": (
        lambda root: (root / "events.csv").write_text(f"t,x,y,p\n0,1,3,1\n{10**15},1,3,0\n"),
        {},
        DataError,
        "events.csv: has events from 0 to 10{15} us, expected a recording of at most a day",
    ),
    "a lens of words": (
        lambda root: rewrite_camera(root, distortion=["r", 0, 0, 0]),
        {},
        DataError,
        "camera.json: distortion: found .* expected 4, 5 or 8 numbers",
    ),
    "a lens that is a number": (
        lambda root: rewrite_camera(root, distortion=0.5),
        {},
        DataError,
        "camera.json: distortion: found 0.5, expected 4, 5 or 8 numbers",
    ),
    "a fish eye": (
        lambda root: rewrite_camera(
            root, distortion={"model": "fisheye", "coefficients": [0.1, 0.01, 0, 0]}
        ),
        {},
        DataError,
        "camera.json: distortion: model: found 'fisheye', expected 'opencv'; undistort",
    ),
    "a curve of another name": (
        lambda root: rewrite_camera(root, transfer="gamma"),
        {},
        DataError,
        "camera.json: transfer: found 'gamma', expected one of power, srgb, linear",
    ),
    "a device of exposures": (
        lambda root: (root / "exposures.txt").symlink_to("/dev/zero"),
        {"start_us": 0},
        DataError,
        "exposures.txt: a device or pipe, expected a file",
    ),
    "exposures of fewer": (
        lambda root: (root / "exposures.txt").write_text("0 10\n20 30\n"),
        {"start_us": 0},
        DataError,
        r"exposures.txt: has 2 lines of 2 numbers, expected start and end .* of the 6 pictures",
    ),
    "exposures with a header": (
        lambda root: (root / "exposures.txt").write_text("start end\n" + "0 9\n" * 6),
        {"start_us": 0},
        DataError,
        "exposures.txt: not a table of numbers .*expected start and end in microseconds of each",
    ),
    "two event files": (
        lambda root: (root / "events.txt").write_text("0 1 1 1"),
        {},
        ConfigError,
        "mine: holds events.csv, events.txt, expected one of them; say which with --events",
    ),
    "two pose files": (
        lambda root: (root / "poses.pkl").write_bytes(b""),
        {},
        ConfigError,
        "mine: holds poses.*, poses.*, expected one of them; say which with --poses",
    ),
    "exposures and a rate": (
        lambda root: (root / "exposures.txt").write_text(exposures()),
        {"fps": 25.0},
        ConfigError,
        "--fps 25: .*exposures.txt says when every picture was exposed; leave out the one or",
    ),
    "exposures and their length": (
        lambda root: (root / "exposures.txt").write_text(exposures()),
        {"exposure_us": 1e3},
        ConfigError,
        "--exposure-us 1000: .*exposures.txt says when every picture was exposed",
    ),
    "exposures in seconds": (
        lambda root: (root / "exposures.txt").write_text(exposures(scale=1e-6)),
        {"start_us": 0},
        DataError,
        "exposures.txt: line 1 of numbers is 0 0.03, expected when .* in microseconds",
    ),
    "an exposure that is none": (
        lambda root: (root / "exposures.txt").write_text(exposures().replace("110000", "nan")),
        {"start_us": 0},
        DataError,
        "exposures.txt: line 3 of numbers is 80000 nan, expected when",
    ),
    "exposures out of order": (
        lambda root: (root / "exposures.txt").write_text(exposures((0, 2, 1, 3, 4, 5))),
        {"start_us": 0},
        DataError,
        "exposures.txt: line 3 of numbers is 40000 70000, expected a start after 80000",
    ),
    "a name twice": (
        lambda root: save(root / "images" / "shot3.bmp", np.zeros((136, 128), np.uint8)),
        {},
        DataError,
        "shot3.png: has the name of shot3.bmp, expected one picture of each name",
    ),
    "a file": (
        lambda root: (shutil.rmtree(root), root.write_bytes(b"1")),
        {},
        DataError,
        "mine: is a file, expected the folder of the recording; .* 'evsplat import video'",
    ),
    "endless exposures": (
        lambda root: None,
        {"fps": 25.0, "exposure_us": float("inf")},
        ConfigError,
        "--exposure-us inf: expected a number above 0",
    ),
    "a clock of no events": (
        lambda root: (root / "events.csv").unlink(),
        {"fps": 25.0, "exposure_us": 3e4, "clock_offset_us": 5},
        ConfigError,
        "--clock-offset-us: there are no events; give --events, or leave it out",
    ),
    "a homography of no events": (
        lambda root: (
            (root / "events.csv").unlink(),
            (root / "H.txt").write_text("1 0 0\n0 1 0\n0 0 1"),
        ),
        {"fps": 25.0, "exposure_us": 3e4, "homography": Path("mine/H.txt")},
        ConfigError,
        "--homography: there are no events; give --events, or leave it out",
    ),
    "a homography of two lines": (
        lambda root: (root / "H.txt").write_text("1 0 0\n0 1 0"),
        {"fps": 25.0, "exposure_us": 3e4, "homography": Path("mine/H.txt")},
        DataError,
        "H.txt: found 2 x 3 numbers, expected 3 lines of 3 numbers, the homography",
    ),
    "a homography to elsewhere": (
        lambda root: (root / "H.txt").write_text("1 0 500\n0 1 0\n0 0 1"),
        {"fps": 25.0, "exposure_us": 3e4, "homography": Path("mine/H.txt")},
        DataError,
        "events.csv: by mine/H.txt all of its events fall outside of the pictures' 128x136 pixels",
    ),
    "no folder of masks": (
        lambda root: None,
        {"fps": 25.0, "exposure_us": 3e4, "masks": Path("maks")},
        DataError,
        "--masks maks: no such folder, expected one of pictures NAME.png",
    ),
    "masks of other names": (
        lambda root: [path.rename(f"{path}.png") for path in (root / "masks").iterdir()],
        {},
        DataError,
        "masks: holds no mask of any picture, expected NAME.png",
    ),
    "a mask of another size": (
        lambda root: save(root / "masks" / "shot2.png", np.zeros((8, 9), np.uint8)),
        {},
        DataError,
        "shot2.png: has 9x8 pixels, expected 128x136 as its picture",
    ),
    "no event": (
        lambda root: (root / "events.csv").write_text("t,x,y,p\n"),
        {},
        DataError,
        "events.csv: holds no event",
    ),
    "events of another time": (
        lambda root: (root / "events.csv").write_text("t,x,y,p\n1000000,1,3,1\n1000400,1,3,0\n"),
        {},
        DataError,
        "events.csv: its events are from 1000000 to 1000400 us and the pictures from -15000 to "
        "215000 us, .* give --clock-offset-us auto, .* --time-unit of 'evsplat convert'",
    ),
    "event beside the sensor": (
        lambda root: (root / "events.csv").write_text("t,x,y,p\n1,127,3,1\n2,128,3,0\n"),
        {},
        DataError,
        "events.csv: ",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_is_missing_is_one_sentence(
    recording: Path, tmp_path: Path, fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    change, options, error, message = FAULTS[fault]
    change(recording)
    monkeypatch.chdir(tmp_path)
    options = options or {"fps": 25.0, "exposure_us": 3e4}
    with pytest.raises(EvsplatError, match=message) as caught:
        import_capture("folder", recording, tmp_path / "out", **options)
    assert isinstance(caught.value, error)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine"]


def test_frames_that_are_odd_are_told_as_they_are_written(
    recording: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level("WARNING"):
        import_capture("folder", recording, tmp_path / "out", fps=25.0, exposure_us=5e4)
    assert any("5 exposures begun before the one before ended" in m for m in caplog.messages)
