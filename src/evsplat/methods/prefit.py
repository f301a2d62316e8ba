"""Cheap fits before training proper: skinning to the body's weights, the sheet to the median."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor, nn
from tqdm import tqdm

from evsplat.capture import Camera
from evsplat.devices import send
from evsplat.gaussians import Adam, GaussianSet
from evsplat.models.layers import scene_splats
from evsplat.models.networks.colour import SceneColour
from evsplat.models.paper.model import PaperModel
from evsplat.objectives import SkinningPrior
from evsplat.render import render

COLOUR_BATCH = 2_048
"""Scene Gaussians per step of teaching their colour network."""


def fit_skinning(
    model: PaperModel, prior: SkinningPrior, steps: int, generator: torch.Generator
) -> None:
    """Start the skinning network at the body's weights instead of at random ones."""
    rate = 5e-3
    adam = Adam(model.skinning.parameters(), lr=rate)
    for step in tqdm(range(steps), "skinning", unit="step", leave=False):
        for group in adam.param_groups:
            group["lr"] = rate * max(1 - step / steps, 0.02)
        adam.zero_grad()
        prior.of(model, generator).backward()
        adam.step()


def fit_scene_colours(
    network: SceneColour,
    gaussians: GaussianSet,
    camera: Camera,
    colours: Float[Tensor, "S 3"],
    steps: int,
    generator: torch.Generator,
) -> None:
    """Teach the scene's colour network to read the colour that the features start with."""
    rows = gaussians.scene
    features = gaussians.get_parameter("features").detach()[rows]
    directions = _directions(gaussians.means.detach()[rows], camera)
    adam = Adam(network.parameters(), lr=1e-2)
    for step in range(steps):
        for group in adam.param_groups:
            group["lr"] = 1e-2 * 0.1 ** (step / steps)
        adam.zero_grad()
        some = torch.randint(len(features), (COLOUR_BATCH,), generator=generator)
        some = send(some, colours.device)
        shown = directions[some] * (step % 2)
        (network(features[some], shown) - colours[some]).square().mean().backward()
        adam.step()


def fit_scene(
    gaussians: GaussianSet,
    camera: Camera,
    picture: Float[Tensor, "H W 3"],
    steps: int,
    *,
    low_pass: float,
    network: SceneColour | None = None,
) -> None:
    """Fit the scene's Gaussians alone to a picture without the person.

    Their colours are read by ``network``, and without one they are the Gaussians' own.
    """
    rows, colour = gaussians.scene, gaussians.colour
    rates = {"scales_log": 1e-2, "opacity_logits": 3e-2, colour: 2e-2, "quaternions": 2e-3}
    values = {
        name: getattr(gaussians, name).detach()[rows].clone().requires_grad_() for name in rates
    }
    groups = [{"params": [values[name]], "lr": rate, "rate": rate} for name, rate in rates.items()]
    means = gaussians.means.detach()[rows]
    rgb_at: Callable[[int], Tensor] = lambda step: values[colour].sigmoid()  # noqa: E731
    if network is not None:
        groups.append({"params": list(network.parameters()), "lr": 1e-3, "rate": 1e-3})
        directions = _directions(means, camera)
        rgb_at = lambda step: network(values[colour], directions * (step % 2))  # noqa: E731
    adam = Adam(groups, eps=1e-15)
    no_person = torch.zeros(len(means), device=means.device)
    for step in tqdm(range(steps), "scene", unit="step", leave=False):
        for group in adam.param_groups:
            group["lr"] = group["rate"] * 0.1 ** (step / steps)
        adam.zero_grad()
        scene = scene_splats(
            means,
            values["quaternions"],
            values["scales_log"].exp(),
            torch.sigmoid(values["opacity_logits"]),
            rgb_at(step),
            no_person,
        )
        drawn = render(scene, camera, low_pass=low_pass)
        (drawn.image[0, ..., :3] - picture).abs().mean().backward()
        adam.step()
    with torch.no_grad():
        for name, value in values.items():
            getattr(gaussians, name)[rows] = value


def _directions(means: Float[Tensor, "S 3"], camera: Camera) -> Float[Tensor, "S 3"]:
    """Unit vectors from the camera."""
    return nn.functional.normalize(means - camera.center(), dim=-1)
