"""What smoothing of poses with errors brings, on joints alone: no picture, no training.

    python benchmarks/pose_smoothing.py [--captures 20] [--seed 0] [--told 1] [--seen 0.3]

The motions of a draw (`evsplat.benching.drawn`), each with errors of all levels as `evsplat stage`
makes them, are smoothed as training does and left as they are. Then they are corrected as if
pictures told the turns of each joint at training times, up to ``--seen`` of what is expected: that
stands in for the correction by drawing and carries it to held-out times by the same prior. Printed
is the mean distance of 14 joints from the true ones in 128-pixel pictures at held-out times, of
poses as given, with joints smoothed alone, with the root's place alone, and with both as training
has it; the ratio to no smoothing, its mean and its worst.
``--told`` multiplies what the poses say of their errors. The last line is one JSON object.
"""

import argparse
import json
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool
from pose_refinement import joints
from scipy.spatial.transform import Rotation

from evsplat.benching.drawn import Draw, drawn_settings
from evsplat.body import BodyTrack, PoseErrors
from evsplat.body.motion import load_motion
from evsplat.body.pose_noise import noise_errors, poses_off_by
from evsplat.body.rotations import nearest_axis_angle
from evsplat.camera import Camera
from evsplat.capture.parse_frames import default_split
from evsplat.methods.poses import SMOOTHED_PLACE, smoothed_by_expected
from evsplat.options import StageSettings
from evsplat.options.captures import PoseNoise
from evsplat.posing.correction import Correction
from evsplat.posing.refine import expected_errors
from evsplat.staging.assets import find_character, find_motion
from evsplat.staging.camera import MAIN, frame_times, make_camera
from evsplat.staging.character import load_character
from evsplat.staging.maker import POSE_ERRORS, POSE_SOURCE
from evsplat.staging.motion import cut_motion, height_m, key_poses, place_motion

LEVELS: tuple[PoseNoise, ...] = ("mocap", "estimated", "estimated-blurry")
ROWS = {
    "given": (0.0, 0.0),
    "joints": (1.0, 0.0),
    "place": (0.0, SMOOTHED_PLACE),
    "both": (1.0, SMOOTHED_PLACE),
}
"""Shares of what is expected to be new in every key that are believed: of joints, of the place."""


@dataclass(frozen=True, eq=False)
class Case:
    """Key poses with errors, and the true ones."""

    given: BodyTrack
    true: BodyTrack
    trained: Bool[np.ndarray, " P"]
    """Keys of training frames."""
    camera: Camera


def case(settings: StageSettings, level: PoseNoise, told: float) -> Case:
    """What `stage` writes of a body with errors of a level, which say ``told`` times theirs."""
    frames, fps = settings.frames, settings.fps
    assert frames is not None  # a draw says how many
    character = load_character(find_character(settings.character))
    cut = cut_motion(load_motion(find_motion(settings.motion)), settings.start_s, frames / fps)
    track = place_motion(cut, character, yaw_deg=settings.yaw_deg, in_place=settings.in_place)
    times = frame_times(frames, fps, settings.exposure_ms, settings.subframe_hz)
    mids_us = np.array([each.mid_us for each in times])
    true, camera = key_poses(track, mids_us), make_camera(MAIN, *settings.size)
    x, y, z = camera.world_to_camera[2, :3].tolist()
    body, share = track.body, POSE_ERRORS[level]
    poses, transl, _, noise = poses_off_by(
        body, *true, mids_us, share * height_m(body), seed=settings.seed, view=(x, y, z)
    )
    errors = noise_errors(body, noise, len(poses), POSE_SOURCE[level], view=(x, y, z))
    said = PoseErrors(errors.source, told * errors.joint_rad, told * errors.root_m)
    trained = np.array([default_split(index) == "train" for index in range(frames)])
    given = BodyTrack(body, mids_us, poses, transl, errors=said)
    return Case(given, BodyTrack(body, mids_us, *true), trained, camera)


def smooth(track: BodyTrack, of_joints: float, of_place: float) -> BodyTrack:
    """As training does, with shares as in `ROWS`."""
    joint_rad, root_m = expected_errors(track)
    shares = {"of_joints": of_joints, "of_place": of_place}
    return smoothed_by_expected(track, joint_rad[None], root_m[None], **shares)


def corrected(case: Case, track: BodyTrack, seen: float, seed: int) -> BodyTrack:
    """By the true turns at training keys, told with an error of ``seen`` of what is expected."""
    joint_rad, root_m = expected_errors(track)
    weights = Correction(track, joint_rad, root_m).weights(track.times_us.tolist()).double().numpy()
    known = weights[case.trained]
    noisy = known @ known.T + seen**2 * np.eye(len(known))
    carry = weights @ known.T @ np.linalg.inv(noisy)
    rng = np.random.default_rng(seed)
    given, true = (Rotation.from_rotvec(t.poses.reshape(-1, 3)) for t in (track, case.true))
    turns = (given.inv() * true).as_rotvec().reshape(track.poses.shape)
    turns += seen * joint_rad[:, None] * rng.normal(size=turns.shape)
    shifts = case.true.transl - track.transl + seen * root_m * rng.normal(size=track.transl.shape)
    found = np.einsum("ts,sjc->tjc", carry, turns[case.trained]) * (joint_rad > 0)[:, None]
    turned = (given * Rotation.from_rotvec(found.reshape(-1, 3))).as_rotvec()
    poses = nearest_axis_angle(turned.reshape(track.poses.shape))
    return BodyTrack(track.body, track.times_us, poses, track.transl + carry @ shifts[case.trained])


def held_out_px(case: Case, track: BodyTrack) -> float:
    """Mean distance of the joints from the true ones at held-out keys."""
    times = track.times_us[~case.trained].tolist()
    ours, theirs = (case.camera.project(joints(t, times).float())[0] for t in (track, case.true))
    return float((ours - theirs).norm(dim=-1).mean())


def main() -> None:
    """Measure each motion and level, and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--captures", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--frames", type=int, default=32)
    parser.add_argument("--told", type=float, default=1.0)
    parser.add_argument("--seen", type=float, default=0.3)
    options = parser.parse_args()
    torch.set_num_threads(1)
    print(f"{'held-out px, corrected':42}" + "".join(f"{row:>8}" for row in ROWS))
    found = []
    for drawn in drawn_settings(Draw(options.seed, options.captures, options.frames)).values():
        for level in LEVELS:
            one = case(drawn, level, options.told)
            tracks = (smooth(one.given, *shares) for shares in ROWS.values())
            seen = [corrected(one, track, options.seen, drawn.seed) for track in tracks]
            found.append([held_out_px(one, track) for track in seen])
            name = f"{drawn.character} {drawn.motion} {drawn.fps:g} {level}"
            print(f"{name:42}" + "".join(f"{px:8.3f}" for px in found[-1]), flush=True)
    ratio = np.array(found) / np.array(found)[:, :1]
    figures = {
        row: {"mean_ratio": round(mean, 3), "worst_ratio": round(worst, 3)}
        for row, mean, worst in zip(
            ROWS, ratio.mean(0).tolist(), ratio.max(0).tolist(), strict=True
        )
    }
    print(json.dumps({"seed": options.seed, "told": options.told, **figures}))


if __name__ == "__main__":
    main()
