"""Real spherical harmonics of directions."""

import torch
from jaxtyping import Float
from torch import Tensor

SH_CONSTANT = 0.28209479177387814
"""The constant harmonic: files and models of 3DGS keep a colour as 0.5 + this times a number."""


def sh_basis(
    directions: Float[Tensor, "*batch 3"], degree: int = 3, constant: bool = False
) -> Float[Tensor, "*batch K"]:
    """Basis values up to ``degree`` (0..3) of unit directions.

    K = (degree + 1)^2, less the constant. Order l, then m = -l..l; signs as in 3DGS (with the
    Condon-Shortley phase). Degree 3 without the constant gives the 15 values of the colour networks
    (3DGS-Avatar).
    """
    if not 0 <= degree <= 3:
        raise ValueError(f"degree is {degree}, expected 0..3")
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(x, SH_CONSTANT)] if constant else []
    if degree >= 1:
        c1 = 0.4886025119029199
        values += [-c1 * y, c1 * z, -c1 * x]
    if degree >= 2:
        xx, yy, zz, xy = x * x, y * y, z * z, x * y
        c2 = 1.0925484305920792
        values += [
            c2 * xy,
            -c2 * (y * z),
            0.31539156525252005 * (2 * zz - xx - yy),
            -c2 * (x * z),
            0.5462742152960396 * (xx - yy),
        ]
    if degree >= 3:
        c3, around = 0.5900435899266435, 0.4570457994644658 * (4 * zz - xx - yy)
        values += [
            -c3 * y * (3 * xx - yy),
            2.890611442640554 * xy * z,
            -y * around,
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -x * around,
            1.445305721320277 * z * (xx - yy),
            -c3 * x * (xx - 3 * yy),
        ]
    if not values:
        return directions[..., :0]
    return torch.stack(values, -1)
