"""What no pose changes of a model of discs: the scene, and the person's own colours."""

from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from evsplat.gaussians import GaussianSet
from evsplat.models.layers import scene_splats
from evsplat.render import Splats

SceneColours = Callable[
    [Float[Tensor, "S C"], Float[Tensor, "S 3"], Float[Tensor, "S 3"]], Float[Tensor, "S 3"]
]
"""sRGB of the scene by its attribute of colour, centres and scales (metres)."""


@dataclass(frozen=True, eq=False)
class Still:
    """The same at all times."""

    scene: Splats
    means: Float[Tensor, "H 3"]
    """Of the person, canonical metres."""
    scales: Float[Tensor, "H 3"]
    """Of the person, metres."""
    quaternions: Float[Tensor, "H 4"]
    rgb: Float[Tensor, "H 3"]
    """The person's own colours, sRGB."""
    opacities: Float[Tensor, " H"]
    """Of the person."""
    semantics: Float[Tensor, " H"]

    @classmethod
    def of(
        cls, gaussians: GaussianSet, scene_colours: SceneColours | None, *, hard_semantics: bool
    ) -> "Still":
        """Read from the attributes; labels are the soft ones, or hard.

        ``scene_colours``: where the scene's colours are not their own.
        """
        means, scene_means = gaussians.of_parts(gaussians.means)
        scales, scene_scales = gaussians.of_parts(gaussians.scales_log.exp())
        quaternions, scene_quaternions = gaussians.of_parts(gaussians.quaternions)
        colours = gaussians.get_parameter(gaussians.colour)
        if scene_colours is None:
            rgb, scene_rgb = gaussians.of_parts(colours.sigmoid())
        else:
            own, features = gaussians.of_parts(colours)
            rgb = own[:, :3].sigmoid()
            scene_rgb = scene_colours(features, scene_means, scene_scales)
        opacities, scene_opacities = gaussians.of_parts(gaussians.opacities())
        labels = gaussians.human_mask().float() if hard_semantics else gaussians.semantics()
        semantics, scene_semantics = gaussians.of_parts(labels)
        return cls(
            scene_splats(
                scene_means,
                scene_quaternions,
                scene_scales,
                scene_opacities,
                scene_rgb,
                scene_semantics,
            ),
            means,
            scales,
            quaternions,
            rgb,
            opacities,
            semantics,
        )
