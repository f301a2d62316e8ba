"""The .splat of the first WebGL viewers: 32 bytes per Gaussian, no header."""

from pathlib import Path

import numpy as np

from evsplat.export.cloud import SplatCloud
from evsplat.files import atomic_path

_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])


def write_splat(path: Path | str, cloud: SplatCloud) -> None:
    """Write centres and scales as float32, sRGB, opacity and rotation (w, x, y, z) in 8 bits.

    The largest and most opaque Gaussians come first, so that a viewer which draws while it loads
    shows the outline early (antimatter15/splat).
    """
    rows = np.zeros(len(cloud), dtype=_ROW)
    rows["mean"], rows["scale"] = cloud.means, cloud.scales
    rgba = np.concatenate([cloud.rgb, cloud.opacities[:, None]], axis=1)
    rows["rgba"] = np.rint(rgba.clip(0, 1) * 255)
    rows["rotation"] = np.rint(cloud.quaternions * 128 + 128).clip(0, 255)
    weight = cloud.opacities * cloud.scales.astype(np.float64).prod(1)
    with atomic_path(path) as temporary:
        temporary.write_bytes(rows[np.argsort(-weight, kind="stable")].tobytes())
