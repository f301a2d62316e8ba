"""Pictures from events alone, by a recurrent network, coloured with the blurry frame.

E2VID and its successors give one grey picture per window of events, known up to brightness and
contrast and unknown where nothing has moved yet. A static camera sees no events of the scene, so
the frames of a capture keep their own pixels there, and elsewhere their colour.
"""

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from evsplat.capture import Frame, TrainingCapture, coded
from evsplat.events import EventStream
from evsplat.events.maps import polarity_counts
from evsplat.pictures.light import REC709, stored
from evsplat.restore.network import Pretrained

MATCHED_OVER = 0.02
"""Standard deviation, over the picture's shorter side, of the weights of brightness matching."""
_LEAST_VARIANCE = 1e-5
_OFFSET = 0.02


class FromEvents(Pretrained):
    """Each frame at mid-exposure, its brightness from events and its colour from the blurry frame.

    The events between the mid-exposures of neighbouring frames are one window; the first begins
    one such interval early, as far as there are events. The network keeps what earlier windows have
    shown; where events may not be read it forgets that, and begins anew behind the gap.
    """

    @abstractmethod
    def reset(self) -> None:
        """Forget all windows so far."""

    @abstractmethod
    def step(self, events: EventStream, height: int, width: int) -> Float[Tensor, "H W"]:
        """Intensity at the end of a window, in no known unit."""

    def restore(
        self, capture: TrainingCapture, frames: Sequence[Frame]
    ) -> Iterator[tuple[Frame, Float[Tensor, "H W 3"]]]:
        """See `Restorer`."""
        assert capture.events is not None
        seen = coded(capture)
        asked = {frame.name for frame in frames}
        times = sorted(frame.mid_us for frame in capture.frames)
        interval = times[1] - times[0] if len(times) > 1 else times[0]
        stretch, before = None, 0
        for frame in sorted(capture.train_frames, key=lambda frame: frame.mid_us):
            if stretch != (stretch := capture.events.readable_around(frame.mid_us)):
                self.reset()
                before = max(frame.mid_us - interval, stretch[0])
            camera = capture.camera(frame)
            height, width = camera.height, camera.width
            window = capture.events.between(before, frame.mid_us)
            intensity = self.step(window, height, width).cpu()
            before = frame.mid_us
            if frame.name in asked:
                moved = polarity_counts(capture.events.between(*frame.exposure_us), height, width)
                bright = with_brightness(seen.image(frame), intensity, moved.sum(0) > 0)
                yield frame, stored(bright, capture.transfer(frame))

    def provenance(self) -> dict[str, Any]:
        """The network's, and how its pictures became frames."""
        return {
            **super().provenance(),
            "colour": "of the blurry frame, brightness from events where the exposure saw any",
            "brightness_matched_over": MATCHED_OVER,
        }


def with_brightness(
    blurry: Float[Tensor, "H W 3"],
    intensity: Float[Tensor, "H W"],
    moved: Float[Tensor, "H W"],
    *,
    over: float = MATCHED_OVER,
) -> Float[Tensor, "H W 3"]:
    """The blurry picture with ``intensity`` as its brightness where ``moved`` is true.

    Intensity is first given the mean and the spread that the blurry picture's luma has around each
    pixel (Gaussian weights, standard deviation ``over`` times the shorter side): blur keeps what is
    larger than itself, and the network knows nothing of absolute brightness. All channels are then
    multiplied alike, so the hue stays that of the blurry picture.
    """
    sigma = over * min(blurry.shape[:2])
    luma = blurry @ torch.tensor(REC709).to(blurry)
    mean, spread = _around(luma, sigma)
    own_mean, own_spread = _around(intensity.to(blurry), sigma)
    matched = ((intensity.to(blurry) - own_mean) * (spread / own_spread) + mean).clamp(0, 1)
    share = F.max_pool2d(moved.to(blurry)[None], 3, 1, 1)
    share = F.avg_pool2d(share, 3, 1, 1, count_include_pad=False)[0]
    gain = 1 + share * ((matched + _OFFSET) / (luma + _OFFSET) - 1)
    return (blurry * gain[..., None]).clamp(0, 1)


def _around(
    values: Float[Tensor, "H W"], sigma: float
) -> tuple[Float[Tensor, "H W"], Float[Tensor, "H W"]]:
    """Weighted mean and standard deviation around each pixel."""
    mean = _blurred(values, sigma)
    # Deviations are taken from one value for all, else the difference of squares loses its digits.
    centred = values - values.mean()
    variance = _blurred(centred**2, sigma) - (mean - values.mean()) ** 2
    return mean, variance.clamp_min(_LEAST_VARIANCE).sqrt()


def _blurred(values: Float[Tensor, "H W"], sigma: float) -> Float[Tensor, "H W"]:
    """Gaussian mean, cut off at three standard deviations and at the border of the picture."""
    radius = max(1, round(3 * sigma))
    at = torch.arange(-radius, radius + 1).to(values)
    weights = torch.exp(-0.5 * (at / max(sigma, 1e-3)) ** 2)
    both = torch.stack((values, torch.ones_like(values)))[:, None]
    both = F.conv2d(both, weights[None, None, :, None], padding=(radius, 0))
    both = F.conv2d(both, weights[None, None, None, :], padding=(0, radius))
    return both[0, 0] / both[1, 0]
