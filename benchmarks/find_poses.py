"""Errors of found body poses against the truth, by stage: landmarks, fit, refinement.

    python benchmarks/find_poses.py CAPTURE … [--held-out-events] [--without-events] [--refine]
                                              [--keypoints-px 2] [--out FOLDER] [--threads 1]

Per capture and stage the mean distance of 14 joints in pixels (through the frame's camera), in
millimetres about the pelvis (MPJPE), and after a similarity per frame (PA-MPJPE), at the times of
training and of held-out frames apart; the share of the given poses' overlap with the masks that
the found ones reach; seconds. The stature is taken from the truth, the pose prior leaves the
capture's motion out. ``px_moving`` is what is left of the pixels where each joint is allowed a
place of its own on the bone that ends there: skeletons differ in where they have hips and knees,
and that is no error of a pose. These places are learned at training times. ``--without-events``
takes the events away. With ``--keypoints-px`` the motion is fitted to the true joints in the middle
of training exposures, off by that many pixels of noise per axis, in place of landmarks, as
`evsplat poses --keypoints FILE` is. With ``--out`` the poses of each stage are written as captures
NAME_STAGE. The last line is all of it as JSON.
"""

import argparse
import json
import tempfile
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

from evsplat.body import BodyTrack
from evsplat.body.make import rig_arrays
from evsplat.body.skeleton import find_skeleton
from evsplat.camera import Camera
from evsplat.capture import Capture, Policy, load_body_track, load_capture
from evsplat.capture.derive import derived_capture
from evsplat.errors import DataError
from evsplat.inspection import body_mask_overlap
from evsplat.landmarks import (
    COCO_17,
    LandmarkNetwork,
    Landmarks,
    find_landmarks,
    sharp_pictures,
)
from evsplat.posing.bridging import bridged
from evsplat.posing.find import key_times
from evsplat.posing.fit import FitSettings, PoseFit, fit_landmarks
from evsplat.posing.prior import pose_prior
from evsplat.posing.refine import FOUND_STEPS, refine

PARTS = [f"{s}_{p}" for p in ("upper_arm", "forearm", "hand", "thigh", "shin", "foot")
         for s in ("left", "right")]  # fmt: skip
LANDMARKS = [f"{s}_{p}" for p in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
             for s in ("left", "right")]  # fmt: skip
"""Landmarks named after the joints of `PARTS`."""
PLACE_M = 0.03
"""How far skeletons differ in where they have a joint."""


