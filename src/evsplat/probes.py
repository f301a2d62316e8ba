"""Random signs: what a sum of many with them tells of each one."""

import torch
from torch import Tensor


def random_signs(like: Tensor, generator: torch.Generator) -> Tensor:
    """1 or -1 for each value of ``like``, equally likely and independent; of its kind, device.

    The mean square of sums of values with such signs is the sum of the values' squares (Hutchinson
    1990), and a linear map of them times them has the map's diagonal for its mean (Bekas 2007).
    ``generator`` is the host's, so that devices draw alike.
    """
    return torch.randint(0, 2, like.shape, generator=generator).to(like) * 2 - 1
