"""Sharp targets in closed form: the middle of an exposure by the event double integral."""

from collections import OrderedDict
from collections.abc import Sequence
from functools import partial

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from evsplat.capture import Frame, TrainingCapture
from evsplat.devices import DeviceCache
from evsplat.events import deblur
from evsplat.objectives.base import Stateless, Step
from evsplat.objectives.event_noise import EventNoise
from evsplat.objectives.event_sensor import EventSensor
from evsplat.similarity.psnr_ssim import l1_and_ssim

CACHED_PICTURES = 256
"""Sharp pictures kept, at 8 bit and with their trust: 67 MB at 256 x 256."""
DARKEST, BRIGHTEST = 2 / 255, 253 / 255
"""A recorded or sharpened level outside of these was cut off by the camera."""


class EdiTarget(Stateless):
    """L1 and D-SSIM between the render at mid-exposure and the frame sharpened by its events.

    The event double integral (Pan et al. 2019) is exact where light only changed in brightness, and
    needs no pose; it keeps the tint of what the person passed over, since events see luminance. It
    brings a person into place early, by one render instead of an exposure's, and has to fade.

    Pixels count by how far they can be trusted: hot ones and those that the camera cut off do not,
    the others by the sensor's noise over the exposure (`EventNoise`). In place of what is not
    trusted stands the render itself, which teaches nothing.
    """

    def __init__(
        self,
        capture: TrainingCapture,
        sensor: EventSensor,
        noise: EventNoise,
        *,
        alone_until: float,
        weight: float,
        end: float,
    ) -> None:
        """``sensor``: the thresholds that it starts from are taken.

        The term weighs 1 until the nominal iteration ``alone_until``, while no blurry frame is
        compared, then ``weight``, which falls in a straight line to 0 at ``end``.
        """
        assert capture.events is not None
        self.capture, self.events = capture, capture.events
        self.sensor, self.noise = sensor, noise
        self.alone_until, self.weight, self.end = alone_until, weight, end
        self._made: OrderedDict[str, UInt8[Tensor, "H W 4"]] = OrderedDict()

    def times(self, frame: Frame, nominal: float) -> Sequence[int]:
        """The middle of the exposure."""
        return (frame.mid_us,) if self.weight_at(nominal) > 0 else ()

    def prefetch(self, frame: Frame, nominal: float, data: DeviceCache) -> None:
        """The sharp picture."""
        if self.weight_at(nominal) > 0:
            data.prefetch(("edi", frame.name), partial(self.target, frame))

    def loss(self, step: Step) -> dict[str, Tensor]:
        """``edi``: 0.8 L1 + 0.2 D-SSIM, as the picture term weighs them, times `weight_at`."""
        weight = self.weight_at(step.nominal)
        if weight == 0:
            return {}
        frame = step.frame
        target = step.data.get(("edi", frame.name), partial(self.target, frame))
        sharp, trust = target.split((3, 1), -1)
        rendered = step.rgb[step.index(frame.mid_us)]
        l1, similarity = l1_and_ssim(rendered, torch.lerp(rendered.detach(), sharp, trust))
        return {"edi": weight * (0.8 * l1 + 0.2 * (1 - similarity))}

    def weight_at(self, nominal: float) -> float:
        """Weight of the term at a nominal iteration."""
        if nominal < self.alone_until:
            return 1.0
        if nominal >= self.end:
            return 0.0
        return self.weight * (self.end - nominal) / (self.end - self.alone_until)

    def target(self, frame: Frame) -> Float[Tensor, "H W 4"]:
        """A training frame at the middle of its exposure, sRGB, and its trust, all in [0, 1]."""
        if frame.name not in self._made:
            self._made[frame.name] = (255 * self._make(frame)).round().to(torch.uint8)
            if len(self._made) > CACHED_PICTURES:
                self._made.popitem(last=False)
        return self._made[frame.name].float() / 255

    def _make(self, frame: Frame) -> Float[Tensor, "H W 4"]:
        blurry = self.capture.image(frame)
        start, end = frame.exposure_us
        on, off = self.sensor.start_logs.exp().tolist()
        sharp = deblur(
            blurry,
            self.events.between(start, end),
            (start, end),
            [frame.mid_us],
            (on, off),
        )[0]
        # Saturated colours have one dark channel; cut off is a pixel only if all of it is dark.
        brightest = torch.stack([blurry, sharp]).amax(-1)
        seen = ((brightest < BRIGHTEST) & (brightest > DARKEST)).all(0)
        trust = self.noise.weight(end - start) * self.noise.sound * seen
        return torch.cat([sharp, trust[..., None]], -1)