def main() -> None:
    """Measure the captures that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--held-out-events", action="store_true")
    parser.add_argument("--without-events", action="store_true")
    parser.add_argument("--refine", action="store_true", help="correct fits by drawing the person")
    parser.add_argument("--keypoints-px", type=float)
    parser.add_argument("--out", type=Path, help="folder for captures with the poses found")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    policy = Policy(held_out_events=options.held_out_events)
    results = []
    for path in options.captures:
        with tempfile.TemporaryDirectory() as spare:
            capture = load_capture(path)
            if options.without_events:
                capture = blurry_alone(capture, Path(spare) / path.name)
            results += measure(capture, policy, options.keypoints_px, options.refine, options.out)
    print(json.dumps({"policy": asdict(policy), "rows": results}))


def blurry_alone(capture: Capture, folder: Path) -> Capture:
    """The same recording without its events."""
    with derived_capture(capture, folder) as making:
        making.document["events"] = None
    return load_capture(folder)


def measure(
    capture: Capture, policy: Policy, keypoints_px: float | None, refined: bool, out: Path | None
) -> list[dict]:
    """A row per stage, whose poses are written to ``out``."""
    seen = capture.for_training(policy)
    truth = load_body_track(capture, dense=capture.dense_body_file is not None)
    extent = truth.body.rest_vertices.amax(0) - truth.body.rest_vertices.amin(0)
    settings = FitSettings(height_m=float(extent.max()))
    motion = str(capture.provenance.get("motion", ""))
    try:
        prior = pose_prior(without=(motion,))
    except DataError:
        prior = pose_prior()
    rows: list[dict] = []
    start = time.perf_counter()
    pictures = sharp_pictures(seen)
    if keypoints_px is None:
        points = find_landmarks(seen, pictures, network=LandmarkNetwork(), progress=False)
        found_s = time.perf_counter() - start
        errors = landmark_errors(capture, truth, points)
        rows.append({"stage": "landmarks", "seconds": found_s, **errors})
        stage = "fit"
    else:
        points = true_keypoints(capture, truth, keypoints_px)
        stage = "fit to true joints"
    start = time.perf_counter()
    cameras = [capture.camera(nearest(capture, t)) for t in points.times_us.tolist()]
    span = capture.frames[0].exposure_us[0], max(f.exposure_us[1] for f in capture.frames)
    fitted = fit_landmarks(points, cameras, span, settings=settings, prior=prior)
    track = bridged(fitted.track(key_times(seen)), points.times_us.tolist())
    seconds = time.perf_counter() - start
    rows.append({"stage": stage, "seconds": seconds, **pose_errors(capture, truth, track)})
    tracks = {stage: track}
    dressed = None
    if refined:
        better = refine(track, seen, steps=FOUND_STEPS)
        corrected = bridged(better.track, [picture.time_us for picture in pictures])
        dressed = corrected.with_body(better.dressed)
        errors = pose_errors(capture, truth, corrected) | dressed_overlap(capture, truth, dressed)
        rows.append({"stage": f"{stage}, refined", "seconds": better.seconds, **errors})
        tracks[f"{stage}, refined"] = dressed
    if out is not None:
        for name, one in tracks.items():
            folder = out / f"{capture.name}_{name.replace(', ', '_')}"
            write(capture, folder, one, fitted, drawn=one is dressed)
    for row in rows:
        row["capture"] = capture.name
        shown = {k: round(v, 2) if isinstance(v, float) else v for k, v in row.items()}
        print("  ".join(f"{key} {value}" for key, value in shown.items()), flush=True)
    return rows


def write(
    capture: Capture, folder: Path, track: BodyTrack, fitted: PoseFit, *, drawn: bool
) -> None:
    """A capture with found poses, and what they are expected to err by, in place of its own.

    Of those that were corrected by drawing the person it says so, and the body is dressed, as by
    `evsplat poses`.
    """
    assert track.errors is not None
    with derived_capture(capture, folder, replace=True) as making:
        making.set_body(
            "rig" if drawn else fitted.rig.model,
            track.times_us,
            track.poses,
            track.transl,
            betas=None if drawn else fitted.betas,
            rig=rig_arrays(track.body) if drawn else None,
            source="estimated",
            pose_std_rad=track.errors.joint_rad,
            transl_std_m=track.errors.root_m,
        )
        if drawn:
            making.document["provenance"] = {**capture.provenance, "poses": {"refinement": {}}}


def pose_errors(capture: Capture, truth: BodyTrack, track: BodyTrack) -> dict:
    """Errors at mid-exposures, training and held-out apart, and overlap with the masks."""
    values: dict = {}
    lasting = torch.zeros(len(PARTS) + 2, 3).double()
    for split, frames in (("train", capture.train_frames), ("test", capture.test_frames)):
        if not frames:
            continue
        times = [frame.mid_us for frame in frames]
        true, found = (joints(one, times) for one in (truth, track))
        cameras = [capture.camera(frame) for frame in frames]
        off = torch.stack(
            [
                c.project(a)[0] - c.project(b)[0]
                for c, a, b in zip(cameras, true, found, strict=True)
            ]
        ).double()
        values[f"{split}_px"] = float(off.norm(dim=-1).mean())
        rates = offset_rates(track, times, cameras)
        if split == "train":
            lasting = lasting_offsets(off, rates)
        moving = off - torch.einsum("tjac,jc->tja", rates, lasting)
        values[f"{split}_px_moving"] = float(moving.norm(dim=-1).mean())
        a, b = true.double().numpy(), found.double().numpy()
        centred = [one - one[:, 6:8].mean(1, keepdims=True) for one in (a, b)]
        values[f"{split}_mpjpe"] = 1000 * float(
            np.linalg.norm(centred[0] - centred[1], axis=-1).mean()
        )
        aligned = np.stack([similar(one, to) for one, to in zip(b, a, strict=True)])
        values[f"{split}_pa"] = 1000 * float(np.linalg.norm(aligned - a, axis=-1).mean())
        given = body_mask_overlap(capture, truth, frames)
        if given:
            own = body_mask_overlap(capture, track, frames)
            values[f"{split}_iou"] = float(np.mean(own))
            values[f"{split}_iou_share"] = float(np.mean(own) / np.mean(given))
    if track.errors is not None:
        values["sure"] = calibration(truth, track)
    return values


def dressed_overlap(capture: Capture, truth: BodyTrack, dressed: BodyTrack) -> dict:
    """Overlap of the dressed body with the masks, as a share of what the given bare one reaches."""
    errors = pose_errors(capture, truth, dressed)
    return {f"dressed_{key}": value for key, value in errors.items() if key.endswith("iou_share")}


def calibration(truth: BodyTrack, track: BodyTrack) -> float:
    """Root mean square of limb errors over the standard deviations told: 1 where they are right.

    Only for tracks of the same joints.
    """
    if truth.body.joint_names != track.body.joint_names or track.errors is None:
        return float("nan")
    true, _ = truth.at(track.times_us.tolist())
    own, _ = track.at(track.times_us.tolist())
    trace = (true.mT @ own).diagonal(dim1=-2, dim2=-1).sum(-1)
    angle = ((trace - 1) / 2).clamp(-1, 1).arccos().numpy()
    skeleton = find_skeleton(truth.body.parents.tolist(), truth.body.joint_names)
    limbs = [skeleton.limbs[part] for part in PARTS if "hand" not in part]
    told = track.errors.joint_rad[:, limbs]
    return float(np.sqrt(np.mean(angle[:, limbs] ** 2 / 3) / np.mean(told**2)))


def landmark_errors(capture: Capture, truth: BodyTrack, landmarks: Landmarks) -> dict:
    """Mean distance of twelve landmarks from the joints that they are named after."""
    true = joints(truth, landmarks.times_us.tolist())[:, :12]
    rows = [row for name in LANDMARKS if (row := landmarks.index(name)) is not None]
    own = torch.from_numpy(landmarks.places[:, rows])
    frames = [nearest(capture, int(time)) for time in landmarks.times_us]
    pixels = [capture.camera(f).project(place)[0] for f, place in zip(frames, true, strict=True)]
    off = (torch.stack(pixels).double() - own).norm(dim=-1).mean(1)
    held = torch.tensor([frame.split != "train" for frame in frames])
    values = {"pictures": len(frames), "train_px": float(off[~held].mean())}
    return values | ({"test_px": float(off[held].mean())} if held.any() else {})


def true_keypoints(capture: Capture, truth: BodyTrack, noise_px: float) -> Landmarks:
    """The joints' true places in training pictures as COCO's key points, the face not seen."""
    frames = sorted(capture.train_frames, key=lambda frame: frame.mid_us)
    times_us = np.array([frame.mid_us for frame in frames])
    true = joints(truth, times_us.tolist())[:, :12]
    pixels = [capture.camera(f).project(place)[0] for f, place in zip(frames, true, strict=True)]
    places = np.zeros((len(frames), len(COCO_17), 2))
    seen = np.zeros(places.shape[:2])
    index = [COCO_17.index(name) for name in LANDMARKS]
    noise = noise_px * np.random.default_rng(0).normal(size=(len(frames), 12, 2))
    places[:, index] = torch.stack(pixels).numpy() + noise
    seen[:, index] = 1
    sigma = np.full(seen.shape, noise_px)
    return Landmarks(times_us, places, sigma, seen, None, COCO_17)


def lasting_offsets(off: torch.Tensor, rates: torch.Tensor) -> torch.Tensor:
    """An offset of each joint in the frame of its parent (14, 3), metres, the same at all times.

    What explains best, by least squares, how far pixels are ``off`` (T, 14, 2). `PLACE_M` of it
    cost as much as an error of one pixel in one picture. ``rates``: `offset_rates`.
    """
    square = torch.einsum("tjac,tjad->jcd", rates, rates) + torch.eye(3).double() / PLACE_M**2
    return torch.linalg.solve(square, torch.einsum("tjac,tja->jc", rates, off))


def offset_rates(track: BodyTrack, times_us: list[int], cameras: list[Camera]) -> torch.Tensor:
    """Derivatives (T, 14, 2, 3) of the joints' pixels by offsets in the frames of their parents."""
    moved = track.body.joint_transforms(*track.at(times_us))
    index = joint_index(track)
    above = track.body.parents[index].clamp_min(0)
    by_place = torch.stack(
        [
            torch.stack([pixel_rate(camera, place) for place in places])
            for camera, places in zip(cameras, moved[:, index, :3, 3], strict=True)
        ]
    )
    return (by_place @ moved[:, above, :3, :3]).double()


