"""What `evsplat.posing.refine` makes of poses with errors, without any training.

    python benchmarks/pose_refinement.py [--characters woman worker] [--motions punch spin ...]
        [--levels none estimated estimated-blurry] [--frames 24] [--size 128] [--hide-held-out]
        [--out FOLDER]

Stages each character in each motion with errors of each level (captures that FOLDER holds already
are taken as they are), corrects the poses and compares 14 joints with the true ones at 5, 50 and
95 % of every exposure: mean distance in the world (mm) and in the picture (px), and about the
middle of the hips (relative mm), of training and of held-out frames apart. The poses that were
`kept` are the corrected ones only where the pictures were explained better. With
``--hide-held-out`` events of held-out times are not seen. The last line is one JSON object.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

import evsplat as ev
from evsplat.body import BodyTrack
from evsplat.body.skeleton import find_skeleton
from evsplat.capture import Capture, load_body_track, load_capture
from evsplat.capture.policy import Policy
from evsplat.posing.refine import refine

PARTS = ("thigh", "shin", "foot", "upper_arm", "forearm", "hand")
FRACTIONS = (0.05, 0.5, 0.95)


def joints(track: BodyTrack, times_us: list[int]) -> Float[Tensor, "T 14 3"]:
    """Both hips first, then the other joints of `PARTS`, neck and head; metres."""
    body = track.body
    skeleton = find_skeleton(body.parents.tolist(), body.joint_names)
    chosen = [skeleton.limbs[f"{side}_{part}"] for part in PARTS for side in ("left", "right")]
    chosen += [skeleton.neck[0], skeleton.neck[-1]]
    rotations, transl = track.at(times_us)
    return body.joint_transforms(rotations.double(), transl.double())[:, chosen, :3, 3]


def errors(track: BodyTrack, capture: Capture) -> dict[str, float]:
    """Mean distances to the true joints, of training and held-out frames."""
    true = load_body_track(capture, dense=True)
    found: dict[str, float] = {}
    for split in ("train", "test"):
        frames = [frame for frame in capture.frames if frame.split == split]
        times = [
            round(start + share * (end - start))
            for start, end in (frame.exposure_us for frame in frames)
            for share in FRACTIONS
        ]
        ours, theirs = joints(track, times), joints(true, times)
        camera = capture.camera(frames[0])
        px = (camera.project(ours)[0] - camera.project(theirs)[0]).norm(dim=-1)
        about = [places - places[:, :2].mean(1, keepdim=True) for places in (ours, theirs)]
        found |= {
            f"{split}_mm": 1e3 * float((ours - theirs).norm(dim=-1).mean()),
            f"{split}_relative_mm": 1e3 * float((about[0] - about[1]).norm(dim=-1).mean()),
            f"{split}_px": float(px.mean()),
        }
    return {name: round(value, 3) for name, value in found.items()}


def told_ratio(track: BodyTrack, capture: Capture) -> float:
    """Error of the root's place, root mean square, over what the track says of it: 1 is right.

    Most of it is one distance from the camera, so a single capture tells it roughly.
    """
    assert track.errors is not None
    true = load_body_track(capture, dense=True).at(track.times_us.tolist())[1]
    off = track.at(track.times_us.tolist())[1] - true
    told = np.square(track.errors.root_m).sum(1).mean()
    return float(np.sqrt(off.square().sum(1).mean() / told))


def told_limbs(track: BodyTrack, capture: Capture) -> float:
    """Errors of the limbs' turns, root mean square, over what the track says of them."""
    assert track.errors is not None
    skeleton = find_skeleton(track.body.parents.tolist(), track.body.joint_names)
    limbs = [skeleton.limbs[f"{side}_{part}"] for part in PARTS for side in ("left", "right")]
    true, own = (
        one.at(track.times_us.tolist())[0] for one in (load_body_track(capture, dense=True), track)
    )
    trace = (true.mT @ own).diagonal(dim1=-2, dim2=-1).sum(-1)
    angle = ((trace - 1) / 2).clamp(-1, 1).arccos().numpy()[:, limbs]
    return float(np.sqrt(np.mean(angle**2 / 3) / np.mean(track.errors.joint_rad[:, limbs] ** 2)))


def main() -> None:
    """Stage what is missing, correct, and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--characters", nargs="*", default=["woman", "worker"])
    parser.add_argument("--motions", nargs="*", default=["punch", "run", "spin", "spinkick"])
    parser.add_argument("--levels", nargs="*", default=["none", "estimated", "estimated-blurry"])
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--hide-held-out", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("bench/pose_refinement"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for character in options.characters:
        for motion in options.motions:
            for level in options.levels:
                path = options.out / f"{character}_{motion}_{level}"
                if not path.exists():
                    ev.stage(
                        path,
                        character=character,
                        motion=motion,
                        pose_noise=level,
                        frames=options.frames,
                        width=options.size,
                        novel_views="none",
                        threads=1,
                        progress=False,
                    )
                capture = load_capture(path)
                seen = capture.for_training(Policy(held_out_events=not options.hide_held_out))
                track = load_body_track(seen)
                began = time.process_time()
                refined = refine(track, seen)
                seconds = time.process_time() - began
                before, after = errors(track, capture), errors(refined.track, capture)
                rows.append((level, before, after, after if refined.better else before))
                print(
                    f"{path.name:32} gain {refined.gain:.3f} +- {refined.gain_error:.3f}, "
                    f"{'better' if refined.better else 'not told better'}, {seconds:.0f} s, "
                    f"root off {told_ratio(refined.track, capture):.2f} and limbs "
                    f"{told_limbs(refined.track, capture):.2f} times what they say:",
                    ", ".join(f"{name} {before[name]:.2f} -> {after[name]:.2f}" for name in before),
                    flush=True,
                )
    figures: dict[str, dict[str, float]] = {}
    for level in options.levels:
        own = [row[1:] for row in rows if row[0] == level]
        for name, which in (("given", 0), ("corrected", 1), ("kept", 2)):
            figures[f"{level} {name}"] = {
                key: round(float(np.mean([row[which][key] for row in own])), 3) for key in own[0][0]
            }
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
