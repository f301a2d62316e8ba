"""Every tool's file gives the joints that the tool's own rule gives."""

import json
import os
import pickle
import re
import shutil
from pathlib import Path

import joblib
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from evsplat.body import BodyTrack
from evsplat.body.pose_files import read_poses, to_default_body
from evsplat.body.pose_files.sequence import moved
from evsplat.body.skeleton import find_skeleton
from evsplat.body.smpl import ENVIRONMENT, smpl_body
from evsplat.body.smpl_skeleton import NAMES, PARENTS
from evsplat.capture.body_file import body_from_arrays
from evsplat.capture.body_track import load_body
from evsplat.errors import DataError
from evsplat.untrusted.arrays import read_plain_npz

from ..helpers import posed_joints
from . import synthetic
from .synthetic import SIZE, TOOLS, make_motion, write, write_models

BONES = (("upper_arm", "forearm"), ("forearm", "hand"), ("thigh", "shin"), ("shin", "foot"))


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    return write_models(tmp_path_factory.mktemp("models"))


def directions(joints, skeleton):
    bones = [
        joints[:, skeleton.limbs[f"{side}_{end}"]] - joints[:, skeleton.limbs[f"{side}_{start}"]]
        for side in ("left", "right")
        for start, end in BONES
    ]
    return np.stack([bone / np.linalg.norm(bone, axis=-1, keepdims=True) for bone in bones], 1)


@pytest.mark.parametrize("tool", TOOLS)
def test_joints_are_where_the_tools_own_rule_puts_them(tmp_path, models, tool):
    written = write(tool, tmp_path / tool, seed=TOOLS.index(tool))
    sequence = read_poses(written.path, body_models=models)
    assert np.array_equal(sequence.frames, written.motion.frames)
    many_cameras = tool in ("easymocap", "zju", "arah", "amass", "amass_smplx", "mmhpsd")
    assert sequence.pose_source == ("markers" if many_cameras else "estimated")
    body = smpl_body(sequence.model, sequence.betas, path=models)
    joints = posed_joints(body, sequence.poses, sequence.transl)
    assert np.abs(joints - written.joints).max() < 1e-5


@pytest.mark.parametrize("tool", TOOLS)
def test_the_shipped_bodys_limbs_point_where_the_persons_did(tmp_path, models, tool):
    written = write(tool, tmp_path / tool, seed=20 + TOOLS.index(tool))
    sequence = read_poses(written.path, body_models=models)
    body, poses, transl = to_default_body(sequence, body_models=models)
    placed = posed_joints(body, poses, transl)
    taker = find_skeleton(body.parents.tolist(), body.joint_names)
    mover = find_skeleton(list(PARENTS), NAMES)
    expected = directions(written.joints, mover)
    assert np.abs(directions(placed, taker) - expected).max() < 1e-5
    hips = [placed[:, taker.limbs[f"{s}_thigh"]] for s in ("left", "right")]
    there = [written.joints[:, mover.limbs[f"{s}_thigh"]] for s in ("left", "right")]
    scale = sum(hips) @ np.ones(3) / (sum(there) @ np.ones(3))
    assert np.allclose(sum(hips), scale[:, None] * sum(there), atol=1e-4)
    assert np.allclose(scale, 1) if sequence.world == "calibration" else (scale > 1.01).all()


@pytest.mark.parametrize("tool", ["wham", "romp", "phalp", "gvhmr", "tram", "mmhpsd"])
def test_intrinsics_are_those_the_tool_assumed(tmp_path, models, tool):
    written = write(tool, tmp_path / tool)
    focal, centre = {
        "wham": (800.0, (320, 240)),  # the diagonal of 640 x 480
        "romp": (443.4 * 640 / 512, (320, 240)),
        "phalp": (5000 * 640 / 256, (320, 240)),
        "gvhmr": (800.0, (320, 240)),
        "tram": (700.0, (320, 240)),
        "mmhpsd": (1679.3 * 256 / 1280, (641 * 256 / 1280,) * 2),
    }[tool]
    sequence = read_poses(written.path, image_size=SIZE, body_models=models)
    expected = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1]])
    assert np.allclose(sequence.K, expected)
    assert sequence.world == "camera" and sequence.world_to_camera is None


