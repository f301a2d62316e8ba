"""`judge_body`, what `train` and `import` say by it, and its picture."""

import json
import logging
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from evsplat.body import BodyTrack
from evsplat.capture import Policy, TrainingCapture, load_body_track, load_capture
from evsplat.cli.main import main
from evsplat.events import EventStream
from evsplat.inspection import Belonging, check_body, fit_sheet, inspect_capture, judge_body

from ..conftest import write_event_file
from ..firewall.scrambled import Recorded, scrambled, write_recorded
from ..small_model import small

Factory = Callable[..., Path]
FRAMES = 20
METRES_PER_PX = 3 / (1.7 * 72)
"""In the tiny capture's picture of 96 x 72 pixels, three metres before the camera."""


@pytest.fixture
def path(tiny_capture: Factory) -> Path:
    return tiny_capture(frames=FRAMES, width=96, height=72)


def seen(path: Path) -> TrainingCapture:
    return load_capture(path).for_training(Policy())


def changed(path: Path, **arrays: np.ndarray) -> Path:
    """The capture with other arrays in body.npz."""
    with np.load(path / "body.npz") as archive:
        body = dict(archive)
    np.savez(path / "body.npz", **body | arrays)
    return path


def changed_capture(path: Path, **entries: object) -> Path:
    """The capture with other entries in capture.json."""
    document = json.loads((path / "capture.json").read_text())
    (path / "capture.json").write_text(json.dumps(document | entries))
    return path


def exposures(frames: list[dict]) -> list[tuple[int, int]]:
    return [tuple(frame["exposure_us"]) for frame in frames]


def stored(path: Path, name: str) -> np.ndarray:
    with np.load(path / "body.npz") as archive:
        return archive[name]


def late(path: Path, frames: int) -> Path:
    """Every key pose is that of so many frames before."""
    before = np.clip(np.arange(FRAMES) - frames, 0, FRAMES - 1)
    arrays = {name: stored(path, name)[before] for name in ("poses", "transl")}
    return changed(path, **arrays)


def strangers(path: Path) -> Path:
    """Poses and places that have nothing to do with the recording."""
    rng = np.random.default_rng(3)
    poses, transl = stored(path, "poses"), stored(path, "transl")
    poses[:, 2, 1] = rng.uniform(-1.5, 1.5, len(poses))
    transl[:, 0] = rng.uniform(-0.3, 0.3, len(poses))
    return changed(path, poses=poses, transl=transl)


def with_grey_pictures(path: Path) -> Path:
    for file in (path / "images").iterdir():
        with Image.open(file) as image:
            Image.new("RGB", image.size, (90, 90, 90)).save(file)
    return path


@pytest.mark.parametrize("left_out", ["nothing", "events", "pictures"])
def test_right_body_fits_where_it_is(path: Path, left_out: str) -> None:
    if left_out == "events":
        changed_capture(path, events=None)
    elif left_out == "pictures":
        with_grey_pictures(path)
    found = judge_body(seen(path))
    assert found.verdict == "belongs" and found.place == ""
    kinds = {"nothing": {"events", "frames"}, "events": {"frames"}, "pictures": {"events"}}
    assert set(found.shares) == kinds[left_out]
    assert all(share > 0.7 for share in found.shares.values()) and found.area < 0.25


@pytest.mark.parametrize("frames", [1, 2])
def test_a_handful_of_events_tells_of_no_other_place(
    path: Path, rng: np.random.Generator, frames: int
) -> None:
    """As slow motion sends about a frame or two, which show no background either."""
    document = json.loads((path / "capture.json").read_text())
    kept = document["frames"][4 : 4 + frames]
    changed_capture(path, frames=kept, novel_views=[])
    events = load_capture(path).events
    assert events is not None
    for draw in range(5):
        near = [events.between(start + 5_000, end - 5_000) for start, end in exposures(kept)]
        stream = EventStream.joined(near)
        some = stream.take(np.sort(rng.choice(len(stream), 25, replace=False)))
        entry = document["events"] | {"file": f"few_{draw}.h5"}
        write_event_file(path / entry["file"], some.t, some.x, some.y, some.p > 0)
        changed_capture(path, events=entry)
        found = judge_body(load_capture(path).for_training(Policy(use="everything")))
        assert found.verdict == "unknown" and "too little moves" in found.sentence


def test_misplaced_body_is_told_by_pixels_and_direction(path: Path) -> None:
    transl = stored(path, "transl") + np.float32([9 * METRES_PER_PX, 0, -6 * METRES_PER_PX])
    found = judge_body(seen(changed(path, transl=transl)))
    assert found.verdict == "off"
    assert np.allclose(found.shift_px, (-9, -6), atol=1.1) and abs(found.delay_frames) <= 0.5
    right, below = (round(abs(px)) for px in found.shift_px)
    assert found.place == f"{right} px right of and {below} px below"
    assert f"the posed body is {found.place} what moves" in found.sentence


