"""Every importer on a small tree of its layout: the body falls on the person in the picture."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_dilation

from evsplat.body import BodyTrack, silhouette, up_axis
from evsplat.body.smpl import ENVIRONMENT
from evsplat.capture import Capture, load_body_track, load_capture, validate_capture
from evsplat.errors import DataError
from evsplat.importers import import_capture
from evsplat.importers.base import shrunk
from evsplat.pictures.files import read_image

from . import trees
from .person import Person, View, write_smpl
from .trees import BLUR_STEP


@pytest.fixture
def models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with SMPL of every gender; the environment leads nowhere."""
    monkeypatch.delenv(ENVIRONMENT, raising=False)
    for gender in ("neutral", "male", "female"):
        write_smpl(tmp_path / gender, gender)
        target = tmp_path / "models" / "smpl"
        target.mkdir(parents=True, exist_ok=True)
        file = f"SMPL_{gender.upper()}.npz"
        (tmp_path / gender / "smpl" / file).rename(target / file)
    return tmp_path / "models"


def run(kind: str, source: Path, out: Path, **options) -> Capture:
    """Import, and find nothing wrong with the capture (that it has no events is no fault)."""
    import_capture(kind, source, out, **options)
    findings = [f for f in validate_capture(out) if f.field != "events"]
    assert [f for f in findings if f.severity == "error"] == []
    capture = load_capture(out)
    for frame in capture.frames:  # sharp pictures are their own truth, blurry ones have none
        assert (frame.sharp is None) == (kind == "zju-mocap-blur")
        if frame.sharp is not None:
            assert torch.equal(capture.sharp(frame), capture.image(frame))
    one_camera = kind in ("neuman", "people-snapshot")
    assert capture.body_file.source == ("estimated" if one_camera else "markers")
    return capture


def track_of(capture: Capture, models: Path | None) -> BodyTrack:
    """The body's motion, with the user's models where there are any."""
    with pytest.MonkeyPatch.context() as patch:
        if models is not None:
            patch.setenv(ENVIRONMENT, str(models))
        return load_body_track(capture)


def misses(
    capture: Capture, person: Person, views: list[View], rows: list[int], models: Path, shrink: int
) -> np.ndarray:
    """Pixels between each vertex of the capture's body and of the person, (frames, V)."""
    track = track_of(capture, models)
    found = []
    for frame, row in zip(capture.frames, rows, strict=True):
        vertices = track.vertices(frame.mid_us)
        pixels, depth = capture.camera(frame).project(vertices)
        assert (depth > 0).all()
        expected = views[row].pixels(person.vertices(row), distorted=False)
        expected = (expected + 0.5) / shrink
        found.append(np.linalg.norm(pixels.numpy() - expected, axis=1))
    return np.array(found)


def beyond_a_pixel(capture: Capture, models: Path | None) -> float:
    """Share of the person's pixels that lie more than one from the body, or the other way round."""
    track = track_of(capture, models)
    worst = 0.0
    for frame in capture.frames:
        stored = capture.mask(frame)
        assert stored is not None
        person = stored.numpy() > 0.5
        camera = capture.camera(frame)
        body = silhouette(track.vertices(frame.mid_us), track.body.faces, camera).numpy()
        for one, other in ((person, body), (body, person)):
            alone = one & ~binary_dilation(other, np.ones((3, 3)))
            worst = max(worst, alone.sum() / person.sum())
    return worst


ROWS = list(range(trees.FRAMES))


