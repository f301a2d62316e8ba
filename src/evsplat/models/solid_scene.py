"""The scene as it is drawn from elsewhere than where it was recorded, and as files hold it."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.camera import Camera
from evsplat.models.layers import Layers


@dataclass(frozen=True, eq=False)
class SolidScene:
    """What the scene's Gaussians have in place of what they learned; they stay where they are."""

    quaternions: Float[Tensor, "S 4"]
    scales: Float[Tensor, "S 3"]
    """Metres."""
    opacities: Float[Tensor, " S"]
    rgb: Float[Tensor, "S 3"]
    """sRGB."""

    @classmethod
    def of(
        cls, tensors: Mapping[str, Tensor], count: int, device: torch.device
    ) -> "SolidScene | None":
        """From the tensors by their names, or None where there are none.

        Raises:
            ValueError: They are not those of ``count`` Gaussians, or not finite.
        """
        if not tensors:
            return None
        found = cls(**{field.name: tensors[field.name].to(device) for field in fields(cls)})
        shapes = [tuple(value.shape) for value in vars(found).values()]
        if shapes != [(count, 4), (count, 3), (count,), (count, 3)]:
            raise ValueError(f"a solid scene is of shapes {shapes}, of {count} Gaussians")
        if not all(value.isfinite().all() for value in vars(found).values()):
            raise ValueError("a solid scene holds numbers that are not finite")
        return found

    def stand_for(self, layers: Layers, camera: Camera) -> Layers:
        """The same with this scene, from whatever camera."""
        channels = torch.cat([self.rgb[None], layers.scene.channels[..., 3:]], -1)
        scene = replace(
            layers.scene,
            quaternions=self.quaternions,
            scales=self.scales,
            opacities=self.opacities,
            channels=channels,
        )
        return replace(layers, scene=scene)
