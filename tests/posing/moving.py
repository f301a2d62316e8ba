"""A made-up motion of the body that ships, and landmarks of it without error."""

import numpy as np
import torch

from evsplat.body import make_body
from evsplat.body.smpl_skeleton import NAMES, PARENTS, approximate_rest_joints
from evsplat.camera import Camera
from evsplat.landmarks import BLAZEPOSE_33, Landmarks
from evsplat.posing.kinematics import SIZE, Points, pose, row_slice
from evsplat.posing.prior import pose_prior
from evsplat.posing.rig import attach, default_rig

CAMERA = Camera(
    256,
    256,
    torch.tensor([[300.0, 0, 128], [0, 300, 128], [0, 0, 1]]),
    torch.tensor([[1.0, 0, 0, 0], [0, 0, -1, 0.2], [0, 1, 0, 3.5], [0, 0, 0, 1]]),
)
"""Looks along y at somebody who faces it; z is up."""
SPAN_US = (0, 800_000)


def motion(times_us: np.ndarray) -> torch.Tensor:
    """Vectors of a person who swings an arm and a knee and walks a little."""
    times = torch.as_tensor(np.asarray(times_us), dtype=torch.float64) * 1e-6
    vectors = torch.zeros(len(times), SIZE, dtype=torch.float64)
    vectors[:, 0] = vectors[:, 4] = 1.0
    vectors[:, 6], vectors[:, 8] = 0.2 * times, 0.05 * torch.sin(4 * times)
    vectors[:, 9:] = pose_prior().mean
    vectors[:, row_slice("left_upper_arm").start + 1] += 0.5 * torch.sin(5 * times)
    vectors[:, row_slice("right_shin").start] += 0.3 + 0.2 * torch.sin(4 * times)
    return vectors


def landmarks(count: int = 24, *, noise_px: float = 0.0, world: bool = True) -> Landmarks:
    """BlazePose's points of `motion` at ``count`` times."""
    rig = default_rig()
    times = np.linspace(*SPAN_US, count).round().astype(np.int64)
    posed = pose(rig, motion(times), torch.zeros(10, dtype=torch.float64))
    attached = attach(rig, BLAZEPOSE_33)
    places = Points(attached.origin, attached.turner, attached.offset).of(posed)
    pixels = CAMERA.project(places)[0].numpy()
    pixels = pixels + noise_px * np.random.default_rng(0).normal(size=pixels.shape)
    in_camera = (places @ CAMERA.world_to_camera[:3, :3].double().T).numpy()
    hips = [BLAZEPOSE_33.index(f"{side}_hip") for side in ("left", "right")]
    return Landmarks(
        times,
        pixels,
        np.full(pixels.shape[:2], 1.0),
        np.ones(pixels.shape[:2]),
        in_camera - in_camera[:, hips].mean(1, keepdims=True) if world else None,
        BLAZEPOSE_33,
    )


def stick_figure(betas: np.ndarray):
    """SMPL's skeleton with a triangle at each joint as its mesh."""
    joints = approximate_rest_joints() * (1 + 0.1 * betas[0])
    corners = joints[:, None] + 0.02 * np.eye(3)
    faces = np.arange(3 * len(joints)).reshape(-1, 3)
    weights = np.repeat(np.eye(len(joints)), 3, 0)
    return make_body(corners.reshape(-1, 3), faces, weights, np.array(PARENTS), joints, NAMES)[0]
