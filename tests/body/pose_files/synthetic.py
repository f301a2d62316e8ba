"""A made-up SMPL family, a motion of it, and that motion in the file of every tool.

`joints_in_file_convention` places the joints by each tool's own rule in float64; nothing of the
package is used for it.
"""

import json
from dataclasses import dataclass, field
from pathlib import Path

import joblib
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from evsplat.body.canonical import SMPL_PARENTS

from ..helpers import reference_bones
from ..skeletons import SMPL, tables

SMPLX_PARENTS = (*SMPL_PARENTS[:22], 15, 15, 15)
for _wrist, _first in ((20, 25), (21, 40)):
    for _finger in range(5):
        _start = _first + 3 * _finger
        SMPLX_PARENTS += (_wrist, _start, _start + 1)
PARENTS = {"smpl": SMPL_PARENTS, "smplx": SMPLX_PARENTS}
TIMES = 5
FRAMES = np.array([2, 3, 4, 7, 8])
"""Video frames of a person who leaves the picture for a while."""
SIZE = (640, 480)


def model_arrays(model):
    """Arrays of a model file whose vertices are its joints, each moved a little by the shape."""
    rng = np.random.default_rng(7)
    joints = np.concatenate((tables(SMPL)[2], np.zeros((31, 3))))[: len(PARENTS[model])]
    for joint in range(22 if model == "smplx" else 24, len(joints)):
        joints[joint] = joints[PARENTS[model][joint]] + 0.03 * rng.normal(size=3)
    joints = joints + np.array([0.01, -0.25, 0.02])
    count = len(joints)
    directions = 0.01 * rng.normal(size=(count, 3, 400 if model == "smplx" else 10))
    arrays = {
        "v_template": joints,
        "f": np.array([[0, 1, 2], [2, 3, 4]], np.uint32),
        "weights": np.eye(count),
        "shapedirs": directions,
        "posedirs": np.zeros((count, 3, 9 * (count - 1))),
        "J_regressor": np.eye(count),
        "kintree_table": np.array([PARENTS[model], range(count)]).astype(np.uint32),
    }
    if model == "smplx":
        names = {f"joint{j}": j for j in range(55) if j not in (1, 2)}
        names |= {"left_hip": 1, "right_hip": 2}
        arrays |= {"hands_meanl": np.zeros(45), "hands_meanr": np.zeros(45)}
        arrays["joint2num"] = np.array(names, dtype=object)
    return arrays


def write_models(folder):
    """Model files as the user would have them."""
    for model in PARENTS:
        np.savez(folder / f"{model.upper()}_NEUTRAL.npz", **model_arrays(model))
    return folder


@dataclass
class Motion:
    """What a person did; poses as the tool under test writes them."""

    model: str
    poses: np.ndarray
    transl: np.ndarray
    betas: np.ndarray
    frames: np.ndarray = field(default_factory=lambda: FRAMES)

    def joints(self, rotate_about_origin=None):
        """Joints in the file's world; with a rotation vector per frame, turned about the origin."""
        arrays = model_arrays(self.model)
        shaped = arrays["shapedirs"][:, :, : len(self.betas)] @ self.betas
        rest = arrays["v_template"] + shaped
        placed = np.zeros((len(self.poses), len(rest), 3))
        for time, pose in enumerate(self.poses):
            transl = self.transl[time] if rotate_about_origin is None else np.zeros(3)
            bones = reference_bones(PARENTS[self.model], rest, pose, transl)
            joints = np.einsum("jab,jb->ja", bones[:, :3, :3], rest) + bones[:, :3, 3]
            if rotate_about_origin is not None:
                turn = Rotation.from_rotvec(rotate_about_origin[time]).as_matrix()
                joints = joints @ turn.T + self.transl[time]
            placed[time] = joints
        return placed


def make_motion(seed, model="smpl", *, hands=True):
    """A person before the camera (upright there: y down), bending at every joint."""
    rng = np.random.default_rng(seed)
    poses = 0.5 * rng.normal(size=(TIMES, len(PARENTS[model]), 3))
    facing = Rotation.from_rotvec([np.pi, 0, 0]) * Rotation.from_rotvec(
        0.6 * rng.normal(size=(TIMES, 3))
    )
    poses[:, 0] = facing.as_rotvec()
    if not hands:
        poses[:, 22:] = 0
    transl = np.array([0.2, 0.1, 4.0]) + 0.3 * rng.normal(size=(TIMES, 3))
    return Motion(model, poses, transl, rng.normal(size=10))