@pytest.mark.parametrize("seed", range(2))
def test_gvhmrs_world_and_its_camera_give_the_joints_in_the_camera(tmp_path, models, seed):
    motion = make_motion(seed, "smplx", hands=False)
    turns = Rotation.random(synthetic.TIMES, random_state=seed)
    shifts = np.random.default_rng(seed).normal(size=(synthetic.TIMES, 3))
    pelvis = motion.joints()[:, 0] - motion.transl
    world_poses, world_transl = moved(
        motion.poses, motion.transl, turns.as_matrix(), shifts, pelvis[0]
    )
    there = synthetic.Motion("smplx", world_poses, world_transl, motion.betas)
    file = synthetic.write_gvhmr(tmp_path, motion, there)
    sequence = read_poses(file, world=True, body_models=models)
    assert sequence.world == "y up"
    body = smpl_body("smplx", sequence.betas, path=models)
    joints = posed_joints(body, sequence.poses, sequence.transl)
    assert np.abs(joints - there.joints()).max() < 1e-5
    camera = sequence.world_to_camera
    seen = joints @ camera[:, :3, :3].swapaxes(1, 2) + camera[:, None, :3, 3]
    assert np.abs(seen - motion.joints()).max() < 1e-5


def test_trams_world_moves_the_body_with_the_camera(tmp_path, models):
    motion = make_motion(1)
    turns = Rotation.random(10, random_state=1).as_matrix()
    shifts = np.random.default_rng(1).normal(size=(10, 3))
    synthetic.write_tram(tmp_path, motion, (turns, shifts))
    sequence = read_poses(tmp_path, world=True, body_models=models)
    body = smpl_body("smpl", sequence.betas, path=models)
    joints = posed_joints(body, sequence.poses, sequence.transl)
    frames = motion.frames
    expected = motion.joints() @ turns[frames].swapaxes(1, 2) + shifts[frames][:, None]
    assert np.abs(joints - expected).max() < 1e-5
    camera = sequence.world_to_camera
    seen = joints @ camera[:, :3, :3].swapaxes(1, 2) + camera[:, None, :3, 3]
    assert np.abs(seen - motion.joints()).max() < 1e-5


def test_poses_in_degrees_are_refused_with_that_word(tmp_path):
    written = write("amass", tmp_path / "amass")
    with np.load(written.path) as file:
        arrays = dict(file)
    arrays["poses"] = np.degrees(arrays["poses"])
    np.savez(written.path, **arrays)
    with pytest.raises(DataError, match="they look like degrees, expected axis-angle .* radians"):
        read_poses(written.path)


def test_without_a_model_a_given_pelvis_gives_the_same_root(tmp_path, models, monkeypatch, caplog):
    monkeypatch.delenv(ENVIRONMENT, raising=False)
    written = write("zju", tmp_path / "zju")
    arrays = synthetic.model_arrays("smpl")
    pelvis = arrays["v_template"][0] + arrays["shapedirs"][0] @ written.motion.betas
    sequence = read_poses(written.path, rest_pelvis=tuple(pelvis))
    exact = read_poses(written.path, body_models=models)
    assert np.abs(sequence.transl - exact.transl).max() < 1e-6
    assert not caplog.records
    rough = read_poses(written.path)
    assert "average proportions stand for this person's" in caplog.text
    assert "smpl.is.tue.mpg.de" in caplog.text
    # the root's place is off by no more than the pelvis is: both ends of its turn
    assert np.abs(rough.transl - exact.transl).max() < 2 * np.linalg.norm(
        pelvis - np.array([0, -0.22, 0.03])
    )
    assert np.array_equal(rough.poses, exact.poses)


def test_poses_never_jump_by_a_whole_turn(tmp_path):
    motion = make_motion(0)
    angles = np.array([2.8, 3.0, 3.3, 3.6, 3.9])
    motion.poses[:, 0] = Rotation.from_rotvec(angles[:, None] * [0, 1.0, 0]).as_rotvec()
    assert np.abs(np.diff(motion.poses[:, 0], axis=0)).max() > 5
    sequence = read_poses(synthetic.write_wham(tmp_path, motion))
    assert np.allclose(sequence.poses[:, 0], angles[:, None] * [0, 1.0, 0], atol=1e-9)


def test_of_several_people_one_is_chosen_and_the_message_names_them(tmp_path):
    first, second = make_motion(0), make_motion(1)
    file = synthetic.write_wham(tmp_path, first, [(3, second)])
    with pytest.raises(DataError, match=r"holds 2 people: 1 \(5 frames\), 3 \(5 frames\); choose"):
        read_poses(file)
    with pytest.raises(DataError, match=r"no person '2'; the file has 1 \(5 frames\), 3"):
        read_poses(file, person=2)
    assert np.allclose(read_poses(file, person=3).transl, second.transl)
    folder = tmp_path / "romp"
    folder.mkdir()
    synthetic.write_romp(folder, first)
    file = folder / "00000002.npz"
    results = dict(np.load(file, allow_pickle=True)["results"][()])
    two = {key: np.concatenate((value, value)) for key, value in results.items()}
    np.savez(file, results=two)
    with pytest.raises(DataError, match="2 people without track_ids; run ROMP with"):
        read_poses(folder)
    np.savez(file, results={**two, "track_ids": np.array([5, 0])})
    assert read_poses(folder, person=0).frames.tolist() == first.frames.tolist()


