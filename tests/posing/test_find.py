"""`find_poses` on a tiny capture with key points of a file, and what it refuses."""

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tests.posing.moving import CAMERA, landmarks

from evsplat.capture import Policy, load_body_track, load_capture, validate_capture
from evsplat.capture.distortion import Distortion
from evsplat.errors import ConfigError, DataError
from evsplat.options import PoseSearch
from evsplat.posing import find, find_poses
from evsplat.posing.refine import refine

FRAMES = 10


@pytest.fixture(scope="module")
def fits():
    """What was fitted, by what it was fitted to: most tests ask what becomes of the same fit."""
    return {}


@pytest.fixture
def unposed(tiny_capture, tmp_path, monkeypatch, fits):
    """A capture with ``"body": null`` whose camera films the motion of `moving`, and its points."""
    path = tiny_capture(frames=FRAMES)
    document = json.loads((path / "capture.json").read_text())
    document["body"] = None
    camera = document["cameras"]["main"]
    camera["K"] = [[37.5, 0, 16], [0, 37.5, 16], [0, 0, 1]]
    camera["world_to_camera"] = CAMERA.world_to_camera.tolist()
    (path / "capture.json").write_text(json.dumps(document))
    (path / "body.npz").unlink()
    points = tmp_path / "points.npy"
    marks = landmarks(FRAMES)
    np.save(points, np.concatenate((marks.places / 8, marks.seen[..., None]), -1))
    fit = find._fit

    def fitted_once(seen, found, rig, search):
        views = [part for v in map(seen.camera, seen.frames) for part in (v.K, v.world_to_camera)]
        values = (found.places, found.sigma_px, found.seen, *(part.numpy() for part in views))
        key = (search.height_m, *(value.tobytes() for value in values))
        if key not in fits:
            fits[key] = fit(seen, found, rig, search)
        return fits[key]

    monkeypatch.setattr(find, "_fit", fitted_once)
    return path, points


def test_a_capture_without_poses_gets_some(unposed, tmp_path):
    path, points = unposed
    before = (path / "capture.json").read_bytes()
    found = find_poses(path, tmp_path / "new", keypoints=points, height_m=1.8, refine_s=0)
    new = load_capture(tmp_path / "new")
    track = load_body_track(new)
    mids = [frame.mid_us for frame in new.frames]
    assert set(mids) <= set(track.times_us.tolist())
    assert len(track.times_us) >= 4 * len(mids) - 3
    assert track.errors is not None
    assert track.errors.source == "estimated"
    assert (track.errors.joint_rad.max(1) > 0).all()
    assert f"{len(track.times_us)} key poses from {len(new.train_frames)} frames; " in found.summary
    assert len(repr(found)) < 1000 and "array" not in repr(found)
    for own, stored in zip(found.track.at(mids), track.at(mids), strict=True):
        np.testing.assert_allclose(own, stored, atol=1e-4)
    made = new.provenance["poses"]
    assert made["pictures"] == len(new.train_frames)
    assert "(key points of a file) from training frames alone." in new.poses_found
    assert load_capture(path).poses_found is None
    page = (tmp_path / "new" / "poses.html").read_text()
    assert "http" not in page.replace("http-equiv", "")
    assert "In doubt" in page
    assert (path / "capture.json").read_bytes() == before


@pytest.mark.parametrize(("entered", "left"), [(0, 10), (3, 10), (0, 6), (2, 7)])
def test_frames_without_the_person_at_either_end_are_left_out(
    unposed, tmp_path, monkeypatch, caplog, entered, left
):
    path, points = unposed
    frames = load_capture(path, needs_body=False).frames
    found = find._landmarks

    def of_somebody(capture, pictures, keypoints):
        points = found(capture, pictures, keypoints)
        times = points.times_us
        return points.of_pictures(
            (times >= frames[entered].mid_us) & (times <= frames[left - 1].mid_us)
        )

    monkeypatch.setattr(find, "_landmarks", of_somebody)
    out = tmp_path / "new"
    find_poses(path, out, keypoints=points, height_m=1.8, refine_s=0)
    new = load_capture(out)
    # Of held-out frames nothing is known where no training frame after them is empty.
    known = any(frame.split == "train" for frame in frames[left:])
    kept = frames[entered : left if known else None]
    assert [(frame.name, frame.split) for frame in new.frames] == [
        (frame.name, frame.split) for frame in kept
    ]
    times = load_body_track(new).times_us
    assert times[0] == kept[0].exposure_us[0] and times[-1] == kept[-1].exposure_us[1]
    assert not [finding for finding in validate_capture(out) if finding.severity == "error"]
    pictures = {file.name for file in (out / "images").iterdir()}
    assert pictures == {frame.image.name for frame in new.frames}
    after = len(frames) - entered - len(kept)
    assert (f"{entered} frames before the person enters (0000 to " in caplog.text) == (entered > 0)
    assert (f"{after} frames after they have left (" in caplog.text) == (after > 0)