def matrices(vectors):
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)


def write_gvhmr(folder, motion, world=None):
    world = motion if world is None else world
    file = folder / "hmr4d_results.pt"
    sets = {}
    for name, one in (("smpl_params_incam", motion), ("smpl_params_global", world)):
        sets[name] = {
            "body_pose": torch.from_numpy(one.poses[:, 1:22].reshape(TIMES, 63)),
            "betas": torch.from_numpy(np.tile(one.betas, (TIMES, 1))),
            "global_orient": torch.from_numpy(one.poses[:, 0]),
            "transl": torch.from_numpy(one.transl),
        }
    K = torch.tensor([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]]).repeat(TIMES, 1, 1)
    torch.save({**sets, "K_fullimg": K, "net_outputs": {"static": torch.zeros(3)}}, file)
    return file


def write_wham(folder, motion, others=()):
    from collections import defaultdict

    people = defaultdict(dict)
    for person, one in ((1, motion), *others):
        people[person] = {
            "pose": one.poses.reshape(TIMES, 72),
            "trans": one.transl,
            "pose_world": one.poses.reshape(TIMES, 72),
            "trans_world": one.transl,
            "betas": np.tile(one.betas, (TIMES, 1)),
            "verts": np.zeros((TIMES, 20, 3), np.float32),
            "frame_ids": one.frames,
        }
    joblib.dump(people, folder / "wham_output.pkl")
    return folder / "wham_output.pkl"


def write_tram(folder, motion, camera=None):
    (folder / "hps").mkdir()
    results = {
        "pred_cam": torch.zeros(TIMES, 3),
        "pred_shape": torch.from_numpy(np.tile(motion.betas, (TIMES, 1))),
        "pred_rotmat": torch.from_numpy(matrices(motion.poses)),
        "pred_trans": torch.from_numpy(motion.transl[:, None]),
        "frame": torch.from_numpy(motion.frames),
    }
    np.save(folder / "hps" / "hps_track_0.npy", results)
    turns, shifts = camera if camera else (np.tile(np.eye(3), (10, 1, 1)), np.zeros((10, 3)))
    document = {"pred_cam_R": turns, "pred_cam_T": shifts}
    document |= {"img_focal": np.float64(700.0), "img_center": np.array([320.0, 240.0])}
    np.save(folder / "camera.npy", document)
    return folder


def write_phalp(folder, motion, compress=3):
    frames = {}
    for index in range(10):
        entry = {"time": index, "shot": 0, "tid": [], "tracked_ids": [], "tracked_time": []}
        entry |= {"smpl": [], "camera": [], "size": [], "mask": [], "bbox": []}
        slots = np.flatnonzero(motion.frames == index)
        for slot in [*slots, *([0] if index == 9 else [])]:
            turns = matrices(motion.poses[slot]).astype(np.float32)
            body = {"global_orient": turns[:1], "body_pose": turns[1:]}
            entry["smpl"].append({**body, "betas": motion.betas.astype(np.float32)})
            entry["camera"].append(motion.transl[slot])
            entry["size"].append([SIZE[1], SIZE[0]])
            entry["tid"].append(4)
            entry["mask"].append([{"size": [480, 640], "counts": "abc"}])
            entry["bbox"].append(np.zeros(4))
            if index != 9:  # in the last frame the person is only predicted
                entry["tracked_ids"].append(4)
        frames[f"outputs/_TMP/{index + 1:06d}.jpg"] = entry
    joblib.dump(frames, folder / "demo_video.pkl", compress=compress)
    return folder / "demo_video.pkl"


def write_romp(folder, motion):
    for slot, frame in enumerate(motion.frames):
        results = {
            "smpl_thetas": motion.poses[slot].reshape(1, 72).astype(np.float32),
            "smpl_betas": motion.betas[None].astype(np.float32),
            "cam": np.zeros((1, 3), np.float32),
            "cam_trans": motion.transl[slot][None],
            "verts": np.zeros((1, 20, 3), np.float32),
        }
        np.savez(folder / f"{frame:08d}.npz", results=results)
    np.savez(folder / "video_results.npz", results={}, sequence_results={})
    return folder


