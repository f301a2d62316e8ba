"""The code of a pose: principal components of the recorded ones, and nothing beyond them."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from evsplat.body import BodyTrack, default_body
from evsplat.models.networks.pose_code import COMPONENTS, PoseCode

TIMES = [50_000 * k for k in range(12)]


def track_of(sizes: np.ndarray, seed: int = 0) -> BodyTrack:
    """Key poses whose joints turn by random angles of ``sizes`` (J,), radians."""
    body, rng = default_body(), np.random.default_rng(seed)
    poses = rng.normal(size=(len(TIMES), len(body.parents), 3)) * sizes[:, None]
    return BodyTrack(body, np.array(TIMES), poses, np.zeros((len(TIMES), 3)))


def joints() -> int:
    return len(default_body().parents)


def test_recorded_poses_have_independent_numbers_of_size_one():
    track = track_of(np.full(joints(), 0.3))
    code = PoseCode(track, TIMES)(track.at(TIMES)[0]).double()
    assert code.shape == (len(TIMES), COMPONENTS)
    covariance = code.T @ code / len(TIMES)
    assert torch.allclose(covariance, torch.eye(COMPONENTS).double(), atol=1e-4)
    assert torch.allclose(code.mean(0), torch.zeros(COMPONENTS).double(), atol=1e-5)


def test_the_first_number_is_that_of_the_joint_that_moves_most():
    sizes = np.zeros(joints())
    sizes[5] = 0.4
    track = track_of(sizes)
    rotations = track.at(TIMES)[0]
    entries = rotations[:, 5].flatten(1).double().numpy()
    values, vectors = np.linalg.eigh(np.cov(entries.T, bias=True))
    expected = (entries - entries.mean(0)) @ vectors[:, -1] / np.sqrt(values[-1])
    found = PoseCode(track, TIMES)(rotations)[:, 0].double().numpy()
    np.testing.assert_allclose(found * np.sign(found @ expected), expected, atol=1e-4)


def test_small_movements_are_not_made_large():
    sizes = np.zeros(joints())
    sizes[5] = 1e-3
    track = track_of(sizes)
    assert PoseCode(track, TIMES)(track.at(TIMES)[0]).abs().max() < 0.05


def test_somebody_who_stands_still_or_is_seen_once_has_code_zero():
    for track, times in ((track_of(np.zeros(joints())), TIMES), (track_of(np.ones(joints())), [0])):
        assert torch.equal(
            PoseCode(track, times)(track.at(times)[0]), torch.zeros(len(times), COMPONENTS)
        )


def test_the_heading_does_not_enter():
    track = track_of(np.full(joints(), 0.3))
    encoder, rotations = PoseCode(track, TIMES), track.at(TIMES)[0]
    turned = rotations.clone()
    turn = torch.tensor(Rotation.from_rotvec([0.0, 2.0, 0.0]).as_matrix()).float()
    turned[:, 0] = turn @ turned[:, 0]
    assert torch.equal(encoder(turned), encoder(rotations))


def test_poses_beyond_the_recorded_ones_have_no_code_beyond_theirs():
    track, wild = track_of(np.full(joints(), 0.1)), track_of(np.full(joints(), 1.0), seed=1)
    encoder = PoseCode(track, TIMES)
    recorded, beyond = encoder(track.at(TIMES)[0]), encoder(wild.at(TIMES)[0])
    assert (beyond <= recorded.amax(0) + 1e-6).all() and (beyond >= recorded.amin(0) - 1e-6).all()
    assert (beyond.abs() > 0.5).any()
