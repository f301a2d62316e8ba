"""Projection and lens distortion, against OpenCV."""

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from evsplat.capture import Camera
from evsplat.capture.distortion import Distortion

WIDTH, HEIGHT = 64, 48
K = np.array([[70.0, 0, 30.5], [0, 66.0, 25.0], [0, 0, 1]])
LENSES = {
    "barrel": (-0.25, 0.06, 0.0, 0.0),
    "pincushion": (0.18, -0.02, 0.004, -0.003, 0.01),
    "rational": (0.3, 0.1, 0.002, 0.001, 0.02, 0.35, 0.05, 0.01),
}
# OpenCV puts pixel centres at whole numbers, we at +0.5
K_OPENCV = K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]


def random_camera(seed: int) -> Camera:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(rng=seed).as_matrix()
    pose[:3, 3] = np.random.default_rng(seed).normal(size=3)
    return Camera(WIDTH, HEIGHT, torch.tensor(K).float(), torch.tensor(pose).float())


def test_point_on_the_axis_meets_the_principal_point() -> None:
    camera = Camera(WIDTH, HEIGHT, torch.tensor(K).float(), torch.eye(4))
    pixels, depth = camera.project(torch.tensor([0.0, 0.0, 2.0]))
    assert pixels.tolist() == [30.5, 25.0] and depth == 2


@pytest.mark.parametrize("seed", range(5))
def test_projection_agrees_with_opencv(seed: int) -> None:
    camera = random_camera(seed)
    in_camera = np.random.default_rng(seed).uniform((-2, -2, 1), (2, 2, 6), (4, 5, 3))
    pose = camera.world_to_camera.double().numpy()
    points = (in_camera - pose[:3, 3]) @ pose[:3, :3]
    rotation = cv2.Rodrigues(pose[:3, :3])[0]
    expected = cv2.projectPoints(points.reshape(-1, 3), rotation, pose[:3, 3], K, None)[0]
    pixels, depth = camera.project(torch.tensor(points))
    assert np.allclose(pixels.numpy(), expected.reshape(4, 5, 2), atol=1e-3)
    assert np.allclose(depth.numpy(), in_camera[..., 2], atol=1e-5)
    assert camera.center().numpy() == pytest.approx(-pose[:3, :3].T @ pose[:3, 3], abs=1e-5)


