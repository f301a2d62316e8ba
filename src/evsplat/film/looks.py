"""Looks of a film: the values that its pixels show."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float, UInt16

from evsplat.camera import Camera
from evsplat.errors import ConfigError
from evsplat.film.gaps import close_gaps
from evsplat.film.surroundings import CalmRoom, Painted
from evsplat.methods.reconstruction import Parts
from evsplat.options.runs import Shown
from evsplat.pictures import Transfer, decode, encode, luminance, shown
from evsplat.pictures.colours import colours
from evsplat.training.reconstruction import GaussianReconstruction

Exposure = np.ndarray
"""A picture as it is cached: (H, W, 3) or (H, W, 4) uint8, or (H, W) uint16."""

_HUMAN, _SCENE = (1.0, 0.46, 0.16), (0.16, 0.50, 0.72)
# From never seen to well seen, on the grey picture.
_CERTAINTY = ((214, 48, 84), (240, 190, 60), (255, 255, 255))
# Near to far, from light to dark.
_NEAR_TO_FAR = ((255, 247, 200), (250, 190, 90), (214, 90, 90), (120, 40, 120), (24, 16, 60))


@dataclass(frozen=True)
class Look:
    """Shown values of a reconstruction and of which parts of it."""

    shown: Shown = "rgb"
    parts: Parts = "all"
    transparent: bool = False
    """RGBA instead of black where nothing is; for ``rgb`` and ``semantic``."""
    transfer: Transfer = "power"
    """From the values that are drawn to light."""
    surroundings: CalmRoom | Painted | None = field(default=None, repr=False)
    """What shows of ``rgb`` where nothing is; black without. It follows from run and film."""

    def __post_init__(self) -> None:
        if self.transparent and self.shown not in ("rgb", "semantic"):
            raise ConfigError(f"--transparent: goes with --show rgb or semantic, not {self.shown}.")

    def expose(
        self, reconstruction: GaussianReconstruction, camera: Camera, times_us: Sequence[int]
    ) -> list[Exposure]:
        """Pictures as they are cached: colours in 8 bit; depth in millimetres and light in 16 bit.

        Light (for events) is linear luminance, coded by the exponent 1/2.2.
        """
        if self.shown == "depth":
            depth = reconstruction.depth(camera, times_us, parts=self.parts)
            return list((depth * 1000).round().clamp(0, 65_535).numpy().astype(np.uint16))
        drawn = reconstruction.render(camera, times_us, parts=self.parts)
        values = (drawn.rgb, drawn.alpha, drawn.human)
        rgb, alpha, human = (value.cpu().clamp(0, 1) for value in values)
        if self.shown == "events":
            coded = encode(luminance(decode(rgb, self.transfer)))
            return list((coded * 65_535).round().clamp(0, 65_535).numpy().astype(np.uint16))
        if (self.surroundings is not None or self.transparent) and self.parts != "human":
            rgb, alpha = close_gaps(rgb, alpha, human)
        solid = alpha[..., None]
        if self.transparent:
            # Over black the colour is multiplied with alpha already.
            rgb = (rgb / solid.clamp_min(1e-4)).clamp(0, 1)
            solid = torch.ones_like(solid)
        rgb = shown(rgb, self.transfer)
        if self.surroundings is not None:
            rooms = [self.surroundings.behind(camera, time) for time in times_us]
            rgb = (rgb + (1 - solid) * torch.stack(rooms)).clamp(0, 1)
        if self.shown == "semantic":
            share = human[..., None]
            tint = share * torch.tensor(_HUMAN) + (1 - share) * torch.tensor(_SCENE)
            grey = rgb.mean(-1, keepdim=True)
            rgb = (0.3 * solid + 0.7 * grey) * tint
        if self.shown == "certainty":
            certain = reconstruction.certainty(camera, times_us, parts=self.parts)
            hues = np.stack([colours(picture.numpy(), _CERTAINTY) for picture in certain])
            grey = rgb.mean(-1, keepdim=True)
            rgb = (0.3 * solid + 0.7 * grey) * torch.from_numpy(hues).float() / 255
        if self.transparent:
            rgb = torch.cat((rgb, alpha[..., None]), -1)
        return list((rgb * 255).round().to(torch.uint8).numpy())


def depth_colours(millimetres: UInt16[np.ndarray, "H W"], nearest_m: float) -> np.ndarray:
    """Depth as colours, even in 1/z: light at ``nearest_m`` and nearer, dark far away."""
    far = 1 - nearest_m * 1000 / np.maximum(millimetres, 1)
    picture = colours(far.astype(np.float32), _NEAR_TO_FAR)
    picture[millimetres == 0] = 0
    return picture


def linear_luma(exposure: UInt16[np.ndarray, "H W"]) -> Float[torch.Tensor, "H W"]:
    """Linear light in [0, 1] of an exposure of ``events``."""
    return decode(torch.from_numpy(exposure.astype(np.float32) / 65_535))
