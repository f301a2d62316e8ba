"""The pose encoder against a loop over joints."""

import pytest
import torch
from scipy.spatial.transform import Rotation

from evsplat.body import default_body
from evsplat.body.canonical import SMPL_PARENTS
from evsplat.models.networks.pose_encoder import PoseEncoder, normalise_joints

TREES = {
    "smpl": SMPL_PARENTS,
    "unsorted": (2, 4, -1, 2, 3, 0, 1),
    "chain": (-1, 0, 1, 2),
    "fork": (1, -1, 1, 0),
    "lone": (-1,),
}


def make(tree, seed=0):
    torch.manual_seed(seed)
    joints = len(TREES[tree])
    encoder = PoseEncoder(TREES[tree], torch.rand(joints, 3).double() * 2 - 1).double()
    rotations = Rotation.random(3 * joints, random_state=seed).as_matrix()
    return encoder, torch.tensor(rotations).view(3, joints, 3, 3)


def loop(encoder, parents, rotations):
    """Method.md 1.4, joint by joint, one time at a time."""
    slot = {int(joint): index for index, joint in enumerate(encoder.order)}
    places = encoder.all_joints.view(-1, 3)
    results = []
    for pose in rotations:
        pose = pose.clone()
        pose[parents.index(-1)] = torch.eye(3, dtype=pose.dtype)
        whole = torch.cat((pose.flatten(), places.flatten()))
        features = {-1: encoder.root_weight @ whole + encoder.root_bias}

        def feature(joint, pose=pose, features=features):
            if joint not in features:
                parent, k = parents[joint], slot[joint]
                above = places[parent] if parent >= 0 else torch.zeros(3, dtype=pose.dtype)
                length = (places[joint] - above).norm()[None]
                x = torch.cat((pose[joint].flatten(), places[joint], length, feature(parent)))
                x = torch.relu(x @ encoder.first_weight[k] + encoder.first_bias[k, 0])
                features[joint] = x @ encoder.second_weight[k] + encoder.second_bias[k, 0]
            return features[joint]

        results.append(torch.cat([feature(joint) for joint in range(len(parents))]))
    return torch.stack(results)


@pytest.mark.parametrize("tree", TREES)
def test_levels_at_once_equal_the_loop_over_joints(tree):
    encoder, rotations = make(tree)
    output = encoder(rotations)
    assert output.shape == (3, encoder.dim) and encoder.dim == 6 * len(TREES[tree])
    assert (output - loop(encoder, list(TREES[tree]), rotations)).abs().max() < 1e-13


def test_smpl_has_144_values_and_13700_parameters():
    encoder, _ = make("smpl")
    assert encoder.dim == 144
    assert abs(sum(p.numel() for p in encoder.parameters()) - 13_700) < 100


def test_the_heading_does_not_matter_and_a_joint_changes_its_subtree_and_the_root_map():
    encoder, rotations = make("smpl")
    turned = rotations.clone()
    turned[:, 0] = turned[:, 0].flip(-1)
    assert torch.equal(encoder(turned), encoder(rotations))
    # With the map of the whole pose silenced, an elbow moves forearm and hand only.
    torch.nn.init.zeros_(encoder.root_weight)
    bent = rotations.clone()
    bent[:, 18] = rotations[:, 19]
    changed = (encoder(bent) != encoder(rotations)).view(3, 24, 6).any(-1).any(0)
    assert torch.nonzero(changed)[:, 0].tolist() == [18, 20, 22]


@pytest.mark.parametrize("tree", ["fork", "lone"])
def test_gradcheck(tree):
    encoder, rotations = make(tree)
    leaves = (rotations[:1].clone().requires_grad_(), *encoder.parameters())
    assert torch.autograd.gradcheck(lambda r, *_: encoder(r), leaves)


def test_joints_are_normalised_with_one_scale_into_the_unit_box():
    body = default_body()
    joints = normalise_joints(body.rest_joints, body.rest_vertices)
    assert joints.abs().max() < 1
    moved, given = joints - joints[0], body.rest_joints - body.rest_joints[0]
    assert torch.allclose(moved, (moved.norm() / given.norm()) * given, atol=1e-6)
    # Method.md 1.3, literally.
    vertices = body.rest_vertices - body.rest_vertices.mean(0)
    lo, hi = vertices.min(), vertices.max()
    literal = body.rest_joints - body.rest_vertices.mean(0)
    literal = 2 * ((literal - lo + 0.05 * (hi - lo)) / (hi - lo) / 1.1 - 0.5)
    assert torch.allclose(joints, literal, atol=1e-6)
