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
    scales_log: Float[Tensor, "H 3"]
    quaternions: Float[Tensor, "H 4"]
    rgb: Float[Tensor, "H 3"]
    """The person's own colours, sRGB."""
    opacities: Float[Tensor, " H"]
    """Of the person."""
    semantics: Float[Tensor, " H"]

    @classmethod
    def of(
        cls, gaussians: GaussianSet, scene_colours: SceneColours, *, hard_semantics: bool
    ) -> "Still":
        """Read from the attributes; labels are the soft ones, or hard."""
        means, scene_means = gaussians.of_parts(gaussians.means)
        scales_log, scene_scales_log = gaussians.of_parts(gaussians.scales_log)
        quaternions, scene_quaternions = gaussians.of_parts(gaussians.quaternions)
        colours, scene_features = gaussians.of_parts(gaussians.get_parameter(gaussians.colour))
        opacities, scene_opacities = gaussians.of_parts(gaussians.opacities())
        labels = gaussians.human_mask().float() if hard_semantics else gaussians.semantics()
        semantics, scene_semantics = gaussians.of_parts(labels)
        scene_scales = scene_scales_log.exp()
        return cls(
            scene_splats(
                scene_means,
                scene_quaternions,
                scene_scales,
                scene_opacities,
                scene_colours(scene_features, scene_means, scene_scales),
                scene_semantics,
            ),
            means,
            scales_log,
            quaternions,
            colours[:, :3].sigmoid(),
            opacities,
            semantics,
        )