def _easymocap_entry(motion, slot, turn):
    return {
        "id": 0,
        "Rh": turn[slot][None].tolist(),
        "Th": motion.transl[slot][None].tolist(),
        "poses": motion.poses[slot].reshape(1, -1).tolist(),
        "shapes": motion.betas[None].tolist(),
    }


def write_easymocap(folder, motion, turn):
    for slot, frame in enumerate(motion.frames):
        entries = [_easymocap_entry(motion, slot, turn)]
        content = {"annots": entries} if slot % 2 else entries
        (folder / f"{frame:06d}.json").write_text(json.dumps(content))
    return folder


def write_zju(folder, motion, turn):
    for slot, frame in enumerate(motion.frames):
        entry = _easymocap_entry(motion, slot, turn)
        del entry["id"]
        arrays = {key: np.array(value) for key, value in entry.items()}
        np.save(folder / f"{frame}.npy", arrays, allow_pickle=True)
    return folder


def write_arah(folder, motion):
    for slot, frame in enumerate(motion.frames):
        pose = motion.poses[slot]
        np.savez(
            folder / f"{frame:06d}.npz",
            minimal_shape=np.zeros((6890, 3), np.float32),
            betas=motion.betas[None],
            Jtr_posed=np.zeros((24, 3)),
            bone_transforms=np.tile(np.eye(4), (24, 1, 1)),
            trans=motion.transl[slot],
            root_orient=pose[0],
            pose_body=pose[1:22].ravel(),
            pose_hand=pose[22:].ravel(),
        )
    return folder


def write_amass(folder, motion, rate="mocap_framerate"):
    arrays = {"poses": motion.poses.reshape(TIMES, -1), "trans": motion.transl}
    arrays |= {"betas": motion.betas, "gender": "neutral", rate: 120.0}
    np.savez(folder / "motion_poses.npz", **arrays)
    return folder / "motion_poses.npz"


def write_mmhpsd(folder, motion):
    joints = motion.joints()
    for slot, frame in enumerate(motion.frames):
        content = (
            motion.betas[None],
            motion.poses[slot].reshape(1, 72),
            motion.transl[slot][None],
            joints[slot],
            np.zeros((24, 2)),
        )
        joblib.dump(content, folder / f"pose{frame:04d}.pkl")
    return folder


@dataclass
class Written:
    """A tool's file and where its rule puts the joints."""

    path: Path
    motion: Motion
    joints: np.ndarray


def write(tool, folder, seed=0):
    """The file of a tool, with what it means."""
    smplx = tool in ("gvhmr", "amass_smplx")
    motion = make_motion(seed, "smplx" if smplx else "smpl", hands=tool != "gvhmr")
    joints = motion.joints()
    folder.mkdir(parents=True, exist_ok=True)
    if tool in ("easymocap", "zju"):
        turn = motion.poses[:, 0].copy()
        # The rest of the root's rotation stays within the model, about the pelvis.
        motion.poses[:, 0] = 0.0 if tool == "zju" else 0.3
        joints = motion.joints(rotate_about_origin=turn)
        writer = write_easymocap if tool == "easymocap" else write_zju
        return Written(writer(folder, motion, turn), motion, joints)
    if tool in ("gvhmr", "amass_smplx", "amass"):
        motion.frames = np.arange(TIMES)
    writers = {
        **{"gvhmr": write_gvhmr, "wham": write_wham, "tram": write_tram, "phalp": write_phalp},
        **{"romp": write_romp, "arah": write_arah, "amass": write_amass, "mmhpsd": write_mmhpsd},
        "amass_smplx": lambda where, what: write_amass(where, what, "mocap_frame_rate"),
    }
    return Written(writers[tool](folder, motion), motion, joints)


TOOLS = (
    *("gvhmr", "wham", "tram", "phalp", "romp", "easymocap", "zju", "arah", "amass"),
    *("amass_smplx", "mmhpsd"),
)