def test_pictures_and_key_points_of_held_out_frames_change_nothing(unposed, tmp_path, fits):
    path, points = unposed
    first = find_poses(path, tmp_path / "first", keypoints=points, refine_s=0)
    values = np.load(points)
    values[7:, :, :2] += 20
    np.save(points, values)
    frames = load_capture(path).frames
    for frame in frames[7:]:
        frame.image.write_bytes(frames[0].image.read_bytes())
    fits.clear()
    second = find_poses(path, tmp_path / "second", keypoints=points, refine_s=0)
    np.testing.assert_array_equal(first.track.poses, second.track.poses)


def test_a_given_focal_length_is_written_and_refined_with(unposed, tmp_path, monkeypatch):
    path, points = unposed
    seen = []
    monkeypatch.setattr(find, "refine", lambda *a, **k: seen.append(a[1]) or refine(*a, **k))
    find_poses(path, tmp_path / "new", keypoints=points, focal="45", refine_s=0.2)
    assert seen[0].camera(seen[0].frames[0]).K[0, 0] == 45
    new = load_capture(tmp_path / "new")
    assert new.provenance["poses"]["refinement"]["seconds"] > 0
    assert new.camera(new.frames[0]).K[0, 0] == 45
    assert load_capture(path).camera(new.frames[0]).K[0, 0] == 37.5


@pytest.mark.parametrize("better", [True, False])
def test_a_corrected_body_is_written_as_the_pictures_show_it(
    unposed, tmp_path, monkeypatch, better
):
    path, points = unposed
    refined = []

    def judged(*given, **options):
        found = refine(*given, **options)
        gain = (1.0, 0.0) if better else (0.0, 1.0)
        refined.append(replace(found, gain=gain[0], gain_error=gain[1]))
        return refined[0]

    monkeypatch.setattr(find, "refine", judged)
    found = find_poses(path, tmp_path / "new", keypoints=points, refine_s=0.2)
    new = load_capture(tmp_path / "new")
    track = load_body_track(new)
    assert new.body_file.model == ("rig" if better else "default")
    body = refined[0].dressed if better else found.fitted.rig.body(found.fitted.betas)
    torch.testing.assert_close(track.body.rest_vertices, body.rest_vertices)
    assert track.body.joint_names == body.joint_names
    assert [one for one in validate_capture(tmp_path / "new") if one.severity == "error"] == []


def test_a_focal_length_that_was_searched_for_is_said_to_be_rough(unposed, tmp_path, caplog):
    path, points = unposed
    find_poses(path, tmp_path / "new", keypoints=points, focal="auto", refine_s=0)
    new = load_capture(tmp_path / "new")
    made = new.provenance["poses"]
    assert made["focal_px"] == pytest.approx(float(new.camera(new.frames[0]).K[0, 0]), abs=0.01)
    assert 0 < made["focal_std_share"] < 0.5
    said = (
        f"focal length: {made['focal_px']:.0f} pixels .* {made['focal_std_share']:.0%}.*--focal PX"
    )
    assert re.search(said, caplog.text)


def test_poses_that_were_there_are_ignored_and_stay(tiny_capture, unposed, tmp_path):
    path, points = unposed
    posed = tiny_capture("posed", frames=FRAMES)
    document = json.loads((path / "capture.json").read_text())
    document["body"] = {"file": "body.npz", "model": "rig"}
    (posed / "capture.json").write_text(json.dumps(document))
    before = (posed / "body.npz").read_bytes()
    find_poses(posed, tmp_path / "new", keypoints=points, refine_s=0)
    assert (posed / "body.npz").read_bytes() == before
    assert load_capture(tmp_path / "new").body_file.model == "default"


def test_ctrl_c_leaves_nothing(unposed, tmp_path, monkeypatch):
    path, points = unposed

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    for name in ("refine", "poses_page"):
        monkeypatch.setattr(find, name, interrupted)
        with pytest.raises(KeyboardInterrupt):
            find_poses(path, tmp_path / "new", keypoints=points, refine_s=int(name == "refine"))
    assert [file.name for file in tmp_path.iterdir() if "new" in file.name] == []


def test_what_cannot_be_is_refused_before_work_begins(unposed, tmp_path):
    path, points = unposed
    with pytest.raises(DataError, match="already exists"):
        find_poses(path, path, keypoints=points)
    with pytest.raises(ConfigError, match="--focal wide: expected auto or pixels"):
        PoseSearch(focal="wide")
    with pytest.raises(ConfigError, match="--refine -1"):
        PoseSearch(refine_s=-1)
    with pytest.raises(ConfigError, match="--height 17"):
        PoseSearch(height_m=17)


def test_training_on_a_capture_without_poses_offers_to_find_them(unposed):
    path, _ = unposed
    with pytest.raises(DataError, match=f"evsplat poses {path} --out NEW"):
        load_body_track(load_capture(path))


