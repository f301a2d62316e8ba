"""A solid scene: it looks as it was recorded before black, and nearly so before anything else.

Trained before black, it lets 3 to 5 % of the light through, which darkens what is to be dark.
Before anything else that is a haze, and a web in surfaces seen at a slant.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.camera import Camera, spread_over
from evsplat.gaussians import Adam, GaussianSet
from evsplat.models.discs.scene_pictures import SEEN, ScenePictures
from evsplat.models.layers import scene_splats
from evsplat.models.solid_scene import SolidScene
from evsplat.render import render

STEPS = 100
RATES = {"quaternions": 0.03, "sizes": 0.05, "opacities": 0.3, "rgb": 0.05}
"""Of Adam at the first step; sizes are factors on all three scales, since along the line of sight
no picture tells, and learned as logarithms, opacities and colours as logits."""
LAST = 0.05
"""Share of the rates that is left at the last step."""
PRICE = 0.03
"""Of the square of what shines through a pixel, against that of a difference of its colours."""
_HOLE = 0.5
"""Share of the light from behind from which on nothing is there."""


def solid(
    gaussians: GaussianSet,
    recorded: Sequence[Camera],
    low_pass: float,
    colours: Float[Tensor, "S 3"],
) -> SolidScene:
    """The scene that lets least through among those whose pictures before black stay as they are.

    Holes stay, and so do Gaussians outside of the pictures and those of which they hardly tell.
    ``recorded`` are cameras of one size, of which some are drawn (`spread_over`), and ``colours``,
    sRGB, those of the scene.
    """
    views = spread_over(recorded)
    pictures = ScenePictures(gaussians, views, low_pass, colours)
    filled = [pictures.covered(view) > 1 - _HOLE for view in views]
    outside = torch.stack([pictures.cells_beyond(view) for view in views]).amin(0) > 0
    # Adam would move those of which next to nothing tells as far as the others.
    kept = outside | (pictures.squares < SEEN)
    rows = gaussians.scene
    own = gaussians.scales_log[rows].detach().exp()
    learned = {
        "quaternions": gaussians.quaternions[rows],
        "sizes": torch.zeros_like(own[:, :1]),
        "opacities": gaussians.opacity_logits[rows],
        "rgb": colours.logit(),
    }
    learned = {name: value.detach().clone().requires_grad_() for name, value in learned.items()}
    groups = [{"params": [learned[name]], "lr": rate} for name, rate in RATES.items()]
    adam = Adam(groups, eps=1e-15)  # gradients of single Gaussians are that small
    no_person = torch.zeros(len(colours), device=colours.device)
    for step in range(STEPS):
        for group, rate in zip(adam.param_groups, RATES.values(), strict=True):
            group["lr"] = rate * LAST ** (step / STEPS)
        index = step % len(views)
        drawn = render(
            scene_splats(
                means=pictures.means, semantics=no_person, **vars(_scene_of(learned, own))
            ),
            views[index],
            low_pass=low_pass,
        )
        changed = (drawn.image[..., :3] - pictures.before[index]).square().mean()
        through = ((1 - drawn.alpha) * filled[index]).square().mean()
        adam.zero_grad()
        (changed + PRICE * through).backward()
        for value in learned.values():
            assert value.grad is not None
            value.grad[kept] = 0
        adam.step()
    with torch.no_grad():
        return _scene_of(learned, own)


def _scene_of(learned: dict[str, Tensor], scales: Float[Tensor, "S 3"]) -> SolidScene:
    return SolidScene(
        learned["quaternions"],
        scales * learned["sizes"].exp(),
        learned["opacities"].sigmoid(),
        learned["rgb"].sigmoid(),
    )
