"""The .ply of 3D Gaussian splatting: one binary vertex per Gaussian, float32 throughout."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from evsplat.export.cloud import SplatCloud
from evsplat.files import atomic_path

SH_C0 = 0.28209479177387814
"""The constant spherical harmonic: colour = 0.5 + SH_C0 * f_dc."""
_LEAST_OPACITY = 1e-6
"""Opacities are kept this far from 0 and 1, whose logits are infinite."""


def write_ply(path: Path | str, cloud: SplatCloud, *, comments: Sequence[str] = ()) -> None:
    """Write the layout of Kerbl et al. 2023 (SH degree 0), and a column ``semantic`` after it.

    Normals are zero, ``opacity`` is a logit, ``scale_*`` are natural logarithms of metres and
    ``rot_*`` is (w, x, y, z). ``comments`` become comment lines of the header.
    """
    opacity = np.clip(cloud.opacities.astype(np.float64), _LEAST_OPACITY, 1 - _LEAST_OPACITY)
    columns = {
        **dict(zip("xyz", cloud.means.T, strict=True)),
        **{name: np.zeros(len(cloud)) for name in ("nx", "ny", "nz")},
        **{f"f_dc_{k}": (cloud.rgb[:, k] - 0.5) / SH_C0 for k in range(3)},
        "opacity": np.log(opacity / (1 - opacity)),
        **{f"scale_{k}": np.log(cloud.scales[:, k]) for k in range(3)},
        **{f"rot_{k}": cloud.quaternions[:, k] for k in range(4)},
        "semantic": cloud.semantic,
    }
    table = np.stack([np.float32(values) for values in columns.values()], axis=1)
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {line}" for line in comments),
        f"element vertex {len(cloud)}",
        *(f"property float {name}" for name in columns),
        "end_header\n",
    ]
    with atomic_path(path) as temporary:
        temporary.write_bytes("\n".join(header).encode("ascii") + table.astype("<f4").tobytes())