def pixel_rate(camera: Camera, place: torch.Tensor) -> torch.Tensor:
    """Derivative (2, 3) of the pixel of a place in the world."""
    return torch.autograd.functional.jacobian(lambda p: camera.project(p[None])[0][0], place)


def joint_index(track: BodyTrack) -> list[int]:
    """The 14 joints that are measured: those of `PARTS`, neck and head."""
    skeleton = find_skeleton(track.body.parents.tolist(), track.body.joint_names)
    return [*(skeleton.limbs[part] for part in PARTS), skeleton.neck[0], skeleton.neck[-1]]


def joints(track: BodyTrack, times_us: list[int]) -> torch.Tensor:
    """Places of `joint_index` in the world."""
    places = track.body.joint_transforms(*track.at(times_us))[..., :3, 3]
    return places[:, joint_index(track)]


def similar(points: np.ndarray, to: np.ndarray) -> np.ndarray:
    """The points moved, turned and scaled to lie as near as they can (Umeyama 1991)."""
    a, b = points - points.mean(0), to - to.mean(0)
    u, s, v = np.linalg.svd(a.T @ b)
    sign = np.array([1, 1, np.sign(np.linalg.det(u @ v))])
    return (s * sign).sum() / (a**2).sum() * a @ (u * sign @ v) + to.mean(0)


def nearest(capture: Capture, time_us: int):
    """The frame whose mid-exposure is nearest."""
    return min(capture.frames, key=lambda frame: abs(frame.mid_us - time_us))


if __name__ == "__main__":
    main()
