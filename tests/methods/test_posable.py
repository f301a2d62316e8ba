"""A person that follows another motion, and how far away what is drawn lies."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from evsplat.body import BodyTrack
from evsplat.capture import load_capture
from evsplat.models.drawing import draw_depth
from evsplat.training.reconstruction import GaussianReconstruction

from ..small_model import built

SETTINGS = {
    "paper": ("networks.pose_start=0",),
    "evsplat": ("pose.refine=always", "pose.start=0", "lamps=2"),
}


@pytest.fixture(params=SETTINGS)
def drawn(request, tiny_capture):
    """An untrained reconstruction with residuals (and latents) that matter, camera and times."""
    capture = load_capture(tiny_capture())
    model = built(request.param, capture, *SETTINGS[request.param]).model
    with torch.no_grad():
        if request.param == "paper":
            model.latents.values.normal_()
        for name, values in model.residual.named_parameters():
            if name.endswith("rotations"):
                values.normal_(std=0.2 if request.param == "paper" else 2.0)
    camera = capture.camera(capture.train_frames[0])
    return GaussianReconstruction(request.param, model), camera, [f.mid_us for f in capture.frames]


def test_a_motion_that_moves_all_poses_in_time_moves_the_pictures_in_time(drawn):
    reconstruction, camera, times = drawn
    track, shift = reconstruction.track, 7_000_000
    rotations, transl = track.at(times)
    poses = Rotation.from_matrix(rotations.double().numpy().reshape(-1, 3, 3)).as_rotvec()
    poses = poses.reshape(len(times), -1, 3)
    later = BodyTrack(track.body, np.array(times) + shift, poses, transl.double().numpy())
    moved = reconstruction.following(later).render(camera, [t + shift for t in times])
    model = reconstruction.model
    with torch.no_grad():
        unmoved = reconstruction.render(camera, times)
        model.residual.forget()
        if reconstruction.name == "paper":
            model.latents.values.copy_(model.latents.values.mean(0))
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
    layers = reconstruction.model.at(times[:1], camera.center())
    count = layers.scene.means.shape[1]
    low = torch.tensor([-2.0, -1.5, 0.0])
    in_camera = low + torch.rand(count, 3) * torch.tensor([4.0, 3.0, 0.0])
    distance = 4.25
    in_camera[:, 2] = distance
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    wall = replace(
        layers.scene,
        means=((in_camera - translation) @ rotation)[None],
        scales=torch.full((count, 3), 0.2),
        opacities=torch.full((count,), 0.9),
    )
    with torch.no_grad():
        depth = draw_depth(replace(layers, scene=wall), camera, parts="scene")
    seen = depth > 0
    assert float(seen.float().mean()) > 0.5
    assert torch.allclose(depth[seen], torch.tensor(distance), atol=1e-3)


def test_an_invisible_part_leaves_the_depth_of_the_other(drawn):
    reconstruction, camera, times = drawn
    layers = reconstruction.model.at(times[:2], camera.center())
    nothing = {
        name: replace(layer, opacities=torch.zeros_like(layer.opacities))
        for name, layer in (("human", layers.human), ("scene", layers.scene))
    }
    no_person = replace(layers, human=nothing["human"])
    no_scene = replace(layers, scene=nothing["scene"])
    with torch.no_grad():
        for given, part in ((no_person, "scene"), (no_scene, "human")):
            both = draw_depth(given, camera)
            assert bool((both > 0).any())
            expected = reconstruction.depth(camera, times[:2], parts=part)
            assert torch.allclose(both, expected, atol=1e-3)
