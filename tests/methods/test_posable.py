"""A person that follows another motion, and how far away what is drawn lies."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from evsplat.body import BodyTrack
from evsplat.capture import load_capture
from evsplat.config import override
from evsplat.methods import compose, method_config
from evsplat.methods.reconstruction import Posable, WithDepth
from evsplat.models.drawing import draw_depth
from evsplat.training.run import GaussianReconstruction

from ..seen import seen

SMALL = ("human.count=150", "deform.width=16", "deform.colour_width=16")


@pytest.fixture
def drawn(tiny_capture):
    """An untrained reconstruction with latents and residuals that matter, its camera and times."""
    capture = load_capture(tiny_capture())
    values = override({}, (*SMALL, "deform.pose_correction_start=0"))
    model = compose(method_config("paper", values, where="test"), seen(capture), 0, fit=False).model
    with torch.no_grad():
        model.latents.normal_()
        model.rotation_residuals.normal_(std=0.2)
    camera = capture.camera(capture.train_frames[0])
    return GaussianReconstruction("paper", model), camera, [f.mid_us for f in capture.frames]


def test_a_motion_that_moves_all_poses_in_time_moves_the_pictures_in_time(drawn):
    reconstruction, camera, times = drawn
    assert isinstance(reconstruction, Posable) and isinstance(reconstruction, WithDepth)
    track, shift = reconstruction.track, 7_000_000
    rotations, transl = track.at(times)
    poses = Rotation.from_matrix(rotations.double().numpy().reshape(-1, 3, 3)).as_rotvec()
    poses = poses.reshape(len(times), -1, 3)
    later = BodyTrack(track.body, np.array(times) + shift, poses, transl.double().numpy())
    moved = reconstruction.following(later).render(camera, [t + shift for t in times])
    model = reconstruction.model
    with torch.no_grad():
        unmoved = reconstruction.render(camera, times)
        model.rotation_residuals.zero_()
        model.latents.copy_(model.latents.mean(0))
        expected = reconstruction.render(camera, times)
    assert torch.allclose(moved.rgb, expected.rgb, atol=1e-4)
    assert not torch.allclose(moved.rgb, unmoved.rgb, atol=1e-2)


def test_the_recorded_reconstruction_stays_as_it_was(drawn):
    reconstruction, camera, times = drawn
    before = reconstruction.render(camera, times[:2]).rgb
    track = reconstruction.track
    still = BodyTrack(
        track.body, np.array([0]), np.zeros((1, len(track.body.parents), 3)), np.zeros((1, 3))
    )
    reconstruction.following(still)
    assert torch.equal(reconstruction.render(camera, times[:2]).rgb, before)


def test_depth_of_a_wall_across_the_view_is_its_distance(drawn):
    reconstruction, camera, times = drawn
    posed = reconstruction.model.at(times[:1], camera.center())
    count = len(posed.scene.means)
    low = torch.tensor([-2.0, -1.5, 0.0])
    in_camera = low + torch.rand(count, 3) * torch.tensor([4.0, 3.0, 0.0])
    distance = 4.25
    in_camera[:, 2] = distance
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    wall = replace(
        posed.scene,
        means=(in_camera - translation) @ rotation,
        scales=torch.full((count, 3), 0.2),
    )
    solid = replace(posed, scene=wall, scene_opacities=torch.full((count,), 0.9))
    with torch.no_grad():
        depth = draw_depth(solid, camera, parts="scene")
    seen = depth > 0
    assert float(seen.float().mean()) > 0.5
    assert torch.allclose(depth[seen], torch.tensor(distance), atol=1e-3)


def test_an_invisible_part_leaves_the_depth_of_the_other(drawn):
    reconstruction, camera, times = drawn
    posed = reconstruction.model.at(times[:2], camera.center())
    no_person = replace(posed, human_opacities=torch.zeros_like(posed.human_opacities))
    no_scene = replace(posed, scene_opacities=torch.zeros_like(posed.scene_opacities))
    with torch.no_grad():
        for gaussians, part in ((no_person, "scene"), (no_scene, "human")):
            both = draw_depth(gaussians, camera)
            assert bool((both > 0).any())
            expected = reconstruction.depth(camera, times[:2], parts=part)
            assert torch.allclose(both, expected, atol=1e-3)
