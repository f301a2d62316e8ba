"""The fits before training: what they bring near, and what they leave as it was."""

import torch

from evsplat.camera import Camera
from evsplat.gaussians import GaussianSet
from evsplat.gaussians.initialise import gaussians_at
from evsplat.methods.prefit import fit_scene, fit_scene_colours
from evsplat.models.layers import scene_splats
from evsplat.models.networks.colour import SceneColour
from evsplat.render import render

POSE = torch.eye(4)
POSE[:3, 3] = torch.tensor([0.4, -0.3, 0.6])
CAMERA = Camera(20, 16, torch.tensor([[20.0, 0, 10], [0, 20.0, 8], [0, 0, 1]]), POSE)


def sheet(feature_dim: int | None) -> GaussianSet:
    """A scene 2 m away, a Gaussian to every other pixel, and a person who is not asked for."""
    y, x = torch.meshgrid(torch.arange(0.5, 16, 2), torch.arange(0.5, 20, 2), indexing="ij")
    points = 2 * torch.stack([(x - 10) / 20, (y - 8) / 20, torch.ones_like(x)], -1).view(-1, 3)
    points = points - POSE[:3, 3]
    scales = torch.full_like(points, 0.12)

    def start(points, scales, label):
        return gaussians_at(
            points, scales, opacity=0.8, semantic_logit=label, feature_dim=feature_dim
        )

    return GaussianSet(start(points[:3] - 1, scales[:3], 2.0), start(points, scales, -2.0))


def drawn(gaussians: GaussianSet, rgb: torch.Tensor) -> torch.Tensor:
    rows = gaussians.scene
    scene = scene_splats(
        gaussians.means[rows],
        gaussians.quaternions[rows],
        gaussians.scales_log[rows].exp(),
        gaussians.opacities()[rows],
        rgb,
        torch.zeros(gaussians.scene_count),
    )
    return render(scene, CAMERA, low_pass=0.3).image[0, ..., :3].detach()


def picture() -> torch.Tensor:
    """Colours that go evenly from side to side and from top to bottom."""
    y, x = torch.meshgrid(torch.linspace(0.2, 0.8, 16), torch.linspace(0.1, 0.9, 20), indexing="ij")
    return torch.stack([x, y, 0.5 * (x + 1 - y)], -1)


def test_a_scene_of_own_colours_comes_near_the_picture_and_nothing_else_moves():
    gaussians = sheet(None)
    before = {name: value.detach().clone() for name, value in gaussians.named_parameters()}
    rgb = lambda: gaussians.get_parameter(gaussians.colour)[gaussians.scene].sigmoid()  # noqa: E731
    missed = (drawn(gaussians, rgb()) - picture()).abs().mean()
    fit_scene(gaussians, CAMERA, picture(), 200, low_pass=0.3)
    assert (drawn(gaussians, rgb()) - picture()).abs().mean() < 0.25 * missed
    fitted = {"scales_log", "quaternions", "opacity_logits", gaussians.colour}
    for name, value in gaussians.named_parameters():
        assert torch.equal(value[gaussians.human], before[name][gaussians.human])
        same = torch.equal(value[gaussians.scene], before[name][gaussians.scene])
        assert same == (name not in fitted), name


class Told(torch.nn.Module):
    """A network of colours that notes what it is told."""

    def __init__(self) -> None:
        super().__init__()
        self.network = SceneColour()
        self.told: list[tuple[torch.Tensor, torch.Tensor]] = []

    def forward(self, features: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        self.told.append((features.detach().clone(), directions))
        return self.network(features, directions)


def test_networks_of_colours_learn_them_and_see_the_direction_in_every_other_step():
    torch.manual_seed(0)
    gaussians, network = sheet(32), Told()
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        gaussians.get_parameter("features").normal_(generator=generator)
    features = gaussians.get_parameter("features").detach()[gaussians.scene].clone()
    colours = 0.5 + 0.3 * torch.tanh(features[:, :3])
    kept = [p.detach().clone() for p in gaussians.parameters()]
    fit_scene_colours(network, gaussians, CAMERA, colours, 150, generator)
    assert all(map(torch.equal, kept, gaussians.parameters()))
    means = gaussians.means.detach()[gaussians.scene]
    directions = torch.nn.functional.normalize(means - CAMERA.center(), dim=-1)
    for shown in (0 * directions, directions):
        told = network.network(features, shown).detach()
        assert (told - colours).abs().mean() < 0.05
    assert (colours - colours.mean(0)).abs().mean() > 0.1
    fit_scene(gaussians, CAMERA, picture(), 2, low_pass=0.3, network=network)
    for number, (asked, shown) in enumerate(network.told):
        rows = torch.cdist(asked, features).argmin(1)
        expected = directions[rows] * (number % 2)
        torch.testing.assert_close(shown, expected, atol=1e-6, rtol=0)
