"""HUGS's losses: both sets against the picture, the person alone against its pixels."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from evsplat.capture import Frame, TrainingCapture
from evsplat.devices import DeviceCache, send
from evsplat.models.hugs.model import HugsDrawing, HugsModel
from evsplat.models.hugs.start import body_weights
from evsplat.objectives.base import LookedUp, OfMiddle, Step
from evsplat.render import render
from evsplat.similarity.perceptual import PerceptualMetric
from evsplat.similarity.psnr_ssim import l1_and_ssim

PATCHES, PATCH_PX = 4, 128
"""Number and side of the squares that the perceptual distance sees."""
ON_PERSON = 0.9
"""Probability of a square to be centred on a pixel of the person."""


def mask_of(capture: TrainingCapture, frame: Frame) -> Float[Tensor, "H W"]:
    """1 where the frame's mask says person, 0 elsewhere."""
    mask = capture.mask(frame)
    assert mask is not None  # the method has looked
    return (mask > 0.5).float()


def perceptual_distance(
    metric: PerceptualMetric,
    image: Float[Tensor, "H W 3"],
    reference: Float[Tensor, "H W 3"],
    mask: Float[Tensor, "H W"],
    generator: torch.Generator,
) -> Float[Tensor, ""]:
    """Mean distance, over random squares, of two pictures in [0, 1]; most are on the person."""
    # To the [-1, 1] that the networks expect; the released code leaves it out.
    image, reference = 2 * image - 1, 2 * reference - 1
    squares = draw_squares(mask.cpu() > 0.5, generator)
    return torch.stack([metric(image[place], reference[place]) for place in squares]).mean()


def draw_squares(
    mask: Bool[Tensor, "H W"], generator: torch.Generator
) -> list[tuple[slice, slice]]:
    """Rows and columns of `PATCHES` squares inside the picture."""
    height, width = mask.shape
    side = min(PATCH_PX, height, width)
    person = torch.nonzero(mask)
    squares = []
    for _ in range(PATCHES):
        on_person = float(torch.rand((), generator=generator)) < ON_PERSON
        row, column = (int(torch.randint(size, (), generator=generator)) for size in mask.shape)
        if on_person and len(person):
            row, column = person[int(torch.randint(len(person), (), generator=generator))].tolist()
        top = min(max(row - side // 2, 0), height - side)
        left = min(max(column - side // 2, 0), width - side)
        squares.append((slice(top, top + side), slice(left, left + side)))
    return squares


class _Picture(OfMiddle):
    """The recorded picture and the mask, for a perceptual distance on squares as well."""

    def __init__(self, capture: TrainingCapture, perceptual: PerceptualMetric | None) -> None:
        """Pictures and masks are the capture's."""
        super().__init__(capture)
        self.perceptual = perceptual

    def prefetch(self, frame: Frame, nominal: float, data: DeviceCache) -> None:
        """The recorded picture and the mask."""
        super().prefetch(frame, nominal, data)
        data.prefetch(("mask", frame.name), lambda: mask_of(self.capture, frame))

    def mask(self, step: Step) -> Float[Tensor, "H W"]:
        """The drawn frame's mask on the model's device."""
        frame = step.frame
        return step.data.get(("mask", frame.name), lambda: mask_of(self.capture, frame))


class JointPicture(_Picture):
    """Everything, over the step's random colour, against the recorded picture."""

    def loss(self, step: Step) -> dict[str, Tensor]:
        """``l1``, ``dssim`` and ``perceptual``, means over the picture."""
        drawn = step.rgb[step.index(step.frame.mid_us)].clamp(0, 1)
        observed = step.observed(step.frame)
        l1, similarity = l1_and_ssim(drawn, observed)
        terms = {"l1": l1, "dssim": 1 - similarity}
        if self.perceptual is not None:
            mask = self.mask(step)
            terms["perceptual"] = perceptual_distance(
                self.perceptual, drawn, observed, mask, step.generator
            )
        return terms


class HumanPicture(_Picture):
    """The person alone against its pixels, both over a random colour of the step."""

    def loss(self, step: Step[HugsModel]) -> dict[str, Tensor]:
        """``human_l1``, ``human_dssim`` and ``human_perceptual``.

        The L1 is a sum over pixels and channels by the number of the person's pixels; 1 - SSIM is a
        mean over the picture times the person's share of it. Outside of the person the perceptual
        distance sees noise in place of the colour.
        """
        index, observed = step.index(step.frame.mid_us), step.observed(step.frame)
        mask = self.mask(step)
        colour = send(torch.rand(3, generator=step.generator), mask.device)
        drawn, inside = self._drawn(step, index, colour).clamp(0, 1), mask[..., None]
        expected = observed * inside + colour * (1 - inside)
        l1, similarity = l1_and_ssim(drawn, expected)
        terms = {
            "human_l1": l1 * expected.numel() / mask.sum().clamp_min(1),
            "human_dssim": (1 - similarity) * mask.mean(),
        }
        if self.perceptual is not None:
            noise = send(torch.rand(expected.shape, generator=step.generator), mask.device)
            shown, wanted = (noise * (1 - inside) + value * inside for value in (drawn, observed))
            terms["human_perceptual"] = perceptual_distance(
                self.perceptual, shown, wanted, mask, step.generator
            )
        return terms

    def _drawn(
        self, step: Step[HugsModel], index: int, colour: Float[Tensor, "3"]
    ) -> Float[Tensor, "H W 3"]:
        human = step.layers.human
        human = replace(
            human,
            **{
                name: getattr(human, name)[index : index + 1]
                for name in ("means", "quaternions", "scales", "linear")
            },
            channels=human.channels[index : index + 1, :, :3],
            centers2d_offset=None,
        )
        camera = step.capture.camera(step.frame).to(colour.device)
        return render(human, camera, background=colour).image[0]


class SkinningTarget(LookedUp):
    """Mean squared difference of the decoded skinning weights from the body's.

    The body's weights at the Gaussians are looked up now and then; the released code does it at
    every step.
    """

    name = "target"

    def loss(self, step: Step[HugsModel]) -> dict[str, Tensor]:
        """``skinning``, mean over Gaussians and joints."""
        assert isinstance(step.drawing, HugsDrawing)
        decoded = step.drawing.decoded
        body = step.model.track.body
        places = (step.model.human.means + decoded.offsets).detach()
        target = self.looked_up(
            lambda: body_weights(places, body.canonical_vertices(), body.weights), places.device
        )
        return {"skinning": (decoded.weights - target).square().mean()}
