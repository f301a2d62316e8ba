"""Poses of a file given to a capture: where they are put, which frames stay, what is refused."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evsplat.body.smpl import ENVIRONMENT
from evsplat.capture import Capture, load_body_track, load_capture, validate_capture
from evsplat.cli.main import main
from evsplat.errors import DataError, EvsplatError
from evsplat.importers import attach_poses, import_capture
from evsplat.importers import poses as module

from ..body.pose_files import synthetic
from . import trees
from .person import write_smpl
from .test_folder import VIEW, worst_miss, write_recording


@pytest.fixture
def unposed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A capture without poses of a person whom its calibrated camera sees."""
    monkeypatch.delenv(ENVIRONMENT, raising=False)
    (tmp_path / "mine").mkdir()
    write_recording(tmp_path / "mine")
    options = {"fps": 25.0, "exposure_us": 30_000.0}
    import_capture("folder", tmp_path / "mine", tmp_path / "none", no_poses=True, **options)
    return tmp_path / "none"


def about_the_camera(path: Path, focal: float = 1.0) -> None:
    """Put the poses of a file before the camera, which takes another focal length."""
    with np.load(path) as given:
        arrays = dict(given)
    person, view = trees.zju_person(), VIEW.world_to_camera
    poses = arrays["poses"].reshape(-1, 24, 3)
    pelvis = person.rest[1][0]
    poses[:, 0] = (
        Rotation.from_matrix(view[:3, :3]) * Rotation.from_rotvec(poses[:, 0])
    ).as_rotvec()
    place = (pelvis + arrays["trans"]) @ view[:3, :3].T + view[:3, 3]
    place[:, 2] *= focal
    arrays |= {"poses": poses.reshape(-1, 72), "trans": place - pelvis}
    np.savez(path, **arrays)


def posed(monkeypatch: pytest.MonkeyPatch, models: Path, path: Path) -> Capture:
    monkeypatch.setenv(ENVIRONMENT, str(models))
    return load_capture(path)


def test_poses_in_the_world_are_taken_as_they_are(unposed, tmp_path, monkeypatch) -> None:
    models = write_smpl(tmp_path / "models")
    out = attach_poses(unposed, tmp_path / "mine" / "poses.npz", tmp_path / "out", smpl=models)
    capture = posed(monkeypatch, models, out)
    assert worst_miss(capture) < 0.01
    assert capture.provenance["poses"]["file"] == "poses.npz"
    assert capture.poses_found is None
    assert not load_capture(unposed).has_body


@pytest.mark.parametrize("focal", [1.0, 1.5])
def test_poses_about_the_camera_are_put_where_it_sees_them(
    unposed, tmp_path, monkeypatch, focal
) -> None:
    models = write_smpl(tmp_path / "models")
    file = tmp_path / "mine" / "poses.npz"
    about_the_camera(file, focal)
    K = VIEW.K + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    K[:2, :2] *= focal
    read = module.read_poses
    monkeypatch.setattr(
        module, "read_poses", lambda *a, **k: replace(read(*a, **k), world="camera", K=K)
    )
    out = attach_poses(unposed, file, tmp_path / "out", smpl=models, pose_source="estimated")
    capture = posed(monkeypatch, models, out)
    assert worst_miss(capture) < 0.01
    assert capture.body_file.source == "estimated"
    notes = " ".join(capture.provenance["poses"]["notes"])
    assert ("0.67 times as far" in notes) == (focal == 1.5)


def test_frames_without_a_pose_are_left_out_and_splits_stay(
    tiny_capture, tmp_path, monkeypatch
) -> None:
    monkeypatch.delenv(ENVIRONMENT, raising=False)
    path = tiny_capture(frames=10)
    document = json.loads((path / "capture.json").read_text())
    document["body"] = None
    for frame in document["frames"]:
        frame.pop("split", None)  # it follows from the place in the list
    (path / "capture.json").write_text(json.dumps(document))
    file = synthetic.write_wham(tmp_path, synthetic.make_motion(0))
    out = attach_poses(path, file, tmp_path / "out")
    capture = load_capture(out)
    given = load_capture(path)
    kept = capture.frames
    assert [frame.index for frame in map(given.frame, [f.name for f in kept])] == [2, 3, 4, 7, 8]
    assert [frame.split for frame in kept] == [given.frame(frame.name).split for frame in kept]
    assert {view.frame for view in capture.novel_views} <= {frame.name for frame in kept}
    assert len(list((out / "images").iterdir())) == len(kept)
    assert len(list((path / "images").iterdir())) == 10
    assert load_body_track(capture).errors.source == "estimated"
    assert not [finding for finding in validate_capture(out) if finding.severity == "error"]


def test_body_npz_brings_its_rig_its_times_and_how_far_it_errs(tiny_capture, tmp_path) -> None:
    path = tiny_capture(frames=10)
    with np.load(path / "body.npz") as given:
        arrays = dict(given)
    count, joints = arrays["poses"].shape[:2]
    arrays |= {"pose_std_rad": np.full((count, joints), 0.1), "transl_std_m": np.ones((count, 3))}
    arrays = {
        key: value[2:] if key in ("times_us", "poses", "transl", *list(arrays)[-2:]) else value
        for key, value in arrays.items()
    }
    (tmp_path / "other").mkdir()
    np.savez(tmp_path / "other" / "body.npz", **arrays)
    before = (path / "body.npz").read_bytes()
    file = tmp_path / "other" / "body.npz"
    out = attach_poses(path, file, tmp_path / "out", pose_source="estimated")
    capture = load_capture(out)
    assert len(capture.frames) == 8
    assert capture.body_file.model == "rig"
    assert load_body_track(capture).errors.joint_rad.max() == pytest.approx(0.1)
    assert (path / "body.npz").read_bytes() == before


def nothing(path: Path) -> Path:
    return path / "nothing.pt"


def of_other_frames(path: Path) -> Path:
    motion = synthetic.make_motion(0)
    return synthetic.write_wham(path, replace(motion, frames=motion.frames + 100))


@pytest.mark.parametrize(
    ("make", "message"),
    [(nothing, "file or folder not found"), (of_other_frames, "has no pose of a frame of")],
)
def test_what_cannot_be_is_one_sentence_and_leaves_what_was(
    tiny_capture, tmp_path, make, message
) -> None:
    path = tiny_capture(frames=4)
    shutil.copytree(path, tmp_path / "out")
    with pytest.raises(EvsplatError, match=message):
        attach_poses(path, make(tmp_path), tmp_path / "out", overwrite=True)
    assert load_capture(tmp_path / "out").has_body
    with pytest.raises(DataError, match="already exists"):
        attach_poses(path, path / "body.npz", tmp_path / "out")


def test_the_command_line_gives_a_capture_its_poses(tiny_capture, tmp_path, capsys) -> None:
    path, out = tiny_capture(frames=4), tmp_path / "out"
    assert main(["import", "poses", str(path), str(path / "body.npz"), "--out", str(out)]) == 0
    assert f"written: {out}" in capsys.readouterr().out
