"""HUGS's losses: both sets against the picture, the person alone against its pixels (2.4)."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from evsplat.capture import Frame, TrainingCapture
from evsplat.devices import DeviceCache, send
from evsplat.models.hugs.model import HugsDrawing, HugsModel
from evsplat.models.hugs.start import body_weights
from evsplat.objectives.base import Stateless, Step, picture
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


class Perceptual:
    """Mean perceptual distance of random squares, most of them on the person."""

    def __init__(self, metric: PerceptualMetric) -> None:
        self.metric = metric

    def __call__(
        self,
        image: Float[Tensor, "H W 3"],
        reference: Float[Tensor, "H W 3"],
        mask: Float[Tensor, "H W"],
        generator: torch.Generator,
    ) -> Float[Tensor, ""]:
        """Distance of ``image`` from ``reference``, both in [0, 1]."""
        # To the [-1, 1] that the networks expect; the released code leaves it out.
        image, reference = 2 * image - 1, 2 * reference - 1
        squares = draw_squares(mask.cpu() > 0.5, generator)
        distances = [
            self.metric(image[rows, cols], reference[rows, cols]) for rows, cols in squares
        ]
        return torch.stack(distances).mean()


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


class JointPicture(Stateless):
    """Everything, over the step's random colour, against the recorded picture."""

    def __init__(self, capture: TrainingCapture, perceptual: Perceptual | None) -> None:
        """Pictures and, for the perceptual squares, masks are the capture's."""
        self.capture, self.perceptual = capture, perceptual

    def times(self, frame: Frame, nominal: float) -> Sequence[int]:
        """The middle of the exposure."""
        return (frame.mid_us,)

    def loss(self, step: Step) -> dict[str, Tensor]:
        """``l1``, ``dssim`` and ``perceptual``, means over the picture."""
        drawn = step.rgb[step.index(step.frame.mid_us)].clamp(0, 1)
        observed = step.observed(step.frame)
        l1, similarity = l1_and_ssim(drawn, observed)
        terms = {"l1": l1, "dssim": 1 - similarity}
        if self.perceptual is not None:
            mask = step.data.get(
                ("mask", step.frame.name), lambda: mask_of(self.capture, step.frame)
            )
            terms["perceptual"] = self.perceptual(drawn, observed, mask, step.generator)
        return terms


class HumanPicture(Stateless):
    """The person alone against its pixels, both over a random colour of the step."""

    def __init__(self, capture: TrainingCapture, perceptual: Perceptual | None) -> None:
        """Pictures and masks are the capture's."""
        self.capture, self.perceptual = capture, perceptual

    def times(self, frame: Frame, nominal: float) -> Sequence[int]:
        """The middle of the exposure."""
        return (frame.mid_us,)

    def prefetch(self, frame: Frame, nominal: float, data: DeviceCache) -> None:
        """The recorded picture and the mask."""
        data.prefetch(*picture(self.capture, frame))
        data.prefetch(("mask", frame.name), lambda: mask_of(self.capture, frame))

    def loss(self, step: Step[HugsModel]) -> dict[str, Tensor]:
        """``human_l1``, ``human_dssim`` and ``human_perceptual``.

        The L1 is a sum over pixels and channels by the number of the person's pixels; 1 - SSIM is a
        mean over the picture times the person's share of it. Outside of the person the perceptual
        distance sees noise in place of the colour.
        """
        index, observed = step.index(step.frame.mid_us), step.observed(step.frame)
        mask = step.data.get(("mask", step.frame.name), lambda: mask_of(self.capture, step.frame))
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
            terms["human_perceptual"] = self.perceptual(shown, wanted, mask, step.generator)
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


class SkinningTarget:
    """Mean squared difference of the decoded skinning weights from the body's.

    The body's weights at the Gaussians are looked up every ``refresh`` steps and after
    densification, as centres move slowly; the released code does it at every step.
    """

    def __init__(self, *, refresh: int) -> None:
        """Nothing is looked up before the first step."""
        self.refresh, self.age = refresh, 0
        self.target = torch.zeros(0, 0)

    def times(self, frame: Frame, nominal: float) -> Sequence[int]:
        """None of its own."""
        return ()

    def prefetch(self, frame: Frame, nominal: float, data: DeviceCache) -> None:
        """Nothing recorded is needed."""

    def loss(self, step: Step[HugsModel]) -> dict[str, Tensor]:
        """``skinning``, mean over Gaussians and joints."""
        assert isinstance(step.drawing, HugsDrawing)
        decoded = step.drawing.decoded
        if self.age == 0 or self.age >= self.refresh:
            places = (step.model.human.means + decoded.offsets).detach()
            body = step.model.track.body
            self.target = body_weights(places, body.canonical_vertices(), body.weights)
            self.age = 0
        self.age += 1
        self.target = self.target.to(decoded.weights.device)  # after a resume
        return {"skinning": (decoded.weights - self.target).square().mean()}

    def rows_changed(self) -> None:
        """Row numbers mean other Gaussians now."""
        self.age = 0

    def state(self) -> dict[str, Tensor]:
        """The weights and how many steps ago they were looked up."""
        return {"target": self.target, "age": torch.tensor(self.age)}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Take back what `state` gave."""
        self.target, self.age = state["target"], int(state["age"])
