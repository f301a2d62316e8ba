"""Values learned per training frame, latents and pose residuals, read at any instant."""

from collections.abc import Sequence
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from evsplat.devices import send

UnseenFrames = Literal["interpolated", "released"]
"""What frames outside of the training get. ``interpolated``: latent and pose residual of the
training frames around them (A22). ``released``: as 3DGS-Avatar's code, the latent of the last
training frame and no pose correction."""


def _anchors(frame_times_us: Sequence[int]) -> Float[Tensor, " F"]:
    """Times in order, each once: several cameras see one person, and may have one trigger."""
    return torch.tensor(sorted(set(frame_times_us)), dtype=torch.float64)


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


class FramePoses(nn.Module):
    """A pose residual per training frame, as 3DGS-Avatar learns it; starts at zero."""

    frame_times: Tensor

    def __init__(self, frame_times_us: Sequence[int], joints: int, unseen: UnseenFrames) -> None:
        """``frame_times_us``: mid-exposures of the training frames."""
        super().__init__()
        times = _anchors(frame_times_us)
        self.register_buffer("frame_times", times)
        self.share = interpolated if unseen == "interpolated" else seen
        self.rotations = nn.Parameter(torch.zeros(len(times), joints, 3))
        """Axis-angle vectors, radians."""
        self.translations = nn.Parameter(torch.zeros(len(times), 3))
        """Of the root, metres."""

    def residual(
        self, times_us: Sequence[int]
    ) -> tuple[Float[Tensor, "T J 3"], Float[Tensor, "T 3"]]:
        """Axis-angle vectors, radians, and shifts of the root, metres."""
        weights = self.share(self.frame_times, times_us)
        turns = torch.einsum("tf,fjc->tjc", weights, self.rotations)
        return turns, weights @ self.translations

    def forget(self) -> None:
        """Set all residuals to zero."""
        with torch.no_grad():
            self.rotations.zero_()
            self.translations.zero_()


class FrameLatents(nn.Module):
    """A vector per training frame for the person's colour.

    Zero at the start, not random: what a frame has not learned must not show between frames.
    """

    frame_times: Tensor

    def __init__(self, frame_times_us: Sequence[int], size: int, unseen: UnseenFrames) -> None:
        """``frame_times_us``: mid-exposures of the training frames."""
        super().__init__()
        times = _anchors(frame_times_us)
        self.register_buffer("frame_times", times)
        self.share = interpolated if unseen == "interpolated" else seen_or_last
        self.values = nn.Parameter(torch.zeros(len(times), size))

    def forward(self, times_us: Sequence[int]) -> Float[Tensor, "T L"]:
        """Latents of any instants."""
        return self.share(self.frame_times, times_us) @ self.values

    def take_mean(self) -> None:
        """Give all frames the mean of all, for motions that no frame shows."""
        with torch.no_grad():
            self.values.copy_(self.values.mean(0))
