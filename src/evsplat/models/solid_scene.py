"""The scene as it is drawn from elsewhere than where it was recorded, and as files hold it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.camera import Camera
from evsplat.models.layers import Layers
from evsplat.models.stored import stored


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
        sent = {name: value.to(device) for name, value in tensors.items()}
        return stored(cls, "a solid scene", sent, count, quaternions=4, scales=3, rgb=3)

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