def test_the_whole_video_of_romp_is_one_file_too(tmp_path):
    motion = make_motion(2)
    frames = tmp_path / "frames"
    frames.mkdir()
    synthetic.write_romp(frames, motion)
    results = {
        f"{frame:08d}.png": np.load(frames / f"{frame:08d}.npz", allow_pickle=True)["results"][()]
        for frame in motion.frames
    }
    np.savez(tmp_path / "video_results.npz", results=results, sequence_results={})
    one, other = read_poses(frames), read_poses(tmp_path / "video_results.npz")
    assert np.array_equal(one.frames, other.frames) and np.array_equal(one.poses, other.poses)


def test_times_follow_from_the_frame_rate(tmp_path):
    sequence = read_poses(write("amass", tmp_path / "a").path)
    assert sequence.times_us().tolist() == [0, 8333, 16667, 25000, 33333]
    sequence = read_poses(write("wham", tmp_path / "w").path)
    with pytest.raises(DataError, match="no frame rate; give fps="):
        sequence.times_us()
    assert sequence.times_us(25).tolist() == [40_000 * frame for frame in (2, 3, 4, 7, 8)]


class Attack:
    def __reduce__(self):
        return (os.system, ("touch touched",))


ATTACKS = {
    "wham_output.pkl": lambda file: joblib.dump({1: {"pose": Attack()}}, file),
    "demo.pkl": lambda file: joblib.dump({1: Attack()}, file, compress=3),
    "hps_track_0.npy": lambda file: np.save(file, {"frame": Attack()}),
    "0001.npz": lambda file: np.savez(file, results={"smpl_thetas": Attack()}),
    "hmr4d_results.pt": lambda file: torch.save({"smpl_params_incam": Attack()}, file),
    "old.pt": lambda file: torch.save(
        {"smpl_params_incam": Attack()}, file, _use_new_zipfile_serialization=False
    ),
}


