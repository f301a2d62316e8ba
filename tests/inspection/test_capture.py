"""`inspect_capture`: right words, right pictures, and nothing drawn of a broken capture."""

import json
import re
import shlex
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from PIL import Image

from evsplat.capture import load_body_track, load_capture
from evsplat.capture.finding import Finding
from evsplat.cli import main
from evsplat.errors import DataError
from evsplat.inspection import body_mask_overlap, inspect_capture, warn_of_events, warn_of_pictures
from evsplat.inspection.picture_check import picture_findings
from evsplat.training.sound import check_events_reach

from ..conftest import write_event_file
from ..seen import seen

Factory = Callable[..., Path]


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only what is said: a third of the time goes into drawings, of which other tests ask."""
    module = "evsplat.inspection.capture"
    for drawing in ("_contact_sheet", "_body_sheet", "_events_sheet", "draw_timeline", "fit_sheet"):
        monkeypatch.setattr(f"{module}.{drawing}", lambda *_: None)
    monkeypatch.setattr(f"{module}.save_drawings", lambda drawings, out: ())


def test_summary_states_what_was_recorded(tiny_capture: Factory, tmp_path: Path) -> None:
    path = tiny_capture(frames=12)
    report = inspect_capture(path, tmp_path / "out")
    assert report.usable and report.findings == ()
    for words in (
        "12: 9 train, 3 test; main 32x24, standing camera",
        "25 frames/s, exposure 30 ms",
        "simulated, C+ 0.2, C- 0.2",
        "rig: 3 joints, 16 vertices; 12 key poses from 0.015 to 0.455 s",
        "12 sharp, 12 masks, 3 novel views (side 3)",
        "findings   none",
    ):
        assert words in report.summary
    names = sorted(picture.name for picture in report.pictures)
    assert names == ["body.png", "body_fit.png", "contact_sheet.png", "events.png", "timeline.png"]
    for picture in report.pictures:
        with Image.open(picture) as image:
            assert image.width >= 700 and len(np.unique(np.asarray(image.convert("L")))) > 50


@pytest.mark.usefixtures("undrawn")
def test_one_of_a_kind_is_told_in_the_singular(tiny_capture: Factory, tmp_path: Path) -> None:
    path = tiny_capture(frames=8)
    document = json.loads((path / "capture.json").read_text())
    for frame in document["frames"][1:]:
        del frame["mask"]
    (path / "capture.json").write_text(json.dumps(document))
    assert "8 sharp, 1 mask, 1 novel view (side 1)" in inspect_capture(path, tmp_path).summary


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("longest_us", [32_000, 60_000])
@pytest.mark.parametrize("skipped", [0, 3])
def test_summary_tells_times_that_differ_from_frame_to_frame(
    tiny_capture: Factory, tmp_path: Path, longest_us: int, skipped: int
) -> None:
    path = tiny_capture(frames=12)
    document = json.loads((path / "capture.json").read_text())
    frames = document["frames"]
    frames[-1]["exposure_us"][1] = frames[-1]["exposure_us"][0] + longest_us
    document["frames"] = [*frames[:4], *frames[4 + skipped :]]
    (path / "capture.json").write_text(json.dumps(document))
    summary = inspect_capture(path, tmp_path / "out").summary
    last_ms = 40 + (longest_us - 30_000) / 2000
    (line,) = (line for line in summary.splitlines() if line.startswith("time "))
    uneven = skipped or longest_us == 60_000
    apart = max(last_ms, 40 * (skipped + 1))
    assert (f"25 frames/s (median; 40 to {apart:.4g} ms apart)" in line) == bool(uneven)
    assert ("exposure 30 ms (median; 30 to 60 ms)" in line) == (longest_us == 60_000)


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("together", [False, True])
@pytest.mark.parametrize("cameras", [2, 3])
def test_times_of_several_cameras_are_those_of_each(
    tiny_capture: Factory, tmp_path: Path, cameras: int, together: bool
) -> None:
    """Their frames may come camera by camera, or all of a time together."""
    path = tiny_capture(frames=12)
    document = json.loads((path / "capture.json").read_text())
    del document["events"]
    (path / "events.h5").unlink()
    main, own = document["cameras"]["main"], document["frames"]
    for number in range(1, cameras):
        name = f"other{number}"
        document["cameras"][name] = main
        # the last of the others stops earlier
        for frame in own[: 12 - number]:
            other = {"name": f"{name}_{frame['name']}", "camera": name, "split": frame["split"]}
            other["image"], other["exposure_us"] = frame["image"], frame["exposure_us"]
            document["frames"].append(other)
    if together:
        document["frames"].sort(key=lambda frame: frame["exposure_us"])
    (path / "capture.json").write_text(json.dumps(document))
    summary = inspect_capture(path, tmp_path / "out").summary
    assert "time       0.470 s, 25 frames/s, exposure 30 ms" in summary
    assert "32x24, standing cameras\n" in summary


def test_events_without_polarity_are_told_from_a_scene_that_stands_still(
    tiny_capture: Factory, tmp_path: Path
) -> None:
    path = tiny_capture()
    with h5py.File(path / "events.h5", "r+") as file:
        file["events/p"][...] = 0
    summary = inspect_capture(path, tmp_path / "out").summary
    assert "not estimated: events without polarity" in summary
    assert "too little moves, or" not in summary and "--clock-offset-us" not in summary


def test_no_event_and_one_frame_are_not_blamed_on_what_moves(
    tiny_capture: Factory, tmp_path: Path
) -> None:
    path = tiny_capture(frames=4)
    write_event_file(path / "events.h5", *[np.zeros(0, np.int64)] * 4)
    assert "not estimated: there is no event" in inspect_capture(path, tmp_path / "out").summary
    with pytest.raises(DataError, match=r"holds no event that .* event_weight=0\.$"):
        check_events_reach(seen(path))
    one = inspect_capture(tiny_capture("one", frames=1), tmp_path / "of one").summary
    assert "not estimated: one frame shows no change" in one


def test_one_frame_has_no_delay(
    tiny_capture: Factory, tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    report = inspect_capture(tiny_capture(frames=1), tmp_path / "out")
    assert report.usable and "1: 1 train, 0 test" in report.summary
    assert not recwarn.list and not re.search("frames? (ahead|behind)", report.summary)


def test_broken_capture_is_reported_and_not_drawn(tiny_capture: Factory, tmp_path: Path) -> None:
    path = tiny_capture()
    (path / "images/0002.png").unlink()
    report = inspect_capture(path, tmp_path / "out")
    assert not report.usable and report.pictures == ()
    assert str(path / "images/0002.png") in report.summary
    assert not (tmp_path / "out").exists()


def test_posed_body_falls_on_the_person_of_the_tiny_capture(tiny_capture: Factory) -> None:
    """The fixture poses its boxes by its own kinematics and draws them by Pillow."""
    capture = load_capture(tiny_capture(width=64, height=48))
    overlaps = body_mask_overlap(capture, load_body_track(capture), capture.frames)
    assert len(overlaps) == 10 and min(overlaps) > 0.85


@pytest.mark.parametrize("left", [1, 4])
def test_frames_after_the_person_left_say_nothing_of_the_fit(
    tiny_capture: Factory, left: int
) -> None:
    path = tiny_capture(width=64, height=48)
    for index in range(10 - left, 10):
        Image.new("L", (64, 48)).save(path / f"masks/{index:04d}.png")
    with np.load(path / "body.npz") as file:
        arrays = dict(file)
    arrays["transl"][10 - left :, 0] += 100
    np.savez(path / "body.npz", **arrays)
    capture = load_capture(path)
    overlaps = body_mask_overlap(capture, load_body_track(capture), capture.frames)
    assert len(overlaps) == 10 - left and min(overlaps) > 0.85
    # A body that is still in the picture when the person has left does not fit.
    arrays["transl"][-1, 0] -= 100
    np.savez(path / "body.npz", **arrays)
    capture = load_capture(path)
    assert min(body_mask_overlap(capture, load_body_track(capture), capture.frames)) == 0.0


@pytest.mark.parametrize("name", ["man_dance_hard_256", "real_beam_256"])
def test_posed_body_falls_on_the_person_of_shared_captures(captures_root: Path, name: str) -> None:
    """The masks show clothes and hair, which the body lacks; a wrong pose would be far below."""
    capture = load_capture(captures_root / name)
    assert min(body_mask_overlap(capture, load_body_track(capture), capture.frames[::6])) > 0.8


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("spoilt", ["nothing", "mirrored", "inverted", "one sign"])
def test_events_that_say_otherwise_than_the_frames_are_told(
    tiny_capture: Factory, tmp_path: Path, spoilt: str, caplog: pytest.LogCaptureFixture
) -> None:
    """`warn_of_events` says before a training what `inspect` finds, and neither more than that."""
    path = tiny_capture(frames=20, width=96, height=72)
    with h5py.File(path / "events.h5", "r+") as file:
        if spoilt == "mirrored":
            file["events/x"][...] = 95 - file["events/x"][...]
        if spoilt == "inverted":
            file["events/p"][...] = 1 - file["events/p"][...]
        if spoilt == "one sign":
            file["events/p"][...] = 1
    report = inspect_capture(path, tmp_path / "out")
    words = {
        "nothing": None,
        "mirrored": "events/x, events/y: found events that fit the frames only if they were "
        "mirrored left to right (",
        "inverted": "events/p: found events that fit the frames only if they were of the other",
        "one sign": "events/p: found brighter events alone",
    }[spoilt]
    of_events = [str(finding) for finding in report.findings if finding.file.suffix == ".h5"]
    caplog.clear()
    with caplog.at_level("WARNING"):
        warn_of_events(seen(path))
    if words is None:
        assert not of_events and not caplog.messages
        assert "clock      events" in report.summary
        return
    assert len(of_events) == len(caplog.messages) == 1
    assert words in of_events[0] and words in caplog.messages[0]
    assert "not estimated: events do not tell what the frames show" in report.summary


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda pixels: pixels // 16, "brightest values are"),
        (lambda pixels: pixels * 0 + 255, "100% of the pixels clipped"),
        (lambda pixels: pixels * 0 + 128, "the same in "),
        (lambda pixels: pixels, None),
    ],
)
def test_pictures_of_which_nothing_can_be_learned_are_told(
    tiny_capture: Factory,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    change: Callable[[np.ndarray], np.ndarray],
    words: str | None,
) -> None:
    path = tiny_capture()
    for file in (path / "images").iterdir():
        with Image.open(file) as image:
            pixels = np.array(image)
        Image.fromarray(change(pixels).astype(np.uint8)).save(file)
    with caplog.at_level("WARNING"):
        warn_of_pictures(seen(path))
    assert [words in message for message in caplog.messages] == ([True] if words else [])
    findings = inspect_capture(path, tmp_path / "out").findings
    found = [each.found for each in findings if each.file.name == "images"]
    assert len(found) == (words is not None)


@pytest.mark.parametrize(
    ("shown", "repeated"),
    [
        (lambda i: i, 0),
        (lambda i: i // 2 * 2, 10),
        (lambda i: i // 4 * 4, 15),
        (lambda i: i - (i % 5 in (1, 3)), 8),  # 3 of 5, as 24 frames a second as 40
        (lambda i: max(i, 9), 0),  # stands still at first
        (lambda i: min(i, 18), 0),  # one repeat may be chance
        (lambda i: min(i, 16), 0),  # left shortly before the end
    ],
)
def test_a_video_exported_with_more_frames_than_were_taken_is_told(
    tiny_capture: Factory,
    caplog: pytest.LogCaptureFixture,
    shown: Callable[[int], int],
    repeated: int,
) -> None:
    path = tiny_capture(frames=20)
    document = json.loads((path / "capture.json").read_text())
    files = [path / frame["image"] for frame in document["frames"]]
    for frame in document["frames"]:
        frame["split"] = "train"
    (path / "capture.json").write_text(json.dumps(document))
    pictures = [file.read_bytes() for file in files]
    assert len(set(pictures)) == 20
    for i, file in enumerate(files):
        file.write_bytes(pictures[shown(i)])
    with caplog.at_level("WARNING"):
        warn_of_pictures(seen(path))
    told = [message for message in caplog.messages if "the one before once more" in message]
    assert [f"{repeated} of 20 pictures" in message for message in told] == [True] * bool(repeated)


@pytest.mark.parametrize("moves", [True, False])
def test_equal_pictures_without_events_between_them_are_of_somebody_who_stands_still(
    tiny_capture: Factory, moves: bool
) -> None:
    """Pauses of three pictures before a camera without noise look like an export's repeats."""
    path = tiny_capture(frames=20)
    document = json.loads((path / "capture.json").read_text())
    for frame in document["frames"]:
        frame["split"] = "train"
    (path / "capture.json").write_text(json.dumps(document))
    files = [path / frame["image"] for frame in document["frames"]]
    middles = [sum(frame["exposure_us"]) / 2 for frame in document["frames"]]
    with h5py.File(path / "events.h5") as file:
        t, x, y, p = (file[f"events/{name}"][:] for name in "txyp")
    kept = np.full(len(t), True)
    for first in (4, 12):
        for file in files[first + 1 : first + 4]:
            file.write_bytes(files[first].read_bytes())
        kept &= (t < middles[first]) | (t > middles[first + 3])
    if not moves:
        write_event_file(path / "events.h5", t[kept], x[kept], y[kept], p[kept])
    told = [found.found for found in picture_findings(seen(path))]
    assert [text.startswith("6 of 20 pictures") for text in told] == [True] * moves


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(("longer", "moves"), [(True, False), (False, False), (True, True)])
@pytest.mark.parametrize("factor", [1.0, 1.3, 4.0])
def test_pictures_whose_brightness_changes_are_told_and_no_lost_events_are(
    tiny_capture: Factory, tmp_path: Path, factor: float, longer: bool, moves: bool
) -> None:
    """As of a camera that sets its exposure by itself, or of one beside a lamp that goes on."""
    path = tiny_capture(frames=20, width=96, height=72, seed=round(10 * factor))
    document = json.loads((path / "capture.json").read_text())
    for i, frame in enumerate(document["frames"] if moves else []):
        frame["world_to_camera"] = np.array(document["cameras"]["main"]["world_to_camera"])
        frame["world_to_camera"][0, 3] += 1e-3 * i
        frame["world_to_camera"] = frame["world_to_camera"].tolist()
    for frame in document["frames"][::2]:
        file = path / frame["image"]
        with Image.open(file) as image:
            light = (np.array(image) / 255) ** 2.2
        Image.fromarray(np.uint8(255 * (light / factor) ** (1 / 2.2) + 0.5)).save(file)
        if longer:
            frame["exposure_us"][0] += 10_000
            frame["exposure_us"][1] -= 10_000
    (path / "capture.json").write_text(json.dumps(document))
    findings = inspect_capture(path, tmp_path / "out").findings
    told = [finding.found for finding in findings if finding.file.name == "images"]
    assert len(told) == (factor != 1)
    for found in told:
        stated = re.search(r"(three quarters of )?the scene ([\d.]+) times as bright", found)
        assert stated and bool(stated[1]) != moves
        assert float(stated[2]) == pytest.approx(factor, rel=0.05)
        assert ("longer exposures brighter" in found) == longer
    assert not [finding for finding in findings if finding.field == "events/t"]


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_given_thresholds_that_are_not_the_fitted_are_told(
    tiny_capture: Factory, tmp_path: Path, factor: float
) -> None:
    path = tiny_capture(frames=20, width=96, height=72)
    document = json.loads((path / "capture.json").read_text())
    given = [factor * one for one in document["events"]["contrast_threshold"]]
    document["events"]["contrast_threshold"] = given
    (path / "capture.json").write_text(json.dumps(document))
    found = [
        finding.found
        for finding in inspect_capture(path, tmp_path / "out").findings
        if finding.field == "events.contrast_threshold"
    ]
    assert len(found) == (factor != 1)
    assert all(text.startswith(f"{given}, and an event stands for") for text in found)


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("wrong", ["shifted", "turned", "inverted", "turned and inverted"])
def test_what_is_told_to_type_brings_events_into_the_pixels_of_the_pictures(
    rng: np.random.Generator, tiny_capture: Factory, tmp_path: Path, wrong: str
) -> None:
    def of_events(findings: tuple[Finding, ...]) -> list[Finding]:
        return [finding for finding in findings if finding.file.suffix == ".h5"]

    path, out = tiny_capture("my capture", frames=12, width=64, height=48), tmp_path / "out"
    found = out / "events_to_pictures.txt"
    with h5py.File(path / "events.h5") as file:
        t, x, y, p = (file[f"events/{key}"][:] for key in "txyp")
    right = int(rng.integers(4, 8)) if wrong == "shifted" else 0
    kept = x + right < 64
    t, x, y, p = (column[kept] for column in (t, x, y, p))
    of_file = [t, x + right, y, 1 - p if "inverted" in wrong else p]
    if "turned" in wrong:
        of_file[1:3] = 63 - x, 47 - y
    write_event_file(path / "events.h5", *of_file)
    (finding,) = of_events(inspect_capture(path, out).findings)
    typed = shlex.split(re.split("(?i)bring them there: ", str(finding))[1])
    assert typed[:2] == ["evsplat", "convert"]
    assert (str(found) in typed) == found.exists() == (wrong != "inverted")
    assert main(typed[1:]) == 0
    with h5py.File(path / "events.h5") as file:
        brought = {key: file[f"events/{key}"][:].astype(int) for key in "xyp"}
    assert np.array_equal(brought["p"], p)
    for key, column in {"x": x, "y": y}.items():
        assert abs(brought[key].mean() - column.mean()) < (0.7 if wrong == "shifted" else 1e-9)
    assert not of_events(inspect_capture(path, out).findings) and not found.exists()


@pytest.mark.usefixtures("undrawn")
def test_of_a_lens_that_bends_lines_no_homography_is_written(
    tiny_capture: Factory, tmp_path: Path
) -> None:
    """Events are stored as the lens bent them, and what was found is of them as they are read."""
    path = tiny_capture(frames=12, width=64, height=48)
    document = json.loads((path / "capture.json").read_text())
    bent = {"model": "opencv", "coefficients": [0.01, 0, 0, 0]}
    document["cameras"]["main"]["distortion"] = bent
    (path / "capture.json").write_text(json.dumps(document))
    with h5py.File(path / "events.h5") as file:
        t, x, y, p = (file[f"events/{key}"][:] for key in "txyp")
    kept = x + 6 < 64
    write_event_file(path / "events.h5", t[kept], x[kept] + 6, y[kept], p[kept])
    told = [str(finding) for finding in inspect_capture(path, tmp_path / "out").findings]
    assert any("else undistort the pictures" in one for one in told)
    assert not (tmp_path / "out" / "events_to_pictures.txt").exists()
