"""A model in large random poses with large random residuals, and where its joints must be then."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from evsplat.body import BodyTrack


def bend(model, times: list[int], rng: np.random.Generator) -> None:
    """Give the model random key poses at ``times``, and random residuals from the start on."""
    joints = len(model.track.body.parents)
    poses = 0.8 * rng.normal(size=(len(times), joints, 3))
    places = rng.normal(size=(len(times), 3))
    model.track = BodyTrack(model.track.body, np.array(times), poses, places)
    model.residual_start = 0.0
    with torch.no_grad():
        for values in model.residual.parameters():
            values.copy_(torch.from_numpy(0.8 * rng.normal(size=values.shape)))


def assert_posed(model, times: list[int], turns: np.ndarray, shifts: np.ndarray) -> None:
    """Each joint turns by the residual about its own axes, and then as the track says."""
    given, place = model.track.at(times)
    matrices = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix().reshape(*turns.shape, 3)
    expected = given.double().numpy() @ matrices
    other = matrices @ given.double().numpy()
    assert np.abs(expected - other).max(axis=(2, 3)).min() > 0.01
    rotations, bones = model.pose(times)
    assert np.allclose(rotations.detach(), expected, atol=1e-5)
    placed = model.track.body.canonical_to_world(
        torch.from_numpy(expected).float(), place + torch.from_numpy(shifts).float()
    )
    assert torch.allclose(bones, placed, atol=1e-4)
