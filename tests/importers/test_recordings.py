"""Recordings without poses: a video, a DAVIS file, and poses that shall not be taken."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evsplat import posing
from evsplat.capture import Capture, load_body_track, load_capture, validate_capture
from evsplat.capture.derive import derived_capture
from evsplat.cli.main import main
from evsplat.errors import ConfigError, DataError, EvsplatError
from evsplat.events import EventStream, write_events
from evsplat.importers import import_capture
from evsplat.importers.recorded import large_pictures
from evsplat.options import PoseOptions
from evsplat.pictures.video import write_video

from ..events.formats.encoders import aedat3, aedat4
from ..events.formats.mutations import bag
from . import trees

WIDTH, HEIGHT, COUNT = 48, 32, 12
PERIOD_US, EXPOSURE_US = 40_000, 25_000
EPOCH_US = 1_700_000_000_000_000
"""AEDAT4 counts from 1970."""


def moving_bar() -> list[np.ndarray]:
    pictures = [np.full((HEIGHT, WIDTH), 60, np.uint8) for _ in range(COUNT)]
    for index, picture in enumerate(pictures):
        picture[:, 2 * index : 2 * index + 6] = 200
    return pictures


def some_events(first_us: int) -> EventStream:
    rng = np.random.default_rng(0)
    t = np.sort(rng.integers(0, COUNT * PERIOD_US, 900)) + first_us
    t[0] = first_us
    x, y = rng.integers(0, WIDTH, 900), rng.integers(0, HEIGHT, 900)
    p = rng.choice([-1, 1], 900)
    return EventStream(t, x.astype(np.uint16), y.astype(np.uint16), p.astype(np.int8))


def run(kind: str, source: Path, out: Path, **options) -> Capture:
    """Import, and find nothing wrong but what is said to be missing."""
    import_capture(kind, source, out, **options)
    findings = [f for f in validate_capture(out) if f.field not in ("body", "events", "frames")]
    assert findings == []
    capture = load_capture(out)
    with pytest.raises(DataError, match="has no body; find the person's poses with: evsplat poses"):
        load_body_track(capture)
    assert json.loads((out / "capture.json").read_text())["body"] is None
    assert not list(out.glob("body*.npz"))
    return capture


def some_frames(begin_us: int) -> list[tuple[np.ndarray, int, int]]:
    """Pictures of the moving bar with the start and end of their exposures."""
    starts = [begin_us + 3_000 + index * PERIOD_US for index in range(COUNT)]
    return [
        (picture, start, start + EXPOSURE_US)
        for picture, start in zip(moving_bar(), starts, strict=True)
    ]


@pytest.fixture
def davis(tmp_path: Path) -> Path:
    path = tmp_path / "dance.aedat4"
    path.write_bytes(aedat4(some_events(EPOCH_US), WIDTH, HEIGHT, some_frames(EPOCH_US)))
    return path


def test_a_davis_recording_is_a_capture_whose_frames_are_light(davis: Path, tmp_path: Path) -> None:
    capture = run("davis", davis, tmp_path / "out", contrast=(0.3, 0.25))
    assert [f.exposure_us for f in capture.frames] == [
        (3_000 + i * PERIOD_US, 3_000 + i * PERIOD_US + EXPOSURE_US) for i in range(COUNT)
    ]
    for frame, picture in zip(capture.frames, moving_bar(), strict=True):
        assert np.array_equal((capture.image(frame)[..., 0] * 255).round(), picture)
        assert capture.transfer(frame) == "linear"
    assert capture.events is not None and len(capture.events) == 900
    events, given = capture.events.between(0, 1 << 40), some_events(0)
    assert np.array_equal(events.t, given.t) and np.array_equal(events.x, given.x)
    assert np.array_equal(events.p, given.p)
    assert capture.contrast_threshold == (0.3, 0.25) and not capture.events_simulated
    assert capture.provenance["focal"] == "guessed" and capture.provenance["started_us"] == EPOCH_US
    # 60 degrees across the longer side
    camera = capture.camera(capture.frames[0])
    assert np.degrees(2 * np.arctan(WIDTH / 2 / camera.K[0, 0].item())) == pytest.approx(60)
    assert any("focal length is guessed" in note for note in capture.provenance["notes"])


def test_a_part_of_a_davis_recording_begins_with_its_first_frame(
    davis: Path, tmp_path: Path
) -> None:
    capture = run("davis", davis, tmp_path / "out", frames=(4, 9), focal=55.0, transfer="power")
    assert [frame.name for frame in capture.frames] == [f"{i:06d}" for i in range(4, 9)]
    assert capture.frames[0].exposure_us == (0, EXPOSURE_US)
    assert capture.provenance["frames"] == [4, 9]
    begin, end = 3_000 + 4 * PERIOD_US, 3_000 + 8 * PERIOD_US + EXPOSURE_US
    assert capture.events is not None
    assert len(capture.events) == len(some_events(0).between(begin, end))
    assert capture.cameras["main"].K[0, 0] == 55 and capture.provenance["focal"] == "given"
    assert capture.transfer("000004") == "power"


@pytest.mark.parametrize("second", [False, True])
def test_a_davis_whose_clock_was_set_is_read_up_to_there_or_from_there(
    davis: Path, tmp_path: Path, second: bool
) -> None:
    path, back_us = tmp_path / "reset.aedat4", 5_000_000
    events, frames = some_events(EPOCH_US), some_frames(EPOCH_US)
    count = len(events)
    both = EventStream(
        np.concatenate([events.t, events.t - back_us]),
        *(np.concatenate([column] * 2) for column in (events.x, events.y, events.p)),
    )
    later = [(picture, start - back_us, end - back_us) for picture, start, end in frames]
    path.write_bytes(aedat4(both, WIDTH, HEIGHT, frames + later))
    with pytest.raises(DataError, match=f"--stop {count}' keeps .* 'evsplat import davis', with"):
        import_capture("davis", path, tmp_path / "out")
    part = {"skip": count, "frames": (COUNT, 2 * COUNT)} if second else {"stop": count}
    part = {"frames": (0, COUNT), **part}
    capture = run("davis", path, tmp_path / "out", **part)
    whole = run("davis", davis, tmp_path / "whole", frames=(0, COUNT))
    assert [f.exposure_us for f in capture.frames] == [f.exposure_us for f in whole.frames]
    assert capture.events is not None and whole.events is not None
    one, other = (c.events.between(-(1 << 40), 1 << 40) for c in (capture, whole))
    assert np.array_equal(one.t, other.t) and np.array_equal(one.x, other.x)


def test_frames_that_a_repair_leaves_out_are_told(tmp_path: Path, rng: np.random.Generator) -> None:
    """The events are read after them, and are whole."""
    path, lost = tmp_path / "dance.aedat4", int(rng.integers(1, COUNT - 1))
    data = aedat4(some_events(EPOCH_US), WIDTH, HEIGHT, some_frames(EPOCH_US), compression=0)
    parts = data.split(b"FRME")
    path.write_bytes(b"FRME".join(parts[:-lost]) + b"LOST" + b"FRME".join(parts[-lost:]))
    capture = run("davis", path, tmp_path / "out", repair=True)
    assert len(capture.frames) == COUNT - 1
    assert "repaired: leaves out damaged packets (1)" in capture.provenance["notes"]


def test_aedat3_makes_the_capture_that_aedat4_makes(davis: Path, tmp_path: Path) -> None:
    # the clock of 31 bits begins again within an exposure
    begin_us = (1 << 31) - 3_000 - 2 * PERIOD_US - EXPOSURE_US // 2
    path = tmp_path / "dance.aedat"
    path.write_bytes(aedat3(some_events(begin_us), WIDTH, HEIGHT, some_frames(begin_us)))
    old, new = (run("davis", p, tmp_path / p.suffix[1:]) for p in (path, davis))
    assert [f.exposure_us for f in old.frames] == [f.exposure_us for f in new.frames]
    for frame in old.frames:
        assert np.array_equal(old.image(frame), new.image(frame))
        assert old.transfer(frame) == "linear"
    assert old.events is not None and new.events is not None
    a, b = old.events.between(0, 1 << 40), new.events.between(0, 1 << 40)
    assert all(np.array_equal(getattr(a, n), getattr(b, n)) for n in ("t", "x", "y", "p"))


def test_a_bag_is_refused_with_how_its_pictures_come_in(
    tmp_path: Path, capsys, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = Path("dance.bag")
    starts = [EPOCH_US + index * PERIOD_US for index in range(COUNT)]
    taken = [(p, t, t + 30_000) for p, t in zip(moving_bar(), starts, strict=True)]
    path.write_bytes(bag(some_events(EPOCH_US), WIDTH, HEIGHT, taken))
    assert main(["import", "davis", str(path), "--out", "out"]) == 2
    error = capsys.readouterr().err
    assert "of a ROS bag events alone are read" in error and "exposures.txt" in error
    page = Path(__file__).parents[2] / "docs" / "event-formats.md"
    programs = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    exec(next(program for program in programs if "rosbags" in program), {})
    capture = run("folder", Path("bag"), tmp_path / "out", events=path, transfer="linear")
    assert [f.exposure_us for f in capture.frames] == [(t, t + 30_000) for t in starts]
    for frame, picture in zip(capture.frames, moving_bar(), strict=True):
        assert np.array_equal((capture.image(frame)[..., 0] * 255).round(), picture)
    assert capture.events is not None and capture.transfer(capture.frames[0]) == "linear"
    got, given = capture.events.between(0, 1 << 62), some_events(EPOCH_US)
    assert np.array_equal(got.t, given.t) and np.array_equal(got.p, given.p)


def events_of_the_bar(first_us: int) -> EventStream:
    """What a sensor sends of `moving_bar`, which goes on by a pixel each half period."""
    rows = np.arange(HEIGHT)
    columns = []
    for step in range(2 * COUNT):
        time = first_us + step * PERIOD_US // 2
        columns += [(time, step + 6, 1), (time, step, -1)]
    t, x, p = (np.repeat(values, HEIGHT) for values in np.array(columns).T)
    y = np.tile(rows, len(columns))
    return EventStream(t, x.astype(np.uint16), y.astype(np.uint16), p.astype(np.int8))


def test_the_offset_of_the_events_clock_is_found(tmp_path: Path) -> None:
    clip, events = tmp_path / "clip.mp4", tmp_path / "events.h5"
    write_video(clip, [np.repeat(p[..., None], 3, axis=2) for p in moving_bar()], fps=25)
    write_events(events, events_of_the_bar(3_000_000))
    options = {"events": events, "exposure_us": 20_000.0, "clock_offset_us": "auto"}
    capture = run("video", clip, tmp_path / "out", **options)
    # The bar of a picture stands still for the period about it, and moves in two steps.
    assert capture.clock_offset_us == pytest.approx(-3_000_000, abs=PERIOD_US / 2)
    (note,) = (note for note in capture.provenance["notes"] if "offset of their clock" in note)
    assert f"is found, {capture.clock_offset_us} us, to about 5.5 ms (correlation" in note


def test_a_davis_whose_events_have_a_clock_of_their_own_is_brought_onto_that_of_its_frames(
    rng: np.random.Generator,
    tmp_path: Path,
) -> None:
    """Whichever way the offset comes, found or given, and wherever the clocks begin."""
    path = tmp_path / "dance.aedat4"
    begin_us = EPOCH_US + int(rng.integers(1_000_000))
    # by more than the recording is long, so that none is at the time of a picture
    ahead_us = int(rng.choice([-1, 1]) * rng.integers(1_000_000, 5_000_000))
    frames = some_frames(begin_us)
    path.write_bytes(aedat4(events_of_the_bar(begin_us + ahead_us), WIDTH, HEIGHT, frames))
    with pytest.raises(DataError, match="give --clock-offset-us auto, which finds the offset.$"):
        import_capture("davis", path, tmp_path / "out")
    found = run("davis", path, tmp_path / "out", clock_offset_us="auto")
    # a picture's bar stands still for the period about it, and its middle is 15.5 ms after begin
    expected_us = 15_500 - ahead_us
    assert found.clock_offset_us == pytest.approx(expected_us, abs=PERIOD_US / 2)
    assert any("offset of their clock is found" in note for note in found.provenance["notes"])
    given = run("davis", path, tmp_path / "given", clock_offset_us=found.clock_offset_us)
    assert given.clock_offset_us == found.clock_offset_us
    assert min(given.events.time_range_us[0], given.frames[0].exposure_us[0]) == 0
    for capture in (found, given):
        first_us = capture.events.time_range_us[0] - capture.frames[0].exposure_us[0]
        assert first_us == ahead_us + found.clock_offset_us - 3_000
        assert len(capture.events) == len(events_of_the_bar(0))
    part = run("davis", path, tmp_path / "part", frames=(3, 7), clock_offset_us="auto")
    start, end = part.frames[0].exposure_us[0], part.frames[-1].exposure_us[1]
    first, last = part.events.time_range_us
    assert start == 0 and start <= first < start + PERIOD_US and end - PERIOD_US < last <= end
    assert part.clock_offset_us == pytest.approx(expected_us, abs=PERIOD_US / 2)


@pytest.mark.parametrize("wider", range(4))
def test_the_offset_is_found_as_well_where_pictures_are_made_smaller(
    tmp_path: Path, wider: int
) -> None:
    """Of any size: the blocks of small pictures are those of the sensor."""
    path = tmp_path / "dance.aedat4"
    frames = [
        (np.pad(picture, ((0, 0), (0, wider)), mode="edge"), start, end)
        for picture, start, end in some_frames(EPOCH_US)
    ]
    events = events_of_the_bar(EPOCH_US + 3_000_000)
    path.write_bytes(aedat4(events, WIDTH + wider, HEIGHT, frames))
    whole, small = (
        run("davis", path, tmp_path / f"by{factor}", clock_offset_us="auto", shrink=factor)
        for factor in (1, 2)
    )
    assert small.clock_offset_us == pytest.approx(whole.clock_offset_us, abs=PERIOD_US / 2)


def test_a_davis_whose_offset_is_not_found_is_told_that_it_needs_none(
    davis: Path, tmp_path: Path
) -> None:
    with pytest.raises(DataError, match="at no offset .*leave --clock-offset-us out, as a sensor"):
        import_capture("davis", davis, tmp_path / "out", clock_offset_us="auto")
    assert not (tmp_path / "out").exists()


def test_a_davis_recording_is_made_smaller_as_a_video_is(davis: Path, tmp_path: Path) -> None:
    whole = run("davis", davis, tmp_path / "whole", focal=60.0)
    small = run("davis", davis, tmp_path / "small", focal=60.0, shrink=2, contrast=(0.4, 0.2))
    camera = small.camera(small.frames[0])
    assert (camera.width, camera.height, camera.K[0, 0]) == (WIDTH // 2, HEIGHT // 2, 30)
    for frame in small.frames:
        squares = whole.image(frame.name).reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3)
        assert (small.image(frame) - squares.mean((1, 3))).abs().max() < 0.51 / 255
        assert frame.exposure_us == whole.frame(frame.name).exposure_us
    one, other = (capture.events.between(0, 1 << 40) for capture in (whole, small))
    assert np.array_equal(one.x // 2, other.x) and np.array_equal(one.t, other.t)
    assert small.contrast_threshold == (0.1, 0.05)


def test_mirrored_events_are_told_where_their_offset_is_looked_for(tmp_path: Path) -> None:
    """As a beam splitter mirrors one of two cameras whose clocks know nothing of each other."""
    clip, events = tmp_path / "clip.mp4", tmp_path / "events.h5"
    write_video(clip, [np.repeat(p[..., None], 3, axis=2) for p in moving_bar()], fps=25)
    given = events_of_the_bar(3_000_000)
    write_events(events, replace(given, x=(WIDTH - 1 - given.x).astype(np.uint16)))
    options = {"exposure_us": 20_000.0, "clock_offset_us": "auto"}
    with pytest.raises(DataError, match="only if they were mirrored left to right") as refusal:
        import_capture("video", clip, tmp_path / "out", events=events, **options)
    offset_us = float(str(refusal.value).split("offset of ")[1].split(" us")[0])
    assert offset_us == pytest.approx(-3_000_000, abs=PERIOD_US / 2)


@pytest.mark.parametrize(
    ("events", "said"),
    [
        (some_events(0), "agree with the changes of the pictures at no offset of the clocks"),
        (EventStream(*(np.zeros(0, kind) for kind in ("i8", "u2", "u2", "i1"))), "at no offset"),
    ],
)
def test_an_offset_that_is_not_certain_is_refused(tmp_path: Path, events, said) -> None:
    clip = tmp_path / "clip.mp4"
    write_video(clip, [np.repeat(p[..., None], 3, axis=2) for p in moving_bar()], fps=25)
    write_events(tmp_path / "events.h5", events)
    with pytest.raises(DataError, match="events.h5: .*give --clock-offset-us US") as refusal:
        import_capture(
            "video",
            clip,
            tmp_path / "out",
            events=tmp_path / "events.h5",
            exposure_us=20_000.0,
            clock_offset_us="auto",
        )
    assert said in str(refusal.value) and "\n" not in str(refusal.value)
    assert not (tmp_path / "out").exists()


def test_a_video_with_events_beside_it(tmp_path: Path) -> None:
    clip = tmp_path / "clip.mp4"
    write_video(clip, [np.repeat(p[..., None], 3, axis=2) for p in moving_bar()], fps=25)
    write_events(tmp_path / "events.h5", some_events(500))
    camera = {"width": WIDTH, "height": HEIGHT, "K": [[50, 0, 24], [0, 50, 16], [0, 0, 1]]}
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    capture = run(
        "video",
        clip,
        tmp_path / "out",
        events=tmp_path / "events.h5",
        exposure_us=20_000.0,
        start_us=10_000,
        clock_offset_us=-500,
        camera=tmp_path / "camera.json",
        transfer="srgb",
    )
    assert [f.exposure_us for f in capture.frames] == [
        (i * PERIOD_US, i * PERIOD_US + 20_000) for i in range(COUNT)
    ]
    seen = capture.image(capture.frames[3])[..., 0].numpy() * 255
    assert np.abs(seen - moving_bar()[3]).mean() < 9
    assert capture.events is not None and capture.events.time_range_us[0] == 0
    assert capture.provenance["focal"] == "calibrated"
    assert capture.transfer(capture.frames[0]) == "srgb"


def test_a_mirrored_sensor_is_brought_into_the_video_and_its_clock_is_found_there(
    rng: np.random.Generator,
    tmp_path: Path,
) -> None:
    """As behind a beam splitter, where events as they are agree at no offset."""
    clip, events = tmp_path / "clip.mp4", tmp_path / "events.h5"
    write_video(clip, [np.repeat(p[..., None], 3, axis=2) for p in moving_bar()], fps=25)
    given = events_of_the_bar(3_000_000)
    right = int(rng.integers(0, 30))
    x = WIDTH - 1 - given.x + right
    write_events(events, replace(given, x=x.astype(np.uint16)), width=90, height=HEIGHT)
    np.savetxt(tmp_path / "H.txt", [[-1, 0, WIDTH - 1 + right], [0, 1, 0], [0, 0, 1]])
    options = {"exposure_us": 20_000.0, "clock_offset_us": "auto", "shrink": 2}
    options |= {"events": events, "homography": tmp_path / "H.txt"}
    capture = run("video", clip, tmp_path / "out", **options)
    assert capture.clock_offset_us == pytest.approx(-3_000_000, abs=PERIOD_US / 2)
    assert capture.events is not None
    found = capture.events.between(-(1 << 40), 1 << 40)
    inside = given.take(given.x < WIDTH)
    assert np.array_equal(found.x, inside.x // 2) and np.array_equal(found.p, inside.p)


def test_a_part_of_a_video_keeps_its_clock_and_the_events_of_its_time(
    rng: np.random.Generator, tmp_path: Path
) -> None:
    clip, given = tmp_path / "clip.mp4", some_events(500)
    write_video(clip, [np.repeat(p[..., None], 3, axis=2) for p in moving_bar()], fps=25)
    write_events(tmp_path / "events.h5", given)
    options = {"events": tmp_path / "events.h5", "exposure_us": 20_000.0, "clock_offset_us": -500}
    first, stop = sorted(rng.choice(COUNT, 2, replace=False).tolist())
    part = run("video", clip, tmp_path / "part", frames=(first, stop), **options)
    whole = run("video", clip, tmp_path / "whole", **options)
    assert [frame.name for frame in part.frames] == [f"{i:06d}" for i in range(first, stop)]
    for frame in part.frames:
        assert frame.exposure_us == whole.frame(frame.name).exposure_us
        assert np.array_equal(part.image(frame), whole.image(frame.name))
    begin, end = part.frames[0].exposure_us[0], part.frames[-1].exposure_us[1]
    assert part.events is not None and whole.events is not None
    assert len(whole.events) == len(given)
    assert np.array_equal(
        part.events.between(-(1 << 40), 1 << 40).t, whole.events.between(begin, end).t
    )
    assert part.provenance["frames"] == [first, stop]
    with pytest.raises(ConfigError, match=f"no frame in 40..49; there are 0..{COUNT - 1}"):
        import_capture("video", clip, tmp_path / "none", frames=(40, 50), exposure_us=20_000.0)
    assert not (tmp_path / "none").exists()


def test_of_large_pictures_the_least_factor_that_leaves_few_pixels_is_told(
    rng: np.random.Generator,
) -> None:
    for width, height in rng.integers(1300, 8000, (20, 2)).tolist():
        (note,) = large_pictures((width, height))
        factor = int(note.split("--shrink ")[1].split()[0])
        assert width * height / factor**2 <= 1_500_000 < width * height / (factor - 1) ** 2
        assert note.endswith(f"makes them {width // factor}x{height // factor}")
    assert large_pictures((1280, 720)) == []


@pytest.fixture
def finder(monkeypatch):
    """A stand-in for the search, which takes most of the time; gives what it was asked for."""
    asked = []

    def found(path, out, search, *, keypoints, overwrite, warn):
        capture = load_capture(path, needs_body=False, warn=warn)
        asked.append((capture, search, keypoints))
        with derived_capture(capture, out, replace=overwrite) as making:
            making.document["provenance"]["poses"] = "found"

    monkeypatch.setattr(posing, "find_poses", found)
    return asked


def test_an_import_goes_on_to_find_poses_and_leaves_one_capture(
    davis: Path, tmp_path: Path, finder: list
) -> None:
    out = tmp_path / "out"
    points = tmp_path / "points.npy"
    np.save(points, np.full((COUNT, 17, 3), 0.5))
    for height, overwrite, keypoints in ((1.7, False, None), (1.8, True, points)):
        options = PoseOptions(height_m=height)
        import_capture(
            "davis", davis, out, find_poses=options, keypoints=keypoints, overwrite=overwrite
        )
        assert load_capture(out).provenance["poses"] == "found"
        capture, search, asked = finder.pop()
        assert not capture.has_body and capture.name == "out"
        assert (search.height_m, asked) == (height, keypoints)
        names = ["dance.aedat4", "out", "points.npy"]
        assert sorted(path.name for path in tmp_path.iterdir()) == names


def test_what_is_said_on_the_way_to_poses_names_the_capture_that_stays(
    tmp_path: Path, finder: list, caplog: pytest.LogCaptureFixture
) -> None:
    source = trees.write_zju_raw(tmp_path / "CoreView_377")
    for mask in (source / "mask_cihp" / "Camera_B1").iterdir():
        mask.unlink()
    with caplog.at_level("INFO", "evsplat"):
        import_capture("zju-mocap", source, tmp_path / "out", find_poses=True)
    assert f"masks {tmp_path / 'out'}" in caplog.text
    assert "out_unposed" not in caplog.text


def test_key_points_that_cannot_be_read_are_refused_before_anything_is_imported(
    davis: Path, tmp_path: Path, finder: list, capsys
) -> None:
    command = ["import", "davis", str(davis), "--out", str(tmp_path / "out"), "--find-poses"]
    assert main([*command, "--keypoints", str(tmp_path / "points.npy")]) == 2
    assert "points.npy" in capsys.readouterr().err
    with pytest.raises(ConfigError, match="find_poses=True"):
        import_capture("davis", davis, tmp_path / "out", keypoints=tmp_path / "points.npy")
    assert not finder and [path.name for path in tmp_path.iterdir()] == ["dance.aedat4"]


def test_where_no_poses_are_found_the_capture_without_them_stays(
    davis: Path, tmp_path: Path, monkeypatch
) -> None:
    def nobody(path, out, search, **how):
        raise DataError("nobody")

    monkeypatch.setattr(posing, "find_poses", nobody)
    out = tmp_path / "out"
    import_capture("davis", davis, out, frames=(0, 5))
    with pytest.raises(DataError, match="nobody"):
        import_capture("davis", davis, out, find_poses=True, overwrite=True)
    assert len(load_capture(out).frames) == 5, "what was there comes back"
    assert len(load_capture(tmp_path / "out_unposed").frames) == COUNT
    names = ["dance.aedat4", "out", "out_unposed"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names


def test_options_of_poses_that_are_not_searched_for_are_refused(davis: Path, capsys) -> None:
    command = ["import", "davis", str(davis), "--out", str(davis.with_name("out"))]
    for option in (("--height", "1.7"), ("--keypoints", "points.npy")):
        assert main([*command, *option]) == 2
        assert "belong to --find-poses" in capsys.readouterr().err


def test_poses_of_a_data_set_can_be_left_out(tmp_path: Path) -> None:
    source = trees.write_zju_raw(tmp_path / "CoreView_377")
    capture = run("zju-mocap", source, tmp_path / "out", no_poses=True)
    assert len(capture.frames) == trees.FRAMES and not capture.has_body


def aedat_without_frames(path: Path) -> dict:
    path.write_bytes(aedat4(some_events(EPOCH_US), WIDTH, HEIGHT))
    return {}


def aedat_of_two_sizes(path: Path) -> dict:
    frame = np.zeros((HEIGHT // 2, WIDTH), np.uint8), EPOCH_US, EPOCH_US + 10
    path.write_bytes(aedat4(some_events(EPOCH_US), WIDTH, HEIGHT, [frame]))
    return {}


def aedat_without_exposure(path: Path) -> dict:
    frame = np.zeros((HEIGHT, WIDTH), np.uint8), EPOCH_US, EPOCH_US
    path.write_bytes(aedat4(some_events(EPOCH_US), WIDTH, HEIGHT, [frame]))
    return {}


def clip_of_one(path: Path) -> dict:
    write_video(path, [np.zeros((HEIGHT, WIDTH, 3), np.uint8)] * 2, fps=25)
    return {}


def clip_with_two_cameras(path: Path) -> dict:
    clip_of_one(path)
    return {"exposure_us": 1e4, "focal": 40.0, "camera": path}


FAULTS = {
    "no frames": ("davis", aedat_without_frames, DataError, "no frames beside .*import video"),
    "two sizes": ("davis", aedat_of_two_sizes, DataError, "have 48x16 pixels and its ev.* 48x32"),
    "no length": ("davis", aedat_without_exposure, DataError, "frame 0 is exposed from"),
    "no exposure": ("video", clip_of_one, ConfigError, "how long the shutter was open is not"),
    "two cameras": ("video", clip_with_two_cameras, ConfigError, "--focal: .* holds the camera"),
    "no clip": ("video", lambda path: {}, DataError, "clip.*: no such video file"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_is_missing_is_one_sentence(tmp_path: Path, fault: str) -> None:
    kind, make, error, message = FAULTS[fault]
    source = tmp_path / ("clip.mp4" if kind == "video" else "clip.aedat4")
    options = make(source)
    with pytest.raises(EvsplatError, match=message) as caught:
        import_capture(kind, source, tmp_path / "out", **options)
    assert isinstance(caught.value, error) and "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("sensor", [(1280, 720), (24, 16)])
def test_events_in_the_pixels_of_another_sensor_are_refused(
    tmp_path: Path, sensor: tuple[int, int]
) -> None:
    write_video(
        tmp_path / "clip.mp4", [np.repeat(p[..., None], 3, -1) for p in moving_bar()], fps=25
    )
    events, (width, height) = some_events(0), sensor
    inside = EventStream(events.t, events.x % width, events.y % height, events.p)
    write_events(tmp_path / "events.h5", inside, width=width, height=height)
    with pytest.raises(
        ConfigError, match=f"its sensor has {width}x{height} pixels, the pictures"
    ) as e:
        import_capture(
            "video",
            tmp_path / "clip.mp4",
            tmp_path / "out",
            exposure_us=EXPOSURE_US,
            events=tmp_path / "events.h5",
        )
    assert f"convert {tmp_path / 'events.h5'} NEW.h5 --width {WIDTH} --height {HEIGHT}" in str(
        e.value
    )
    assert not (tmp_path / "out").exists()
