"""Cheap fits before training proper: skinning to the body's weights, the sheet to the median."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from evsplat.capture import Camera
from evsplat.deform.human_scene import HumanSceneModel
from evsplat.devices import send
from evsplat.gaussians import StaticScene
from evsplat.objectives import SkinningPrior
from evsplat.render import Splats, render

COLOUR_BATCH = 2_048
"""Scene Gaussians per step of teaching their colour network."""


def fit_skinning(
    model: HumanSceneModel, prior: SkinningPrior, steps: int, generator: torch.Generator
) -> None:
    """Start the skinning network at the body's weights instead of at random ones."""
    assert model.skinning is not None
    rate = 5e-3
    adam = torch.optim.Adam(model.skinning.parameters(), lr=rate, fused=True)
    for step in range(steps):
        for group in adam.param_groups:
            group["lr"] = rate * max(1 - step / steps, 0.02)
        adam.zero_grad()
        prior.of(model, generator).backward()
        adam.step()


def fit_scene_colours(
    model: HumanSceneModel,
    camera: Camera,
    colours: Float[Tensor, "S 3"],
    steps: int,
    generator: torch.Generator,
) -> None:
    """Teach the scene's colour network to read the colour that the features start with."""
    gaussians = model.gaussians
    rows = gaussians.scene
    features = gaussians.features.detach()[rows]
    directions = nn.functional.normalize(gaussians.means.detach()[rows] - camera.center(), dim=-1)
    adam = torch.optim.Adam(model.scene_colour.parameters(), lr=1e-2)
    for step in range(steps):
        for group in adam.param_groups:
            group["lr"] = 1e-2 * 0.1 ** (step / steps)
        adam.zero_grad()
        some = torch.randint(len(features), (COLOUR_BATCH,), generator=generator)
        some = send(some, colours.device)
        shown = directions[some] * (step % 2)
        (model.scene_colour(features[some], shown) - colours[some]).square().mean().backward()
        adam.step()


def fit_scene(
    model: HumanSceneModel, camera: Camera, picture: Float[Tensor, "H W 3"], steps: int
) -> None:
    """Fit the scene's Gaussians alone to a picture without the person."""
    gaussians = model.gaussians
    rows = gaussians.scene
    rates = {"scales_log": 1e-2, "opacity_logits": 3e-2, "features": 2e-2, "quaternions": 2e-3}
    values = {
        name: getattr(gaussians, name).detach()[rows].clone().requires_grad_() for name in rates
    }
    adam = torch.optim.Adam(
        [{"params": [values[name]], "lr": rate, "rate": rate} for name, rate in rates.items()]
        + [{"params": list(model.scene_colour.parameters()), "lr": 1e-3, "rate": 1e-3}],
        eps=1e-15,
        fused=True,
    )
    means = gaussians.means.detach()[rows]
    directions = nn.functional.normalize(means - camera.center(), dim=-1)
    for step in range(steps):
        for group in adam.param_groups:
            group["lr"] = group["rate"] * 0.1 ** (step / steps)
        adam.zero_grad()
        shown = directions if step % 2 else torch.zeros_like(directions)
        rgb = model.scene_colour(values["features"], shown)
        scene = StaticScene(means, values["quaternions"], values["scales_log"].exp(), rgb)
        opacities = torch.sigmoid(values["opacity_logits"])
        drawn = render(
            Splats(scene.means[None], scene.quaternions, scene.scales, opacities, rgb[None]),
            camera,
            low_pass=model.low_pass,
        )
        (drawn.image[0] - picture).abs().mean().backward()
        adam.step()
    with torch.no_grad():
        for name, value in values.items():
            getattr(gaussians, name)[rows] = value