@pytest.mark.parametrize("layout", ["raw", "arah"])
@pytest.mark.parametrize("shrink", [1, 2])
def test_zju_mocap(tmp_path: Path, models: Path, layout: str, shrink: int) -> None:
    write = trees.write_zju_raw if layout == "raw" else trees.write_zju_arah
    source = write(tmp_path / "CoreView_377")
    capture = run(
        "zju-mocap", source, tmp_path / "out", smpl=models, shrink=shrink, novel_cameras=("2", "7")
    )
    person, views = trees.zju_person(), trees.zju_views()
    assert [frame.name for frame in capture.frames] == [f"{i:06d}" for i in ROWS]
    assert [frame.mid_us for frame in capture.frames] == [20_000 * i for i in ROWS]
    assert misses(capture, person, [views["1"]] * 6, ROWS, models, shrink).max() < 0.01
    # the pictures, undistorted by the capture, and the body agree all along the outline
    assert beyond_a_pixel(capture, models) < 0.005
    assert {(v.camera, v.frame) for v in capture.novel_views} == {
        (camera, frame.name) for camera in "27" for frame in capture.frames
    }
    track = track_of(capture, models)
    for view in capture.novel_views[::5]:
        pixels, _ = capture.cameras[view.camera].project(track.vertices(view.time_us))
        row = int(view.frame)
        expected = views[view.camera].pixels(person.vertices(row), distorted=False)
        assert np.abs(pixels.numpy() - (expected + 0.5) / shrink).max() < 0.01
    assert np.allclose(capture.body_file.betas, person.betas)
    stored = read_image(source / ("Camera_B1" if layout == "raw" else "1") / "000002.jpg")
    assert np.array_equal(read_image(capture.frames[2].image), shrunk(stored, shrink))


@pytest.mark.parametrize("astray", [False, True])
def test_the_body_is_compared_by_the_model_that_the_import_was_given(
    tmp_path: Path, models: Path, caplog: pytest.LogCaptureFixture, astray: bool
) -> None:
    """No environment variable leads to it, which training alone needs."""
    source = trees.write_zju_arah(tmp_path / "CoreView_392")
    for path in (source / "models").iterdir() if astray else ():
        arrays = dict(np.load(path))
        arrays["trans"] = arrays["trans"] + 50  # metres, out of every picture
        np.savez(path, **arrays)
    with caplog.at_level("INFO", "evsplat"):
        run("zju-mocap", source, tmp_path / "out", smpl=models)
    assert "No folder for body models" not in caplog.text
    assert ("the posed body is in none of the" in caplog.text) == astray


