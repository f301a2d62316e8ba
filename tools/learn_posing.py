"""Learn what `evsplat poses` knows of people: the pose prior, and where BlazePose's points sit.

    python tools/learn_posing.py prior
    python tools/learn_posing.py offsets CAPTURE=LANDMARKS.npz ...

The prior comes from the motions that ship, retargeted to the body that ships; statistics are kept
per motion, so that one can be left out. The offsets come from staged captures with their landmarks
(`evsplat.landmarks.Landmarks`, saved with its fields as arrays), of training frames alone: the file
that ships was learned from nine captures of 128 pixels drawn at random (`evsplat.benching.drawn`;
seed 5117 numbers 0, 2, 4, 6; 6203 numbers 0, 2, 4; 8819 numbers 0, 2; 18 to 20 frames each): man
three times, woman four times, worker twice.
"""

import argparse
import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from evsplat.body import BodyTrack, default_body
from evsplat.body.motion import load_motion
from evsplat.body.retarget import retarget
from evsplat.body.skeleton import find_skeleton
from evsplat.camera import Camera
from evsplat.capture import load_body_track, load_capture
from evsplat.posing.prior import statistics
from evsplat.posing.rig import ROWS

DATA = Path(__file__).parent.parent / "src" / "evsplat" / "data"
ATTACHED = {
    **{name: ("head", "head") for name in ("nose", "left_ear", "mouth_left")},
    **{f"left_eye{part}": ("head", "head") for part in ("_inner", "", "_outer")},
    "left_shoulder": ("left_upper_arm", "chest"),
    "left_elbow": ("left_forearm", "left_upper_arm"),
    **{"left_wrist": ("left_hand", "left_forearm"), "left_hip": ("left_thigh", "root")},
    **{f"left_{part}": ("left_hand", "left_hand") for part in ("pinky", "index", "thumb")},
    **{"left_knee": ("left_shin", "left_thigh"), "left_ankle": ("left_foot", "left_shin")},
    **{f"left_{part}": ("left_foot", "left_foot") for part in ("heel", "foot_index")},
}  # fmt: skip
"""Landmark to the part at whose joint it sits and the part that turns it; the right mirrors it."""
SMOOTH_M, PRIOR_M = 0.02, 0.1


def learn_prior() -> None:
    """Write prior.npz."""
    body = default_body()
    skeleton = find_skeleton(body.parents.tolist(), body.joint_names)
    columns = [[skeleton.limbs[name]] for name in ROWS[:-2]] + [skeleton.spine, skeleton.neck]
    table: dict[str, list] = {
        key: [] for key in ("motions", "seconds", "mean", "second", "straightest")
    }
    for path in sorted((DATA / "stage" / "motions").glob("*.txt")):
        motion = load_motion(path)
        poses, _ = retarget(motion, body)
        seconds = (motion.times_us - motion.times_us[0]) * 1e-6
        even = np.arange(0, seconds[-1], 1 / 60)
        rows = np.stack([poses[:, list(joints)].mean(1) for joints in columns], 1)
        flat = rows.reshape(len(rows), -1)
        rows = np.stack([np.interp(even, seconds, column) for column in flat.T], 1)
        mean, second, straightest = statistics(rows.reshape(len(even), -1, 3))
        values = (path.stem, seconds[-1], mean, second, straightest)
        for key, value in zip(table, values, strict=True):
            table[key].append(value)
    arrays = {
        k: np.array(v) if k == "motions" else np.array(v, np.float32) for k, v in table.items()
    }
    np.savez_compressed(DATA / "posing" / "prior.npz", **arrays)


def mirror_name(name: str) -> str:
    """The name of the right side's."""
    return name.replace("left", "right")


def learn_offsets(pairs: list[str]) -> None:
    """Write blazepose.json from ``CAPTURE=LANDMARKS`` pairs."""
    offsets = offsets_of([_observed(*pair.split("=")) for pair in pairs])
    note = "Offsets in metres of BlazePose's points, made by tools/learn_posing.py."
    text = json.dumps({"note": note, "offsets": offsets}, indent=1)
    (DATA / "posing" / "blazepose.json").write_text(text + "\n")


def offsets_of(data: list[Callable[..., np.ndarray]]) -> dict[str, list]:
    """Landmark to part, part that turns it and offset in metres, of `residuals_of` recordings."""
    offsets = {}
    for name, ends in ATTACHED.items():
        sides = [(name, *ends, np.ones(3))]
        if name != "nose":
            sides.append((*map(mirror_name, (name, *ends)), np.array([-1, 1, 1])))
        misfit = partial(_misfit, data, sides)
        found = least_squares(misfit, np.zeros(3), loss="soft_l1").x
        for one, origin, turner, flip in sides:
            offsets[one] = [origin, turner, [round(float(v), 4) for v in found * flip]]
    return offsets


def _misfit(data: list, sides: list, offset: np.ndarray) -> np.ndarray:
    rows = [offset / PRIOR_M * 0.5]
    for one, origin, turner, flip in sides:
        rows += [capture(one, origin, turner, offset * flip) for capture in data]
    return np.concatenate(rows)


def _observed(capture_path: str, landmarks_path: str) -> Callable[..., np.ndarray]:
    capture = load_capture(capture_path)
    track = load_body_track(capture)
    with np.load(landmarks_path) as marks:
        times, places, seen = marks["times_us"], marks["places"], marks["seen"]
        names = list(map(str, marks["names"]))
    return residuals_of(track, capture.camera(capture.frames[0]), times, places, seen, names)


def residuals_of(
    track: BodyTrack,
    camera: Camera,
    times_us: np.ndarray,
    places: np.ndarray,
    seen: np.ndarray,
    names: Sequence[str],
) -> Callable[[str, str, str, np.ndarray], np.ndarray]:
    """By how much landmarks at ``places`` (T, L, 2), pixels, miss a joint with an offset, weighed.

    What is returned takes a landmark's name, the part at whose joint it is tried, the part that
    turns it, and the offset in metres.
    """
    skeleton = find_skeleton(track.body.parents.tolist(), track.body.joint_names)
    joints = {**skeleton.limbs, "root": skeleton.root, "chest": skeleton.chest}
    joints["head"] = skeleton.neck[-1]
    posed = track.body.joint_transforms(*track.at(times_us.tolist())).double().numpy()
    K, world_to_camera = camera.K.double().numpy(), camera.world_to_camera.double().numpy()

    def residuals(name: str, origin: str, turner: str, offset: np.ndarray) -> np.ndarray:
        place = posed[:, joints[origin], :3, 3] + posed[:, joints[turner], :3, :3] @ offset
        seen_from = place @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
        pixels = seen_from @ K.T
        index = names.index(name)
        off = pixels[:, :2] / pixels[:, 2:] - places[:, index]
        metres = off * seen_from[:, 2:] / K[0, 0]
        return (metres * np.clip(seen[:, index, None], 0.05, 1) / SMOOTH_M).ravel()

    return residuals


def main() -> None:
    """Learn one of the two."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    what = parser.add_subparsers(dest="what", required=True)
    what.add_parser("prior", help="the pose prior")
    offsets = what.add_parser("offsets", help="where BlazePose's points sit")
    offsets.add_argument("captures", nargs="+", metavar="CAPTURE=LANDMARKS.npz")
    options = parser.parse_args()
    if options.what == "prior":
        learn_prior()
    else:
        learn_offsets(options.captures)


if __name__ == "__main__":
    main()
