"""Picture terms at mid-exposure: renders against recorded pictures, coverage against masks."""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from evsplat.capture import Frame, TrainingCapture
from evsplat.capture.masked import MaskedCapture
from evsplat.devices import DeviceCache
from evsplat.objectives.base import OfMiddle, Step
from evsplat.pictures.box import Box
from evsplat.similarity.perceptual import PerceptualMetric
from evsplat.similarity.psnr_ssim import l1_and_ssim


class Photometric(OfMiddle):
    """L1, D-SSIM and an optional perceptual distance on the person's box (A18, A19).

    The paper's reading: one sharp-time render is compared with the blurry frame. Every rendered
    time that is the mid-exposure of a training frame of the same camera counts, not the drawn frame
    alone, because its render is there already.
    """

    def __init__(
        self,
        capture: TrainingCapture,
        box_of: Callable[[Frame], Box | None],
        *,
        dssim: bool,
        perceptual: PerceptualMetric | None,
        perceptual_term: str = "perceptual",
    ) -> None:
        """``box_of``: the person's box in a training frame that shows one.

        ``perceptual_term`` is what that term is called.
        """
        super().__init__(capture)
        # Cameras that are triggered together have frames with one middle.
        self.frames = {(frame.camera, frame.mid_us): frame for frame in capture.train_frames}
        self.box_of, self.dssim, self.perceptual = box_of, dssim, perceptual
        self.perceptual_term = perceptual_term

    def loss(self, step: Step) -> dict[str, Tensor]:
        """``l1``, ``dssim`` and ``perceptual`` as configured, means over pictures and pixels."""
        camera = step.frame.camera
        frames = [self.frames.get((camera, time)) for time in step.times_us]
        seen = [
            (frame, rendered, step.observed(frame))
            for frame, rendered in zip(frames, step.rgb, strict=True)
            if frame is not None
        ]
        if self.dssim:
            values = [torch.stack(l1_and_ssim(a, b)) for _, a, b in seen]
            l1, similarity = torch.stack(values).mean(0).unbind()
            terms = {"l1": l1, "dssim": 1 - similarity}
        else:
            terms = {"l1": torch.stack([(a - b).abs().mean() for _, a, b in seen]).mean()}
        if self.perceptual is not None:
            values = []
            for frame, a, b in seen:
                if (box := self.box_of(frame)) is None:
                    continue
                crops = (box.crop(a), box.crop(b))
                if min(crops[0].shape[:2]) >= self.perceptual.network.min_side:
                    values.append(self.perceptual(2 * crops[0] - 1, 2 * crops[1] - 1))
            if values:
                terms[self.perceptual_term] = torch.stack(values).mean()
        return terms


class Alpha(OfMiddle):
    """L1 between the person's alpha picture and the mask (3DGS-Avatar).

    The alpha picture is the channel of the semantic attribute, for a set that is nothing but the
    person: the released code draws it as a second picture with all colours white.
    """

    capture: MaskedCapture

    def prefetch(self, frame: Frame, nominal: float, data: DeviceCache) -> None:
        """The mask."""
        data.prefetch(("human", frame.name), partial(self.capture.human, frame))

    def loss(self, step: Step) -> dict[str, Tensor]:
        """``alpha``: mean absolute difference over all pixels."""
        frame = step.frame
        mask = step.data.get(("human", frame.name), partial(self.capture.human, frame))
        drawn = step.semantic[step.index(frame.mid_us)]
        return {"alpha": (drawn - mask.to(drawn.dtype)).abs().mean()}