@pytest.mark.parametrize("after_us", [1_000, 20_000])
@pytest.mark.parametrize("frames", [2, -2])
def test_delay_is_told_in_frames_of_the_camera_however_others_are_timed(
    path: Path, frames: int, after_us: int
) -> None:
    document = json.loads((late(path, frames) / "capture.json").read_text())
    document["cameras"]["other"] = document["cameras"]["main"]
    others = [
        {
            "name": f"other_{frame['name']}",
            "camera": "other",
            "image": frame["image"],
            "split": frame["split"],
            "exposure_us": [time_us + after_us for time_us in frame["exposure_us"]],
        }
        for frame in document["frames"]
    ]
    changed_capture(
        path, events=None, cameras=document["cameras"], frames=document["frames"] + others
    )
    found = judge_body(seen(path))
    assert found.verdict == "off" and found.delay_frames == pytest.approx(frames, abs=0.5)
    assert found.delay_us == 40_000 * found.delay_frames


@pytest.mark.parametrize(("frames", "side"), [(2, "behind"), (-2, "ahead of")])
def test_late_body_is_told_by_frames(path: Path, frames: int, side: str) -> None:
    found = judge_body(seen(late(path, frames)))
    assert found.verdict == "off" and found.delay_frames == pytest.approx(frames, abs=0.5)
    assert found.place.endswith(side) and found.delay_us == 40_000 * found.delay_frames
    # The figures are those by which it is told, and differ as printed.
    here, there = map(float, re.findall(r"-?\d\.\d\d", found.sentence.rpartition("(")[2]))
    assert found.change_lost is not None and found.change_score is not None
    assert there - here == pytest.approx(found.change_lost * found.change_score, abs=0.01)
    assert there > 1.1 * here


def test_anothers_body_follows_nothing(path: Path) -> None:
    found = judge_body(seen(strangers(path)))
    assert found.verdict == "another" and found.order is not None and found.order < 0.75


def test_body_out_of_view_is_told(path: Path) -> None:
    transl = stored(path, "transl") + np.float32([30, 0, 0])
    found = judge_body(seen(changed(path, transl=transl)))
    assert found.verdict == "another" and found.area == 0 and found.in_no_held_out_frame
    assert "in none of the" in found.sentence


def test_recording_in_which_nothing_happens_is_told(path: Path) -> None:
    changed_capture(with_grey_pictures(path), events=None)
    found = judge_body(seen(path))
    assert found.verdict == "unknown" and "too little moves" in found.sentence


def test_judgement_knows_nothing_of_what_is_held_out(tmp_path: Path) -> None:
    recorded = Recorded(frozenset({4, 7, 8, 12}), 0, True, True, 0)
    path = write_recorded(tmp_path / "tiny", recorded)
    noise = scrambled(path, tmp_path / "noise" / "tiny", 1, has_polarity=True, masks=False)
    assert facts(judge_body(seen(path))) == facts(judge_body(seen(noise)))


def facts(found: Belonging) -> dict[str, object]:
    return {name: value for name, value in vars(found).items() if name != "frames"}


def test_training_refuses_anothers_body_in_one_sentence_unless_told_otherwise(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    strangers(path)
    run = tmp_path / "run"
    train = ["train", str(path), "--out", str(run), "--iterations", "1", "--no-evaluate"]
    train += ["--set", *small("evsplat")]
    assert main(train) == 2
    said = capsys.readouterr().err
    assert f"{path}/body.npz: the posed body follows nothing" in said and "--any-body" in said
    assert not run.exists()
    with caplog.at_level(logging.WARNING):
        assert main([*train, "--any-body"]) == 0
    assert (run / "body_fit.png").exists()


def test_check_warns_of_a_late_body_and_says_nothing_of_a_right_one(
    path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, logger="evsplat.inspection"):
        check_body(seen(path), refuse=True)
        assert caplog.messages == []
        check_body(seen(late(path, 2)), refuse=True)
    assert len(caplog.messages) == 1 and "2 frames behind what moves" in caplog.messages[0]


def test_inspect_says_it_with_a_warning_and_a_picture(path: Path, tmp_path: Path) -> None:
    report = inspect_capture(late(path, 3), tmp_path / "out")
    assert "belongs    the posed body is 3 frames behind what moves" in report.summary
    assert [finding.file.name for finding in report.findings] == ["body.npz"]
    assert (tmp_path / "out" / "body_fit.png").exists()


def test_best_place_is_drawn_beside_the_given_one(path: Path) -> None:
    transl = stored(path, "transl") + np.float32([10 * METRES_PER_PX, 0, 0])
    capture = seen(changed(path, transl=transl))
    found = judge_body(capture)
    picture = np.asarray(fit_sheet(capture, found))
    columns = [
        np.flatnonzero((picture == colour).all(-1).any(0))
        for colour in ((60, 255, 120), (255, 225, 80))
    ]
    # ten pixels of 96 in a tile of 380
    shift = 10 * 380 / 96
    assert columns[0].min() - columns[1].min() == pytest.approx(shift, abs=380 / 96 + 2)


def test_track_of_the_caller_is_judged_in_place_of_the_captures_own(path: Path) -> None:
    track = load_body_track(load_capture(path))
    behind = BodyTrack(track.body, track.times_us + 80_000, track.poses, track.transl)
    assert judge_body(seen(path), behind).delay_frames == pytest.approx(2, abs=0.5)


def test_nobody_in_any_picture_is_refused_whosever_body_is_wanted(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changed(path, transl=stored(path, "transl") + np.float32([30, 0, 0]))
    train = ["train", str(path), "--out", str(tmp_path / "run"), "--iterations", "1"]
    assert main([*train, "--any-body"]) == 2
    assert "the posed body is in none of the" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
