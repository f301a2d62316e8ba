"""Which training frames speak for an instant: of per-frame latents and pose residuals."""

from collections.abc import Sequence
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.devices import send

UnseenFrames = Literal["interpolated", "released"]
"""What frames outside of the training get. ``interpolated``: latent and pose residual of the
training frames around them (A22). ``released``: as 3DGS-Avatar's code, the latent of the last
training frame and no pose correction."""


def interpolated(anchors_us: Float[Tensor, " F"], times_us: Sequence[int]) -> Float[Tensor, "T F"]:
    """Linear interpolation between the frames around each time; held at the ends."""
    times = send(torch.tensor(list(times_us), dtype=torch.float64), anchors_us.device)
    times = times.clamp(anchors_us[0], anchors_us[-1])
    if len(anchors_us) == 1:
        return torch.ones(len(times), 1, device=anchors_us.device)
    after = torch.searchsorted(anchors_us, times).clamp(1, len(anchors_us) - 1)
    before = after - 1
    share = (times - anchors_us[before]) / (anchors_us[after] - anchors_us[before])
    weights = torch.zeros(
        len(times), len(anchors_us), dtype=torch.float64, device=anchors_us.device
    )
    weights.scatter_(1, before[:, None], (1 - share)[:, None])
    weights.scatter_(1, after[:, None], share[:, None])
    return weights.float()


def seen(anchors_us: Float[Tensor, " F"], times_us: Sequence[int]) -> Float[Tensor, "T F"]:
    """1 for the frame whose middle a time is; a row of zeros for any other time."""
    times = send(torch.tensor(list(times_us), dtype=torch.float64), anchors_us.device)
    return (times[:, None] == anchors_us).float()


def seen_or_last(anchors_us: Float[Tensor, " F"], times_us: Sequence[int]) -> Float[Tensor, "T F"]:
    """1 for the frame whose middle a time is; at any other time 1 for the last frame."""
    weights = seen(anchors_us, times_us)
    weights[:, -1] += 1 - weights.sum(1)
    return weights
