"""The room's lamp, the light from all around, and how skin and cloth answer to both."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from evsplat.compiled import native
from evsplat.staging.camera_path import look_at

_SHADOW_TEXELS = 640
_SHADOW_FOCAL = 1 / 2.9
"""Focal length of the shadow map over its side: 55 degrees to either side of straight down."""
_SHADOW_SOFTNESS = 0.016
"""Radius of the soft edge over the side of the shadow map."""
_LEAN = (-0.12, 0.22, -1.0)
"""The shadow map looks a little towards the middle of the room."""


@dataclass(frozen=True)
class Lighting:
    """Radiances relative to the room's baked light."""

    lamp: tuple[float, float, float, float, float]
    """Centre of a lamp that shines down (metres) and half its extent along x and y."""
    lamp_strength: float = 3.0
    ambient_below: tuple[float, float, float] = (0.17, 0.15, 0.135)
    """Light from all around on what faces down."""
    ambient_above: tuple[float, float, float] = (0.24, 0.245, 0.25)
    """Light from all around on what faces up."""
    rim: float = 0.05
    """Light that comes from beside the camera."""
    wrap: float = 0.15
    """How far lamp light reaches round an edge."""
    specular: float = 0.04
    shininess: float = 24.0
    shadow_bias_m: float = 0.03

    def shadow_view(self) -> Float[np.ndarray, "3 4"]:
        """World to the lamp's eye: x and y across, z away from the lamp."""
        eye = np.array(self.lamp[:3])
        return look_at(eye, eye + np.array(_LEAN), up=(0, 1, 0))[:3]

    def to_native(self) -> "native.Light":
        """The same for the renderer."""
        light = native.Light()
        light.position = self.lamp[:3]
        light.power = 4 * self.lamp[3] * self.lamp[4] / np.pi * self.lamp_strength
        light.world_to_light = self.shadow_view().ravel().tolist()
        light.shadow_size = _SHADOW_TEXELS
        light.shadow_focal = _SHADOW_TEXELS * _SHADOW_FOCAL
        light.shadow_radius = _SHADOW_TEXELS * _SHADOW_SOFTNESS
        light.shadow_bias = self.shadow_bias_m
        light.ambient_below, light.ambient_above = self.ambient_below, self.ambient_above
        light.rim, light.wrap = self.rim, self.wrap
        light.specular, light.shininess = self.specular, self.shininess
        return light
