"""8-bit pictures, and colours of what was measured: error maps, signed maps."""

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

ERROR_FULL_SCALE = 64
"""Mean absolute difference, in 8-bit levels, that gets the brightest colour of an error map."""

# Dark to bright with steadily rising lightness, so that it also reads in grey print.
_HEAT = ((4, 4, 16), (72, 18, 100), (176, 44, 88), (240, 116, 38), (252, 206, 76), (255, 255, 226))
# Blue (darker) over white (no change) to red (brighter).
_SIGNED = ((9, 48, 128), (70, 130, 200), (248, 248, 248), (214, 84, 66), (128, 10, 30))


def to_bytes(image: Float[Tensor, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """sRGB in [0, 1], clamped, as 8-bit values."""
    return (image.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def error_map(
    image: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"]
) -> UInt8[np.ndarray, "H W 3"]:
    """Mean absolute difference over the channels in colours, black (0) to `ERROR_FULL_SCALE`."""
    difference = (image.detach().cpu().clamp(0, 1) - truth.cpu().clamp(0, 1)).abs().mean(dim=-1)
    return colours(difference.numpy() * 255 / ERROR_FULL_SCALE, _HEAT)


def signed_map(values: Float[Tensor, "H W"], full_scale: float) -> UInt8[np.ndarray, "H W 3"]:
    """Blue for negative, white for zero, red for positive, saturated at ``full_scale``."""
    unit = values.detach().cpu().numpy() / (2 * full_scale) + 0.5
    return colours(unit, _SIGNED)


def colours(
    unit: Float[np.ndarray, "*shape"], anchors: tuple[tuple[int, int, int], ...]
) -> UInt8[np.ndarray, "*shape 3"]:
    """Values clamped to [0, 1] as colours, linear between equally spaced ``anchors``."""
    positions = np.linspace(0, 1, len(anchors))
    channels = [
        np.interp(np.clip(unit, 0, 1), positions, [anchor[channel] for anchor in anchors])
        for channel in range(3)
    ]
    return np.stack(channels, axis=-1).round().astype(np.uint8)


def css_gradient(signed: bool) -> str:
    """The colours of error maps or signed maps as a CSS gradient, left to right."""
    anchors = _SIGNED if signed else _HEAT
    return "linear-gradient(90deg," + ",".join(f"rgb{anchor}" for anchor in anchors) + ")"