def test_a_model_of_another_gender_is_said_to_be_missing(
    tmp_path: Path, models: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    trees.write_mmhpsd_a(tmp_path / "data")
    folder = write_smpl(tmp_path / "own", "female")
    monkeypatch.setenv(ENVIRONMENT, str(folder))
    with caplog.at_level("INFO", "evsplat"):
        capture = run("mmhpsd", tmp_path / "data", tmp_path / "out", action=trees.ACTION)
    assert capture.body_file.model == "default"
    assert f"no SMPL file (male) in {folder}" in caplog.text


@pytest.mark.parametrize("posed_with_shift", [True, False])
def test_zju_mocap_without_a_body_model(
    tmp_path: Path, models: Path, posed_with_shift: bool
) -> None:
    """The free body at the subject's own size, from ARAH's posed joints in either reading."""
    source = trees.write_zju_arah(tmp_path / "377", posed_with_shift=posed_with_shift)
    capture = run("zju-mocap", source, tmp_path / "out", shrink=1)
    assert capture.body_file.model == "default"
    person, view = trees.zju_person(), trees.zju_views()["1"]
    track = load_body_track(capture)
    names = {"left_knee": 4, "right_ankle": 8, "left_elbow": 18, "right_wrist": 21, "neck": 12}
    ours = ("LeftLeg", "RightFoot", "LeftForeArm", "RightHand", "Neck")
    errors = []
    for row, frame in enumerate(capture.frames):
        rotations, transl = track.at([frame.mid_us])
        joints = track.body.joint_transforms(rotations, transl)[0, :, :3, 3]
        chosen = joints[[track.body.joint_names.index(name) for name in ours]]
        pixels, _ = capture.camera(frame).project(chosen)
        expected = view.pixels(person.joints(row)[list(names.values())], distorted=False) + 0.5
        errors.append(np.linalg.norm(pixels.numpy() - expected, axis=1))
    # a pixel is 2.2 cm at the person
    assert np.mean(errors) < 2.6 and np.max(errors) < 5.5


@pytest.mark.parametrize("lost", [1, trees.FRAMES])
def test_masks_that_a_data_set_lacks_are_counted(
    tmp_path: Path, models: Path, caplog: pytest.LogCaptureFixture, lost: int
) -> None:
    source = trees.write_neuman(tmp_path / "lab")
    masks = sorted((source / "segmentations").iterdir())
    for path in masks[trees.FRAMES - lost :]:
        path.unlink()
    with caplog.at_level("INFO", "evsplat"):
        capture = run("neuman", source, tmp_path / "out", smpl=models)
    assert f"masks: {lost} of {trees.FRAMES} pictures have none" in caplog.text
    assert "out --with silhouette" in caplog.text  # no static background to compare with
    assert sum(frame.mask is None for frame in capture.frames) == lost


def test_frames_are_chosen_by_number_and_by_subject(tmp_path: Path, models: Path) -> None:
    source = trees.write_zju_arah(tmp_path / "CoreView_392")
    capture = run("zju-mocap", source, tmp_path / "out", smpl=models, frames=(2, 5))
    assert [frame.name for frame in capture.frames] == ["000002", "000003", "000004"]
    views = [trees.zju_views()["1"]] * 6
    assert misses(capture, trees.zju_person(), views, [2, 3, 4], models, 2).max() < 0.01
    assert capture.provenance["frames"] == [2, 5]


@pytest.mark.parametrize(
    ("kind", "written", "frames"),
    [
        ("mmhpsd", lambda root: trees.write_mmhpsd_raw(root, signed=True), (2, 5)),
        ("neuman", trees.write_neuman, (2, 5)),
        ("zju-mocap-blur", lambda root: trees.write_zju_blur(root, unit=1.0), (6, 19)),
    ],
)
def test_the_provenance_says_which_frames_were_taken(
    tmp_path: Path, kind: str, written, frames: tuple[int, int]
) -> None:
    source = tmp_path / "377"
    written(source)
    source = source / trees.ACTION if kind == "mmhpsd" else source
    capture = run(kind, source, tmp_path / "out", frames=frames)
    assert capture.provenance["frames"] == list(frames)


@pytest.mark.parametrize("shrink", [1, 4])
def test_mmhpsd_raw_with_signed_events(tmp_path: Path, models: Path, shrink: int) -> None:
    files = trees.write_mmhpsd_raw(tmp_path / "data", signed=True)
    source = tmp_path / "data" / trees.ACTION
    capture = run("mmhpsd", source, tmp_path / "out", smpl=models, shrink=shrink)
    rows = list(range(1, trees.FRAMES))  # the first picture has no pose
    assert [frame.name for frame in capture.frames] == [f"{i:04d}" for i in rows]
    view = trees.mmhpsd_view(800, 1280)
    assert misses(capture, trees.mmhpsd_person(), [view] * 6, rows, models, shrink).max() < 0.02
    assert capture.body_file.gender == "male"
    assert capture.events is not None and not capture.events_simulated
    assert capture.contrast_threshold is None
    first, period = capture.frames[0].mid_us, 1e6 / 15
    assert abs(first - period) < 1
    for number in rows[:-1]:
        events = capture.events.between(round(number * period), round((number + 1) * period))
        given = files[number]
        # turned by half a turn, as the pictures are
        x, y = (799 - given[:, 1]) // shrink, (1279 - given[:, 0]) // shrink
        assert len(events) == len(given)
        assert sorted(zip(events.x, events.y, events.p, strict=True)) == sorted(
            zip(x, y, 2 * given[:, 4] - 1, strict=True)
        )
        share = (events.t - number * period) / period
        inside = (given[:, 2] - given[0, 2]) / (given[-1, 2] - given[0, 2])
        assert np.abs(share - 0.8 * inside).max() < 1e-4


def test_mmhpsd_events_without_polarity_are_left_out(
    tmp_path: Path, models: Path, caplog: pytest.LogCaptureFixture
) -> None:
    trees.write_mmhpsd_raw(tmp_path / "data", signed=False)
    with caplog.at_level("INFO", "evsplat"):
        capture = run("mmhpsd", tmp_path / "data" / trees.ACTION, tmp_path / "out", smpl=models)
    assert capture.events is None
    assert "without polarity" in capture.provenance["events"]
    assert "without polarity" in caplog.text and "1 picture without a pose" in caplog.text


def test_a_cut_file_of_mmhpsd_is_read_on_where_that_is_asked_for(
    tmp_path: Path, models: Path
) -> None:
    files = trees.write_mmhpsd_raw(tmp_path / "data", signed=True)
    source = tmp_path / "data" / trees.ACTION
    path = source / "event_camera" / "events" / "event0002.csv"
    path.write_text(path.read_text().rstrip("\n").rpartition(",")[0])
    with pytest.raises(DataError, match=r"event0002.csv: .*\(--repair\) leaves out a last line"):
        import_capture("mmhpsd", source, tmp_path / "out", smpl=models)
    capture = run("mmhpsd", source, tmp_path / "out", smpl=models, repair=True)
    kept = [files[number] for number in range(1, trees.FRAMES - 1)]
    assert len(capture.events) == sum(map(len, kept)) - 1
    assert "1 file repaired" in capture.provenance["events"]


def test_mmhpsd_release_a(tmp_path: Path, models: Path) -> None:
    trees.write_mmhpsd_a(tmp_path / "data")
    capture = run("mmhpsd", tmp_path / "data", tmp_path / "out", smpl=models, action=trees.ACTION)
    rows = list(range(1, trees.FRAMES))
    view = trees.mmhpsd_view(256, 256)
    assert misses(capture, trees.mmhpsd_person(), [view] * 6, rows, models, 1).max() < 0.01
    assert capture.events is None and "without polarity" in capture.provenance["events"]
    image = capture.image("0003")
    assert torch.equal(image[..., 0], image[..., 1])


@pytest.mark.parametrize("matrices", [True, False])
def test_mmhpsd_release_b(tmp_path: Path, models: Path, matrices: bool) -> None:
    files = trees.write_mmhpsd_b(tmp_path / "data", matrices=matrices)
    capture = run("mmhpsd", tmp_path / "data", tmp_path / "out", smpl=models, action=trees.ACTION)
    view = trees.mmhpsd_view(256, 256)
    assert misses(capture, trees.mmhpsd_person(), [view] * 6, ROWS, models, 1).max() < 0.01
    assert capture.events is not None and len(capture.events) == 200 * trees.FRAMES
    events = capture.events.between(200_000, 266_000)
    assert np.array_equal(np.stack([events.x, events.y], 1), files[3]["xy"])
    assert np.array_equal(events.p, 2 * files[3]["p"] - 1)


@pytest.mark.parametrize("uneven", [False, True])
def test_neuman(tmp_path: Path, models: Path, uneven: bool) -> None:
    """Also where the alignment scales the person differently in every frame."""
    scales = trees.NEUMAN_SCALE * np.linspace(0.9, 1.1, trees.FRAMES) if uneven else None
    source = trees.write_neuman(tmp_path / "lab", scales=scales)
    capture = run("neuman", source, tmp_path / "out", smpl=models)
    assert not capture.is_static_camera
    views = [View(v.size, v.K, v.world_to_camera) for v in trees.neuman_views()]
    assert misses(capture, trees.neuman_person(), views, ROWS, models, 1).max() < 0.02
    assert beyond_a_pixel(capture, models) < 0.005
    points = capture.initial_points()
    assert points is not None
    turn = np.array(capture.provenance["world_from_colmap"])
    assert np.allclose(points[0], [[1, 0, -2], [0, 1 / 0.37, 2 / 0.37]] @ turn.T, atol=1e-5)
    # COLMAP's world is askew, the capture's stands upright: all pictures' rows are level.
    up = up_axis(track_of(capture, models))
    rows = torch.stack([capture.camera(frame).world_to_camera[0, :3] for frame in capture.frames])
    assert (rows @ up).abs().max() < 0.02
    assert np.allclose(points[1][0], [1, 0, 0.2], atol=0.01)


@pytest.mark.parametrize("shrink", [1, 2])
def test_people_snapshot(tmp_path: Path, models: Path, shrink: int) -> None:
    source = trees.write_people_snapshot(tmp_path / "female-1-casual")
    capture = run("people-snapshot", source, tmp_path / "out", smpl=models, shrink=shrink)
    rows = list(range(trees.SNAPSHOT_FRAMES))
    person, view = trees.snapshot_person(), trees.snapshot_view()
    assert misses(capture, person, [view] * 4, rows, models, shrink).max() < 0.01
    assert capture.body_file.gender == "female"
    assert [frame.mid_us for frame in capture.frames] == [0, 40_000, 80_000, 120_000]
    assert beyond_a_pixel(capture, models) < 0.005
    drawn = view.draw(person, 2)[0]
    assert np.array_equal(read_image(capture.frames[2].image), shrunk(drawn, shrink))


@pytest.mark.parametrize("unit", [1.0, 1e3, 1e6])
def test_zju_mocap_blur_of_exfman(tmp_path: Path, models: Path, unit: float) -> None:
    given = trees.write_zju_blur(tmp_path / "377", unit=unit)
    capture = run("zju-mocap-blur", tmp_path / "377", tmp_path / "out", smpl=models)
    views = [trees.blur_view()] * 6
    # the data set has no betas: they are found again from the joints at rest
    assert misses(capture, trees.zju_person(), views, ROWS, models, 1).max() < 0.3
    assert capture.is_static_camera and capture.events_simulated
    assert beyond_a_pixel(capture, models) < 0.005
    for row, frame in enumerate(capture.frames):
        assert frame.mid_us == 10_000 + 20_000 * row
        start, end = frame.exposure_us
        assert abs(end - start - 20_000 * (BLUR_STEP - 1) / BLUR_STEP) <= 1
    assert capture.events is not None
    events = capture.events._open()
    order = np.argsort(given["tE"], kind="stable")
    for column, key in (("x", "xE"), ("y", "yE")):
        assert np.array_equal(events[f"events/{column}"][:], given[key][order])
    assert np.array_equal(events["events/p"][:], given["pE"][order] > 0)
    assert np.abs(events["events/t"][:] - given["tE"][order] / unit * 1e6).max() <= 0.5


def test_a_part_of_zju_mocap_blur_has_the_events_of_its_time(tmp_path: Path, models: Path) -> None:
    given = trees.write_zju_blur(tmp_path / "377", unit=1.0)
    whole = run("zju-mocap-blur", tmp_path / "377", tmp_path / "out", smpl=models)
    numbers = BLUR_STEP * 2 - 1, BLUR_STEP * 4 + 1
    part = run("zju-mocap-blur", tmp_path / "377", tmp_path / "part", smpl=models, frames=numbers)
    names = [f"frame_{BLUR_STEP * index:06d}" for index in (2, 3, 4)]
    assert [frame.name for frame in part.frames] == names
    assert [f.exposure_us for f in part.frames] == [whole.frame(n).exposure_us for n in names]
    start, end = part.frames[0].exposure_us[0], part.frames[-1].exposure_us[1]
    times_us = np.sort(np.rint(given["tE"] * 1e6))
    expected = times_us[(times_us >= start) & (times_us < end)]
    events = part.events._open()
    assert np.array_equal(events["events/t"][:] + events["t_offset"][()], expected)
    assert part.events_simulated and len(part.body_file.times_us) == 3


def test_zju_mocap_blur_without_a_body_model(tmp_path: Path, models: Path) -> None:
    trees.write_zju_blur(tmp_path / "377", unit=1.0)
    capture = run("zju-mocap-blur", tmp_path / "377", tmp_path / "out")
    assert capture.body_file.model == "default"
    assert beyond_a_pixel(capture, None) < 0.5
