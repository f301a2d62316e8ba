import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from evsplat.render import Splats, render


def brute_force(splats, camera, background):
    """Compositing of one time in numpy, pixel by pixel, from the rules and not the code.

    The Jacobian comes from finite differences of the projection, so Gaussians must lie inside the
    enlarged field of view, where it is not clamped.
    """
    view = camera.world_to_camera.numpy().astype(np.float64)
    K = camera.K.numpy().astype(np.float64)
    quaternions = splats.quaternions.numpy().astype(np.float64)
    to_camera, shift = view[:3, :3], view[:3, 3]

    def project(point):
        u = K @ (to_camera @ point + shift)
        return u[:2] / u[2]

    drawn = []
    for i, mean in enumerate(splats.means[0].numpy().astype(np.float64)):
        depth = (to_camera @ mean + shift)[2]
        if depth < 0.01:
            continue
        steps = 1e-6 * np.eye(3)
        jacobian = np.stack([(project(mean + d) - project(mean - d)) / 2e-6 for d in steps], -1)
        shape = Rotation.from_quat(quaternions[i], scalar_first=True).as_matrix()
        shape = shape @ np.diag(splats.scales[i].double().numpy())
        if splats.linear is not None:
            shape = splats.linear[0, i].double().numpy() @ shape
        covariance = jacobian @ shape @ shape.T @ jacobian.T + 0.3 * np.eye(2)
        drawn.append((depth, i, project(mean), np.linalg.inv(covariance)))
    drawn.sort(key=lambda item: item[:2])

    channels = splats.channels[0].double().numpy()
    image = np.zeros((camera.height, camera.width, channels.shape[1]))
    alphas = np.zeros((camera.height, camera.width))
    for y in range(camera.height):
        for x in range(camera.width):
            light, left = np.zeros(channels.shape[1]), 1.0
            for _, i, center, precision in drawn:
                d = np.array([x + 0.5, y + 0.5]) - center
                alpha = min(0.999, splats.opacities[i].item() * np.exp(-0.5 * d @ precision @ d))
                if alpha < 1 / 255:
                    continue
                if left * (1 - alpha) <= 1e-4:
                    break
                light += left * alpha * channels[i]
                left *= 1 - alpha
            image[y, x] = light + left * background
            alphas[y, x] = 1 - left
    return image, alphas


@pytest.mark.parametrize("seed", range(3))
def test_reference_equals_brute_force_compositing(seed, random_scene):
    splats, camera = random_scene(seed, count=60, width=21, height=18, linear=seed == 2)
    # Keep what is inside the field of view or behind the camera (see brute_force).
    pose = camera.world_to_camera
    local = splats.means[0] @ pose[:3, :3].T + pose[:3, 3]
    pixel = (local[:, :2] / local[:, 2:]) @ camera.K[:2, :2].T + camera.K[:2, 2]
    inside = (pixel > -2).all(-1) & (pixel < torch.tensor([23, 20])).all(-1)
    keep = inside | (local[:, 2] < 0)
    assert inside.sum() > 20 and (local[:, 2] < 0).sum() > 1
    splats = Splats(
        splats.means[:, keep].double(),
        splats.quaternions[0, keep].double(),
        splats.scales[0, keep].double(),
        splats.opacities[0, keep].double(),
        splats.channels[:, keep].double(),
        None if splats.linear is None else splats.linear[:, keep].double(),
    )
    background = torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64)
    out = render(splats, camera, background=background, backend="reference")
    image, alpha = brute_force(splats, camera, background.numpy())
    # Finite differences of the projection leave about 1e-8.
    np.testing.assert_allclose(out.image[0].numpy(), image, atol=1e-6)
    np.testing.assert_allclose(out.alpha[0].numpy(), alpha, atol=1e-6)


def test_reference_gradients_equal_finite_differences():
    """On a scene where no pixel is near a threshold, in float64."""
    generator = torch.Generator().manual_seed(5)

    def random(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    K = torch.tensor([[20.0, 0, 3.0], [0, 22.0, 2.5], [0, 0, 1]])
    means = torch.cat([random(2, 4, 2) - 0.5, 2 + random(2, 4, 1)], -1) * 0.3
    means[..., 2] += 1
    inputs = [
        means,
        torch.randn(4, 4, generator=generator, dtype=torch.float64),
        0.25 + 0.1 * random(4, 3),
        0.2 + 0.4 * random(4),
        random(2, 4, 2),
        torch.eye(3, dtype=torch.float64) + 0.1 * random(2, 4, 3, 3),
        0.1 * random(2, 4, 2),
        random(5, 6, 2),
        torch.eye(4, dtype=torch.float64) + 0.02 * random(4, 4),
    ]

    def function(*values):
        *splats, background, pose = values
        camera = _Camera(6, 5, K, pose)
        out = render(
            Splats(*splats),
            camera,
            background=background,
            backend="reference",
        )
        return out.image, out.alpha

    for value in inputs:
        value.requires_grad_()
    assert torch.autograd.gradcheck(function, inputs, eps=1e-6, atol=1e-7, rtol=1e-5)


class _Camera:
    def __init__(self, width, height, K, pose):
        self.width, self.height, self.K, self.world_to_camera = width, height, K, pose