@pytest.mark.parametrize("step", [1, 2, 5, 7])
def test_a_smaller_camera_sees_points_in_the_squares_of_pixels_that_they_were_in(
    rng: np.random.Generator, step: int
) -> None:
    camera = random_camera(int(rng.integers(1000)))
    in_camera = torch.tensor([[0.3, -0.2, 2.0], [-0.4, 0.1, 1.5]])
    pose = camera.world_to_camera
    points = (in_camera - pose[:3, 3]) @ pose[:3, :3]
    pixels, depth = camera.project(points)
    for whole, size in (
        (True, (WIDTH // step, HEIGHT // step)),
        (False, (-(-WIDTH // step), -(-HEIGHT // step))),
    ):
        small = camera.smaller(step, whole=whole)
        assert (small.width, small.height) == size
        found, same = small.project(points)
        assert torch.allclose(step * found, pixels, atol=1e-4) and torch.allclose(same, depth)
    assert camera.K[0, 0] == 70  # the larger one stays


@pytest.mark.parametrize("lens", LENSES)
def test_distortion_agrees_with_opencv(lens: str) -> None:
    ours = Distortion(WIDTH, HEIGHT, K, LENSES[lens])
    map_x, map_y = cv2.initUndistortRectifyMap(
        K_OPENCV, np.array(LENSES[lens]), None, K_OPENCV, (WIDTH, HEIGHT), cv2.CV_32FC1
    )
    centres = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), axis=-1)
    assert np.allclose(ours.distort(centres) - 0.5, np.stack([map_x, map_y], axis=-1), atol=1e-4)
    image = np.random.default_rng(0).random((HEIGHT, WIDTH, 3)).astype(np.float32)
    expected = cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    # remap rounds positions to 1/32 pixel
    assert np.allclose(ours.undistort_image(image), expected, atol=1.1 / 32 * 2)


@pytest.mark.parametrize("lens", LENSES)
def test_undistort_inverts_distort_as_opencv_does(lens: str) -> None:
    ours = Distortion(WIDTH, HEIGHT, K, LENSES[lens])
    pixels = np.random.default_rng(1).uniform((0, 0), (WIDTH, HEIGHT), (200, 2))
    found = ours.undistort(pixels)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)
    # OpenCV 4 has another name for the one that takes criteria.
    undistort = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)
    expected = undistort(
        pixels[:, None], K, np.array(LENSES[lens]), R=None, P=K, criteria=criteria
    )[:, 0]
    assert np.allclose(found, expected, atol=1e-3)
    assert np.allclose(ours.distort(found), pixels, atol=1e-3)


def test_pixels_that_no_ray_reaches_are_nan() -> None:
    folding = Distortion(WIDTH, HEIGHT, K, (-3.0, 0.0, 0.0, 0.0))
    assert np.isnan(folding.undistort(np.array([[0.5, 0.5]]))).all()
    assert (folding.event_lookup()[0, 0] == -1).all()


def test_event_lookup_follows_the_pictures_pixels() -> None:
    """A bright sensor pixel lands, in the undistorted picture, where the lookup says."""
    ours = Distortion(WIDTH, HEIGHT, K, LENSES["barrel"])
    lookup = ours.event_lookup()
    for x, y in ((5, 40), (32, 24), (60, 3), (20, 20)):
        sensor = np.zeros((HEIGHT, WIDTH), dtype=np.float32)
        sensor[y, x] = 1
        to_x, to_y = lookup[y, x]
        if to_x < 0:
            assert ours.undistort_image(sensor).max() < 1e-6
            continue
        # a magnified pixel may miss the one pixel it was assigned to, never its neighbourhood
        spot = ours.undistort_image(sensor)[
            max(0, to_y - 1) : to_y + 2, max(0, to_x - 1) : to_x + 2
        ]
        assert spot.max() > 0.2


@pytest.mark.parametrize("seed", range(3))
def test_a_resized_camera_stretches_each_side_by_its_own_factor(seed: int) -> None:
    camera = random_camera(seed)
    points = torch.randn(20, 3, generator=torch.Generator().manual_seed(seed))
    resized = camera.resized(WIDTH // 2, 3 * HEIGHT)
    assert (resized.width, resized.height) == (WIDTH // 2, 3 * HEIGHT)
    (before, depth), (after, same) = camera.project(points), resized.project(points)
    torch.testing.assert_close(after, before * torch.tensor([0.5, 3.0]), atol=1e-3, rtol=1e-4)
    assert torch.equal(depth, same)


def test_a_widened_camera_has_its_picture_in_the_middle() -> None:
    camera = random_camera(0)
    wide = camera.widened(7, 11)
    assert (wide.width, wide.height) == (WIDTH + 14, HEIGHT + 22)
    points = torch.randn(20, 3, generator=torch.Generator().manual_seed(0))
    moved = wide.project(points)[0] - camera.project(points)[0]
    assert torch.allclose(moved, torch.tensor([7.0, 11.0]), atol=1e-2)


@pytest.mark.parametrize("seed", range(3))
def test_a_point_is_shown_by_the_pixel_around_its_place(seed: int) -> None:
    camera = random_camera(seed)
    points = torch.from_numpy(np.random.default_rng(seed).normal(size=(40, 50, 3)) * 4).float()
    x, y, depth, shown = camera.pixels(points)
    places, away = camera.project(points)
    assert torch.equal(depth, away) and 0 < shown.sum() < shown.numel()
    inside = (places >= 0).all(-1) & (places[..., 0] < WIDTH) & (places[..., 1] < HEIGHT)
    assert torch.equal(shown, inside & (away > 0))
    assert (
        int(x.min()) >= 0 and int(x.max()) < WIDTH and int(y.min()) >= 0 and int(y.max()) < HEIGHT
    )
    middles = torch.stack([x, y], -1)[shown] + 0.5
    assert (places[shown] - middles).abs().max() <= 0.5 + 1e-4


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_lens_folds_where_its_radius_stops_to_grow(rng: np.random.Generator, count: int) -> None:
    folds = 0
    for _ in range(40):
        k = rng.normal(0, 1.0, 3) * (np.arange(3) < count)
        focal = np.diag([rng.uniform(30, 90)] * 2)
        K = np.block([[focal, np.array([[30.5], [25.0]])], [np.zeros((1, 2)), np.ones((1, 1))]])
        radius, share = Distortion(WIDTH, HEIGHT, K, (k[0], k[1], 0.0, 0.0, k[2])).fold()
        # r (1 + k1 r^2 + k2 r^4 + k3 r^6) by r, as a polynomial of r^2
        squares = np.roots([7 * k[2], 5 * k[1], 3 * k[0], 1])
        real = squares[(np.abs(squares.imag) < 1e-9) & (squares.real > 0)].real
        expected = focal[0, 0] * np.sqrt(real.min()) if len(real) else np.inf
        corner = np.hypot(WIDTH - 0.5 - 30.5, 25.0 - 0.5)
        if expected < corner - 1.5:
            folds += 1
            assert expected - 1e-3 <= radius < expected + 1.5 and share > 0
        elif expected > corner:
            assert (radius, share) == (np.inf, 0.0)
    assert folds > 3


@pytest.mark.parametrize("lens", LENSES)
def test_a_lens_that_can_be_undone_everywhere_folds_nowhere(lens: str) -> None:
    assert Distortion(WIDTH, HEIGHT, K, LENSES[lens]).fold() == (np.inf, 0.0)