@pytest.mark.parametrize("name", ATTACKS)
def test_code_in_a_file_is_refused_and_not_run(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    ATTACKS[name](tmp_path / name)
    with pytest.raises(DataError, match=rf"{name}: holds the pickled type (posix|nt)\.system"):
        read_poses(tmp_path / name)
    assert not (tmp_path / "touched").exists()


def test_a_forged_tensor_in_a_pickle_is_refused(tmp_path):
    data = pickle.dumps({"frame": torch.arange(6.0)}, protocol=2)
    forged = data.replace(b"K\x06\x85", b"K\x7f\x85")  # six numbers claimed to be 127
    assert forged != data
    (tmp_path / "x.pkl").write_bytes(forged)
    with pytest.raises(DataError, match="not a readable pose file"):
        read_poses(tmp_path / "x.pkl")


@pytest.mark.parametrize("tool", TOOLS)
def test_damaged_files_give_one_sentence(tmp_path, models, tool):
    rng = np.random.default_rng(TOOLS.index(tool))
    written = write(tool, tmp_path / tool)
    spoilt = [written.path] if written.path.is_file() else sorted(written.path.rglob("*[0-9].*"))
    file = spoilt[0]
    whole = file.read_bytes()
    for attempt in range(60):
        data = bytearray(whole)
        if attempt % 3 == 0:
            data = data[: rng.integers(len(data))]
        else:
            # half of the changes in the first kilobyte, where the structure is
            end = min(1024, len(data)) if attempt % 2 else len(data)
            data[rng.integers(end)] ^= 1 << rng.integers(8)
        file.write_bytes(data)
        try:
            sequence = read_poses(written.path, body_models=models)
            assert np.isfinite(sequence.poses).all()
        except DataError as error:
            assert "\n" not in str(error)


def test_what_is_no_pose_file_says_what_it_holds(tmp_path):
    with pytest.raises(DataError, match="file or folder not found"):
        read_poses(tmp_path / "none.pkl")
    with pytest.raises(DataError, match="holds no numbered files of"):
        read_poses(tmp_path)
    (tmp_path / "x.txt").write_text("a")
    with pytest.raises(DataError, match=r"pose files end in \.pt"):
        read_poses(tmp_path / "x.txt")
    (tmp_path / "1.json").write_text(json.dumps({"a": 1, "b": 2}))
    with pytest.raises(DataError, match=r"not a pose file of GVHMR, .*; it holds the keys a, b"):
        read_poses(tmp_path / "1.json")
    folder = write("zju", tmp_path / "zju").path
    shutil.copy(folder / "2.npy", tmp_path / "2.npy")
    np.save(folder / "5.npy", {"Rh": 1})
    with pytest.raises(DataError, match=r"5\.npy: not EasyMocap like 2\.npy beside it"):
        read_poses(folder)
    with pytest.raises(DataError, match=r"rest_pelvis is \(1, 2\), expected three numbers"):
        read_poses(tmp_path / "2.npy", rest_pelvis=(1, 2))


def test_wrong_fields_are_named(tmp_path):
    motion = make_motion(0)
    motion.frames = np.array([1, 2, 2, 3, 4])
    with pytest.raises(DataError, match="frame 2 has two poses"):
        read_poses(synthetic.write_wham(tmp_path, motion))
    motion = make_motion(0)
    motion.transl[2, 1] = np.nan
    with pytest.raises(DataError, match="person 1: trans holds values that are not finite"):
        read_poses(synthetic.write_wham(tmp_path, motion))
    with pytest.raises(DataError, match=r"WHAM puts its world's origin .*world=False"):
        read_poses(synthetic.write_wham(tmp_path, make_motion(0)), world=True)
    np.savez(tmp_path / "m.npz", poses=np.zeros((3, 70)), trans=np.zeros((3, 3)), betas=np.zeros(3))
    with pytest.raises(DataError, match="poses has 70 numbers per frame, expected 72"):
        read_poses(tmp_path / "m.npz")
    motion = make_motion(0)
    folder = tmp_path / "tram"
    folder.mkdir()
    synthetic.write_tram(folder, motion, (np.tile(np.eye(3), (3, 1, 1)), np.zeros((3, 3))))
    with pytest.raises(DataError, match=r"has 3 cameras, but the person is there in frame 8"):
        read_poses(folder, world=True)


DOCS = Path(__file__).parents[3] / "docs" / "poses.md"


@pytest.mark.skipif(not DOCS.exists(), reason="not a source checkout")
def test_the_documented_code_writes_a_body_file(tmp_path, models, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(ENVIRONMENT, str(models))
    variables = {
        "pose_file": write("wham", tmp_path / "wham").path,
        "mid_exposure_us": 15_000 + 40_000 * np.arange(10),
    }
    (block,) = re.findall(r"```python\n(.*?)```", DOCS.read_text(encoding="utf-8"), re.DOTALL)
    exec(block, variables)
    check_written("default", 31)
    # with the person's own shape, as the page says below it
    sequence = variables["sequence"]
    kept = ("poses", "transl", "betas", "gender")
    np.savez(
        "body.npz",
        model=sequence.model,
        times_us=variables["mid_exposure_us"][sequence.frames],
        **{name: getattr(sequence, name) for name in kept},
    )
    check_written("smpl", 24)


def check_written(model, joints):
    written = body_from_arrays(Path("body.npz"), read_plain_npz(Path("body.npz")), "?")
    assert written.model == model
    track = BodyTrack(load_body(written)[0], written.times_us, written.poses, written.transl)
    assert written.poses.shape == (5, joints, 3)
    assert track.times_us.tolist() == [15_000 + 40_000 * f for f in (2, 3, 4, 7, 8)]


def test_between_two_poses_the_body_turns_the_short_way(tmp_path):
    """A tool's own vectors flip their sign at half a turn; the track must not spin there."""
    motion = make_motion(0)
    angles = np.array([3.0, 3.1, 3.2, 3.5, 3.6])
    motion.poses[:, 0] = Rotation.from_rotvec(angles[:, None] * [0, 1.0, 0]).as_rotvec()
    sequence = read_poses(synthetic.write_wham(tmp_path, motion))
    body, poses, transl = to_default_body(sequence)
    times = sequence.times_us(100)
    track = BodyTrack(body, times, poses, transl)
    rotations, _ = track.at(np.arange(times[0], times[-1], 500).tolist())
    steps = Rotation.from_matrix(rotations[1:, 0].numpy()) * (
        Rotation.from_matrix(rotations[:-1, 0].numpy()).inv()
    )
    assert steps.magnitude().max() < 0.02  # 0.1 rad per frame of 10 ms in steps of 0.5 ms
    assert np.linalg.norm(np.diff(poses, axis=0), axis=-1)[:, 0].max() < 1  # a turn is 6.3