def test_a_moving_camera_is_not_refined_and_refused_where_it_was_asked_for(unposed, tmp_path):
    path, points = unposed
    document = json.loads((path / "capture.json").read_text())
    for number, frame in enumerate(document["frames"]):
        pose = CAMERA.world_to_camera.tolist()
        pose[0][3] += 1e-4 * number
        frame["world_to_camera"] = pose
    (path / "capture.json").write_text(json.dumps(document))
    with pytest.raises(ConfigError, match="--refine 5: .* moving camera"):
        find_poses(path, tmp_path / "new", keypoints=points, refine_s=5)
    find_poses(path, tmp_path / "new", keypoints=points)
    assert "refinement" not in load_capture(tmp_path / "new").provenance["poses"]


@pytest.mark.parametrize("from_a_file", [False, True])
def test_frames_without_anybody_are_left_out_and_named(tiny_capture, caplog, from_a_file):
    """Pictures of training frames are looked at (0 to 6 and 10 to 16 of 20); seven of them tell.

    A held-out frame beside empty ones goes with them, one between others stays.
    """
    capture = load_capture(tiny_capture(frames=20))
    pictures = [
        SimpleNamespace(frame=frame, time_us=frame.mid_us) for frame in capture.train_frames
    ]
    told = {2, 3, 4, 6, 10, 15, 16}
    landmarks = SimpleNamespace(times_us=np.array([capture.frames[k].mid_us for k in told]))
    shown = find._with_somebody(capture, pictures, landmarks, nobody_in_between=not from_a_file)
    names = [int(frame.name) for frame in shown.frames]
    between = [] if not from_a_file else [5, 11, 12, 13, 14]
    assert names == sorted([*told, *between, 7, 8, 9, 17, 18, 19])
    (said,) = caplog.messages
    assert "2 frames before the person enters (0000 to 0001)" in said
    for words in ("1 frame while they are away (0005)", "while they are away (0011 to 0014)"):
        assert (words in said) != from_a_file
    everybody = SimpleNamespace(times_us=np.array([picture.time_us for picture in pictures]))
    whole = find._with_somebody(capture, pictures, everybody, nobody_in_between=True)
    assert whole is capture


@pytest.mark.parametrize(("entered", "left"), [(0, 7), (2, 7), (0, 5)])
def test_of_key_points_frames_without_anybody_are_left_out_at_the_ends_alone(
    unposed, tmp_path, caplog, entered, left
):
    """Of 7 training frames, after which come held-out ones, of which a file tells nothing."""
    path, points = unposed
    values = np.load(points)
    for nobody in (slice(entered), slice(left, 7), entered + 1):
        values[nobody] = np.nan
    np.save(points, values)
    out = tmp_path / "new"
    find_poses(path, out, keypoints=points, height_m=1.8, refine_s=0, held_out_events=True)
    frames = load_capture(path, needs_body=False).frames
    kept = frames[entered : left if left < 7 else None]
    assert [frame.name for frame in load_capture(out).frames] == [frame.name for frame in kept]
    assert ("before the person enters" in caplog.text) == (entered > 0)
    assert ("after they have left" in caplog.text) == (left < 7)


def test_key_points_of_cameras_with_one_trigger_are_each_seen_through_their_own(unposed, tmp_path):
    path, points = unposed
    document = json.loads((path / "capture.json").read_text())
    side = json.loads(json.dumps(document["cameras"]["main"]))
    side["world_to_camera"][0][3] += 0.5
    document["cameras"]["side"] = side
    document["events"] = None
    document["novel_views"] = []
    document["frames"] += [
        {**frame, "name": f"s{frame['name']}", "camera": "side"} for frame in document["frames"]
    ]
    (path / "capture.json").write_text(json.dumps(document))
    capture = load_capture(path, needs_body=False)
    seen = capture.for_training(Policy())
    frames = sorted(capture.frames, key=lambda frame: frame.mid_us)
    times = [frame.mid_us for frame in frames if frame.split == "train"]
    found = find._cameras(seen, times)
    wanted = [capture.camera(frame) for frame in frames if frame.split == "train"]
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one.world_to_camera, other.world_to_camera)


def test_key_points_of_a_lens_that_distorts_lie_where_the_pictures_are_read(unposed, rng):
    """They were found in the pictures as recorded."""
    path, points = unposed
    straight = np.load(points)
    document = json.loads((path / "capture.json").read_text())
    camera = document["cameras"]["main"]
    coefficients = (rng.uniform(-0.3, 0.3, 4) * (1, 0.2, 0.02, 0.02)).tolist()
    camera["distortion"] = {"model": "opencv", "coefficients": coefficients}
    (path / "capture.json").write_text(json.dumps(document))
    K = np.array(camera["K"], np.float64)
    lens = Distortion(camera["width"], camera["height"], K, tuple(coefficients))
    np.save(points, np.concatenate((lens.distort(straight[..., :2]), straight[..., 2:]), -1))
    capture = load_capture(path, needs_body=False)
    found = find._landmarks(capture.for_training(Policy()), (), points)
    train = [frame.split == "train" for frame in capture.frames]
    assert np.array_equal(found.seen, straight[train][..., 2])
    there = found.seen > 0
    np.testing.assert_allclose(found.places[there], straight[train][..., :2][there], atol=1e-3)
