"""The picture term of a camera that integrates: blurry frame against the mean over its exposure."""

from bisect import bisect_left
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from evsplat.body import BodyTrack
from evsplat.capture import Camera, Frame, TrainingCapture
from evsplat.devices import DeviceCache
from evsplat.objectives.base import Objective, Step, picture
from evsplat.pictures import chroma, encode
from evsplat.similarity.psnr_ssim import l1_and_ssim

DARKEST_LINEAR = 1e-6
"""Below this the slope of the transfer curve grows without bound; an 8-bit level is 5e-6."""
CHROMA_START = 8_000
"""First nominal iteration of the colour differences. While limbs are not yet where they belong they
would rather fade than show a tint in the wrong place."""
VERTEX_STRIDE = 13
"""Every so many vertices are enough to know how far the body moves."""


def motion_px(cameras: Sequence[Camera], track: BodyTrack, frame: Frame) -> float:
    """Largest path of a body vertex over a frame's exposure, as its camera sees it, pixels.

    ``cameras``: that one at the start and at the end of the exposure.
    """
    ends = [
        camera.project(track.vertices(time)[::VERTEX_STRIDE])[0]
        for camera, time in zip(cameras, frame.exposure_us, strict=True)
    ]
    return float((ends[1] - ends[0]).norm(dim=-1).max())


def sweep_px(cameras: Sequence[Camera], track: BodyTrack, frame: Frame) -> float:
    """Largest path over a frame's exposure of what stands still as far away as the body, pixels.

    At the corners and the middle of the picture, before ``cameras`` as in `motion_px`. A camera
    that follows somebody sweeps over the scene while they hardly move in the picture.
    """
    start, end = cameras
    if start is end:
        return 0.0
    width, height = start.width, start.height
    pixels = torch.tensor(
        [[0, 0], [width, 0], [0, height], [width, height], [width / 2, height / 2]]
    )
    depth = start.project(track.vertices(frame.mid_us)[::VERTEX_STRIDE])[1].mean().cpu()
    rays = torch.cat([pixels, torch.ones(len(pixels), 1)], 1) @ torch.linalg.inv(start.K).T
    places = start.center() + depth * rays @ start.world_to_camera[:3, :3]
    return float((end.project(places)[0] - pixels).norm(dim=-1).max())


def renders_for(motion: float, px_per_render: float, most: int) -> int:
    """An odd number of renders, at most ``most``, so that one lies in the middle of the exposure.

    At least 3, but where ``most`` is 1: then the sharp middle stands for the blurry frame.
    """
    if most < 3:
        return 1
    wanted = max(3.0, min(motion / px_per_render, float(most - 1 + most % 2)))
    return 2 * int((wanted - 1) / 2 + 0.5) + 1


class Exposure(Objective):
    """L1 and D-SSIM between a blurry frame and the mean, in linear light, of K renders.

    In the end L1 of Cb and Cr as well, which nothing else decides: events see luminance alone.

    The exposure is cut into K equal strata; a render lies at a random place of each but the middle
    one, whose is the middle. K grows with how far the body moves in the exposure, so that
    neighbouring renders overlap.
    """

    def __init__(
        self,
        capture: TrainingCapture,
        renders: Callable[[Frame], int],
        generator: torch.Generator,
    ) -> None:
        """``renders``: K of a training frame, odd."""
        self.capture, self.renders, self.generator = capture, renders, generator

    def times(self, frame: Frame, nominal: float) -> Sequence[int]:
        """K distinct times, the middle of the exposure among them."""
        start, end = frame.exposure_us
        count = self.renders(frame)
        places = torch.arange(count) + torch.rand(count, generator=self.generator)
        drawn = [start + int(share * (end - start) / count) for share in places.tolist()]
        # Other objectives and the non-rigid network look at the middle, which must be among them.
        drawn[count // 2] = frame.mid_us
        return sorted(set(drawn))

    def prefetch(self, frame: Frame, nominal: float, data: DeviceCache) -> None:
        """The recorded picture."""
        data.prefetch(*picture(self.capture, frame))

    def loss(self, step: Step) -> dict[str, Tensor]:
        """``l1`` and ``dssim`` of the drawn frame, from `CHROMA_START` on ``chroma`` as well."""
        start, end = step.frame.exposure_us
        first, last = (bisect_left(step.times_us, time) for time in (start, end))
        # Times of other objectives lie outside. A shutter adds light up before it is coded.
        mean = step.pictures.mean_light(slice(first, last))
        drawn = encode(mean, step.transfer, least=DARKEST_LINEAR)
        observed = step.observed(step.frame)
        l1, similarity = l1_and_ssim(drawn, observed)
        terms = {"l1": l1, "dssim": 1 - similarity}
        if step.nominal >= CHROMA_START:
            terms["chroma"] = chroma(drawn - observed).abs().mean()
        return terms
