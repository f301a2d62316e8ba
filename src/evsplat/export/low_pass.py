"""Gaussians for viewers whose low-pass is another than ours."""

from dataclasses import replace

import numpy as np
import torch

from evsplat.body.rotations import quaternion_to_matrix
from evsplat.capture import Camera
from evsplat.export.cloud import SplatCloud, principal_axes

VIEWERS_LOW_PASS = 0.05
"""px^2 that files are made for. Viewers in browsers add 0.075 as a rule (0.3, in half pixels): with
less, files look right at the recording's size still, and more solid in the larger ones of windows.
"""
LEAST_VARIANCE_SHARE = 0.7
"""Share of a Gaussian's variance in the picture that is left at least, so that it stays solid."""
_BEYOND = 0.15
"""Share of the picture around it within which the Jacobian of the rasteriser is not clamped."""
_NEAR_M = 0.01


def for_viewer(cloud: SplatCloud, camera: Camera, own: float, viewer: float) -> SplatCloud:
    """The cloud that a renderer adding ``viewer`` px^2 draws as one adding ``own`` draws ``cloud``.

    With P = J W, the projection (2, 3) of EWA splatting at a Gaussian's centre, its covariance in
    the picture is S = P C P^T. Each eigenvalue s of S becomes ``s + own - viewer``, at least
    `LEAST_VARIANCE_SHARE` of s, by a symmetric T with the eigenvectors of S. ``A = I + P^+ (T - I)
    P`` gives P A = T P, hence P (A C A^T) P^T = T S T^T without remainder; A leaves the direction
    of view alone. Where the floor binds the opacity loses what the area gains: the ratio
    ``sqrt(det(S + own I) / det(S' + viewer I))``. Gaussians behind the camera or far outside the
    picture stay as they are. px^2 at the size of ``camera``.
    """
    if own == viewer or len(cloud) == 0:
        return cloud
    projection, inside = _projections(cloud, camera)
    axes = _axes(cloud)[inside]
    flat = projection @ axes
    variances, vectors = np.linalg.eigh(flat @ flat.transpose(0, 2, 1))
    variances = np.maximum(variances, 1e-12)
    wanted = np.maximum(variances + own - viewer, LEAST_VARIANCE_SHARE * variances)
    change = (vectors * (np.sqrt(wanted / variances) - 1)[:, None, :]) @ vectors.transpose(0, 2, 1)
    moved = axes + np.linalg.pinv(projection) @ change @ flat
    share = np.sqrt(((variances + own) / (wanted + viewer)).prod(1))
    quaternions, scales = cloud.quaternions.copy(), cloud.scales.copy()
    opacities = cloud.opacities.copy()
    quaternions[inside], scales[inside] = principal_axes(torch.from_numpy(moved))
    opacities[inside] = np.clip(opacities[inside] * share, 0, 1)
    return replace(cloud, quaternions=quaternions, scales=scales, opacities=opacities)


def _projections(cloud: SplatCloud, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """J W (M, 2, 3) of the Gaussians that the camera sees or nearly sees, and which they are."""
    pose, K = camera.world_to_camera.cpu().double().numpy(), camera.K.cpu().double().numpy()
    points = cloud.means.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
    depth = np.maximum(points[:, 2], _NEAR_M)
    pixels = ((points / depth[:, None]) @ K.T)[:, :2]
    size = np.array([camera.width, camera.height])
    inside = points[:, 2] > _NEAR_M
    inside &= ((pixels > -_BEYOND * size) & (pixels < (1 + _BEYOND) * size)).all(1)
    rays, depth = points[inside] / depth[inside, None], depth[inside]
    jacobian = np.zeros((len(depth), 3, 3))
    jacobian[:, [0, 1], [0, 1]] = 1
    jacobian[:, :2, 2] = -rays[:, :2]
    return (K @ jacobian)[:, :2] / depth[:, None, None] @ pose[:3, :3], inside


def _axes(cloud: SplatCloud) -> np.ndarray:
    """R S (N, 3, 3), whose square is the covariance."""
    rotations = quaternion_to_matrix(torch.from_numpy(cloud.quaternions).double())
    return rotations.numpy() * cloud.scales.astype(np.float64)[:, None, :]
