"""Pictures of the scene alone, as linear functions of its colours."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property, partial, reduce
from operator import add

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from evsplat.camera import Camera
from evsplat.gaussians import GaussianSet
from evsplat.gaussians.surface_graph import closest
from evsplat.gaussians.surround import cell_px
from evsplat.models.discs.first_colours import LEAST, MOST
from evsplat.models.discs.still import Still
from evsplat.models.seen import fixed, shares_by, transposed
from evsplat.render import render

SEEN = 0.1
"""Squared shares of pixels from which on a Gaussian is seen."""
_FAST = 1e6
_FARTHER = 1.15
"""Least depth of what is hidden as a share of the picture's there."""


class ScenePictures:
    """Of cameras of one size; ``J`` are the shares that the scene's Gaussians have of all pixels.

    ``colours``, sRGB, are the scene's own, and ``before`` the pictures with them.
    """

    def __init__(
        self,
        gaussians: GaussianSet,
        views: Sequence[Camera],
        low_pass: float,
        colours: Float[Tensor, "S 3"] | None = None,
    ) -> None:
        """``colours`` in place of those of ``gaussians``."""
        self.views, self._low_pass = views, low_pass
        with torch.no_grad():
            scene = Still.of(gaussians, None, hard_semantics=True).scene.with_times()
        own = scene.channels[..., :3] if colours is None else colours[None]
        self._scene = fixed(scene, own)
        self.colours = own[0]
        self.means = self._scene.means[0]
        with torch.no_grad():
            self.before = [self.draw(own, view) for view in views]

    def draw(self, values: Float[Tensor, "1 S C"], view: Camera) -> Float[Tensor, "1 H W C"]:
        """A picture with these in place of colours."""
        scene = replace(self._scene, channels=values)
        return render(scene, view, low_pass=self._low_pass).image

    @torch.no_grad()
    def covered(self, view: Camera) -> Float[Tensor, "1 H W"]:
        """Share of the light from behind each pixel that the scene hides."""
        return self.draw(torch.ones_like(self.means[None, :, :1]), view)[..., 0]

    @cached_property
    def squares(self) -> Float[Tensor, " S"]:
        """Sums of the squared shares of all pixels; estimates without bias."""
        generator = torch.Generator().manual_seed(0)
        shares = [
            shares_by(partial(self.draw, view=view), self.means[None], generator)
            for view in self.views
        ]
        return reduce(add, [each[:, 1:].square().mean(1) for each in shares])

    def near(
        self,
        told: Float[Tensor, "S 3"],
        free: Bool[Tensor, " S"],
        price: float,
        steps: int,
        start: Float[Tensor, "S 3"] | None = None,
    ) -> Float[Tensor, "S 3"]:
        """Colours near to those ``told`` with which the pictures look as before (`closest`).

        The others than the ``free`` ones stay. ``price``: what a squared difference to those told
        costs, in pixels.
        """
        missing = self._over(told, lambda drawn, index: self.before[index] - drawn)
        prices = torch.where(free, price, _FAST).to(told)
        none = torch.zeros_like(prices)
        found = closest(told, missing, self._twice, self.squares, prices, none, steps, start)
        return torch.where(free[:, None], found.clamp(LEAST, MOST), self.colours)

    def cells_beyond(self, view: Camera) -> Float[Tensor, " S"]:
        """Cells of the surround from a picture's border to what is outside; negative within."""
        places, depth = view.project(self.means)
        size = places.new_tensor([view.width, view.height])
        cell = cell_px(view.width, view.height)
        beyond = ((places - size / 2).abs() - size / 2).amax(-1) / cell
        return beyond.where(depth > 0, torch.inf)

    def behind(self, view: Camera) -> Bool[Tensor, " S"]:
        """What lies within a picture, well behind the depth that is seen there."""
        x, y, depth, inside = view.pixels(self.means)
        values = torch.stack([depth, torch.ones_like(depth)], -1)[None]
        with torch.no_grad():
            sums = self.draw(values, view)[0]
        depths, shares = sums[y, x].unbind(-1)
        return inside & (depth * shares > _FARTHER * depths)

    def _twice(self, values: Float[Tensor, "S 3"]) -> Float[Tensor, "S 3"]:
        """``J^T J values``."""
        return self._over(values, lambda drawn, _: drawn)

    def _over(
        self, values: Float[Tensor, "S 3"], weights: Callable[[Tensor, int], Tensor]
    ) -> Float[Tensor, "S 3"]:
        """Sum over all views of ``J^T weights``, of a picture with these values and its number."""
        sums: list[Tensor] = []
        for index, view in enumerate(self.views):
            leaf = values[None].clone().requires_grad_()
            image = self.draw(leaf, view)
            sums.append(transposed(image, leaf, weights(image.detach(), index))[0])
        return reduce(add, sums)
