"""Protocols: named sets of choices by which pictures are measured, and means over frames.

The same picture gets other figures under each protocol.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from evsplat.evaluation.regions import CROP_MARGIN, Absent
from evsplat.pictures.box import Box, mask_box
from evsplat.similarity.perceptual import Features, PerceptualMetric
from evsplat.similarity.psnr_ssim import (
    GAUSSIAN_SSIM,
    SCIKIT_DEFAULT_SSIM,
    ZERO_PADDED_SSIM,
    Ssim,
    SsimReference,
    psnr,
    psnr_channel_mean,
    ssim_map,
)

REGIONS = ("full", "person_crop", "person_mask")
METRICS = ("psnr", "ssim", "lpips_alex", "lpips_vgg", "st_lpips")

PSNR_CEILING_DB = 100.0
"""Equal pictures have an infinite PSNR, which no mean survives and JSON cannot hold."""


Value = float | Absent
Measured = dict[str, dict[str, Value]]
"""Region -> metric -> value, every region and metric present."""
Networks = Mapping[str, PerceptualMetric | Absent]
"""The network distances ``lpips_alex``, ``lpips_vgg`` and ``st_lpips``."""


@dataclass(frozen=True)
class Protocol:
    """A way of comparing a rendered picture with the true one."""

    name: str
    summary: str
    """One line for the foot of a table."""
    eight_bit: bool
    """Clamp to [0, 1] and round to 8 bits first, as a saved picture is."""
    psnr: Literal["all_values", "channel_mean"]
    """One mean squared error of all values, or the mean of one PSNR per channel."""
    ssim: Ssim
    perceptual: tuple[str, ...]
    """The network distances that belong to the protocol."""
    perceptual_range: tuple[float, float]
    """Range that [0, 1] is mapped to before the networks see it."""
    perceptual_clip: bool
    """Clip the rendered picture at 1 (but not at 0) before the networks see it."""
    crop: Literal["enlarged", "tight"]
    """Person crop: box enlarged by 10 % per side, or the box without its last row and column."""
    mask: Literal["pixels", "blackened"]
    """Person mask: PSNR of its pixels only, or all figures with both pictures black outside."""


STANDARD = Protocol(
    name="standard",
    summary="clamped and rounded to 8 bit; PSNR over all pixels and channels; SSIM Gaussian "
    "11/1.5, data range 1; LPIPS on [-1, 1]; crop: person's box + 10 % per side",
    eight_bit=True,
    psnr="all_values",
    ssim=GAUSSIAN_SSIM,
    perceptual=("lpips_alex", "lpips_vgg", "st_lpips"),
    perceptual_range=(-1.0, 1.0),
    perceptual_clip=False,
    crop="enlarged",
    mask="pixels",
)

AVATAR_COMPAT = Protocol(
    name="avatar-compat",
    summary="as 3DGS-Avatar evaluates: not clamped, not rounded; SSIM uniform 7x7, data range 2 "
    "(generous); LPIPS VGG on [-1, 1]",
    eight_bit=False,
    psnr="all_values",
    ssim=SCIKIT_DEFAULT_SSIM,
    perceptual=("lpips_vgg",),
    perceptual_range=(-1.0, 1.0),
    perceptual_clip=False,
    crop="enlarged",
    mask="pixels",
)
"""3DGS-Avatar's evaluator for ZJU: scikit-image 0.19.3 is given no data range and takes 2.

It has no crops; the person's regions are ours, so that the rows can be compared.
"""

HUGS_COMPAT = Protocol(
    name="hugs-compat",
    summary="as HUGS evaluates: not rounded; PSNR is the mean of three per-channel PSNRs; SSIM "
    "Gaussian 11/1.5 with zero padding; LPIPS AlexNet on [0, 1]; crop: tight box; mask: both "
    "pictures black outside",
    eight_bit=False,
    psnr="channel_mean",
    ssim=ZERO_PADDED_SSIM,
    perceptual=("lpips_alex",),
    perceptual_range=(0.0, 1.0),
    perceptual_clip=True,
    crop="tight",
    mask="blackened",
)
"""HUGS's validation: the box is [min, max) of the mask's rows and columns, the last ones left out;
masking both pictures is what it does for the data set called zju."""

PROTOCOLS = (STANDARD, AVATAR_COMPAT, HUGS_COMPAT)


@dataclass(frozen=True, eq=False)
class Truth:
    """One true picture and where the person is in it, under one protocol.

    The features of the true picture are computed once for all pictures compared with it.
    """

    protocol: Protocol
    image: Float[Tensor, "H W 3"]
    mask: Bool[Tensor, "H W"] | None
    """The person's pixels, where the capture has masks."""
    human: Box | Absent
    """Tight box around the person."""
    networks: Networks

    def measure(self, image: Float[Tensor, "H W 3"]) -> Measured:
        """Every metric of every region; ``image`` is sRGB in [0, 1]."""
        image = self._prepared(image)
        whole = self._full.similarity(image)
        result: Measured = {}
        for region in REGIONS:
            part = self._regions[region]
            result[region] = (
                dict.fromkeys(METRICS, part)
                if isinstance(part, Absent)
                else part.measure(part.cut(image), whole)
            )
        return result

    def _prepared(self, image: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
        # float64: variances as differences of squares lose digits in float32.
        image = image.detach().cpu().double()
        return eight_bit(image) if self.protocol.eight_bit else image

    @cached_property
    def _full(self) -> "_Region":
        return _Region(self.protocol, self._prepared(self.image), self.networks)

    @cached_property
    def _regions(self) -> dict[str, "_Region | Absent"]:
        full, truth = self._full, self._full.truth
        return {"full": full, "person_crop": self._crop(truth), "person_mask": self._masked(truth)}

    def _crop(self, truth: Float[Tensor, "H W 3"]) -> "_Region | Absent":
        if isinstance(self.human, Absent):
            return self.human
        if self.protocol.crop == "enlarged":
            box = self.human.enlarged(CROP_MARGIN, *truth.shape[:2])
        else:
            box = self.human.without_last()
        if box.bottom <= box.top or box.right <= box.left:
            return Absent("the person's box is empty")
        return _Region(self.protocol, box.crop(truth), self.networks, box=box)

    def _masked(self, truth: Float[Tensor, "H W 3"]) -> "_Region | Absent":
        if self.mask is None:
            return Absent("the capture has no person mask for this picture")
        if not bool(self.mask.any()):
            return Absent("the person mask is empty")
        if self.protocol.mask == "pixels":
            return _Region(self.protocol, truth, self.networks, pixels=self.mask)
        black = truth * self.mask[..., None]
        return _Region(self.protocol, black, self.networks, blacken=self.mask)


@dataclass(frozen=True, eq=False)
class _Region:
    """One region of the true picture, ready to be compared."""

    protocol: Protocol
    truth: Float[Tensor, "h w 3"]
    networks: Networks
    box: Box | None = None
    pixels: Bool[Tensor, "h w"] | None = None
    """Single pixels that count alone, for which PSNR alone is defined."""
    blacken: Bool[Tensor, "h w"] | None = None

    def cut(self, image: Float[Tensor, "H W 3"]) -> Float[Tensor, "h w 3"]:
        if self.blacken is not None:
            return image * self.blacken[..., None]
        return image if self.box is None else self.box.crop(image)

    def measure(
        self, image: Float[Tensor, "h w 3"], whole: Float[Tensor, "3 H W"] | Absent
    ) -> dict[str, Value]:
        """Every metric of the region; ``whole`` is the `similarity` of the whole pictures."""
        values: dict[str, Value] = {"psnr": self._psnr(image)}
        if self.pixels is not None:
            reason = Absent("only PSNR is defined for single pixels; see person_crop")
            return values | dict.fromkeys(METRICS[1:], reason)
        windows = self._windows(image, whole)
        values["ssim"] = windows if isinstance(windows, Absent) else float(windows.mean())
        seen = image.clamp(max=1.0) if self.protocol.perceptual_clip else image
        for name in METRICS[2:]:
            values[name] = self._distance(name, seen)
        return values

    def similarity(self, image: Float[Tensor, "h w 3"]) -> Float[Tensor, "3 y x"] | Absent:
        """Structural similarity in each window; Absent where none fits into the region."""
        try:
            return self._ssim_truth.map(image)
        except ValueError as error:
            return Absent(str(error))

    def _windows(
        self, image: Float[Tensor, "h w 3"], whole: Float[Tensor, "3 H W"] | Absent
    ) -> Float[Tensor, "3 y x"] | Absent:
        """As `similarity`, out of that of the whole pictures where it is the same there."""
        settings = self.protocol.ssim
        if self.blacken is not None and settings.padding == "zero":
            return self._around(image, self.blacken)
        if self.box is None and self.blacken is None:
            return whole
        inside = settings.padding == "valid" and min(image.shape[:2]) >= settings.size
        if self.box is None or isinstance(whole, Absent) or not inside:
            return self.similarity(image)
        # Windows inside the box are windows of the picture; in one piece, as sums depend on that.
        box, last = self.box, settings.size - 1
        return whole[:, box.top : box.bottom - last, box.left : box.right - last].contiguous()

    def _around(
        self, image: Float[Tensor, "h w 3"], seen: Bool[Tensor, "h w"]
    ) -> Float[Tensor, "3 h w"]:
        """As `similarity` of pictures that are black elsewhere: black windows are alike."""
        settings, (height, width) = self.protocol.ssim, seen.shape
        box = mask_box(seen)
        assert box is not None  # regions without a pixel are absent
        reach = settings.size // 2
        box = box.wider(reach, reach, height, width)
        windows = image.new_ones(image.shape[2], height, width)
        windows[:, box.top : box.bottom, box.left : box.right] = ssim_map(
            box.crop(image), box.crop(self.truth), settings
        )
        return windows

    def _psnr(self, image: Float[Tensor, "h w 3"]) -> float:
        if self.pixels is not None:
            value = psnr(image, self.truth, mask=self.pixels)
        elif self.protocol.psnr == "all_values":
            value = psnr(image, self.truth)
        else:
            value = psnr_channel_mean(image, self.truth)
        return min(float(value), PSNR_CEILING_DB)

    def _distance(self, name: str, image: Float[Tensor, "h w 3"]) -> Value:
        if name not in self.protocol.perceptual:
            return Absent(f"not part of protocol {self.protocol.name}")
        network = self.networks[name]
        if isinstance(network, Absent):
            return network
        try:
            with torch.no_grad():
                if name not in self._truth_features:
                    self._truth_features[name] = network.features(self._ranged(self.truth))
                features = network.features(self._ranged(image))
                return float(network.compare(features, self._truth_features[name]))
        except ValueError as error:
            return Absent(str(error))

    @cached_property
    def _ssim_truth(self) -> SsimReference:
        return SsimReference(self.truth, self.protocol.ssim)

    @cached_property
    def _truth_features(self) -> dict[str, Features]:
        return {}

    def _ranged(self, image: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
        low, high = self.protocol.perceptual_range
        return low + (high - low) * image


def eight_bit(image: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """The values that an 8-bit file of ``image`` holds, in [0, 1]."""
    return (image.clamp(0, 1) * 255).round() / 255


class MetricMeans:
    """Means over frames of what was measured in each, with the reason wherever there is none."""

    def __init__(self, regions: tuple[str, ...] = REGIONS) -> None:
        self._values: dict[tuple[str, str], list[Value]] = {
            (region, metric): [] for region in regions for metric in METRICS
        }

    def add(self, measured: Measured) -> None:
        """Add one frame's figures; regions that were not asked for are ignored."""
        for (region, metric), values in self._values.items():
            values.append(measured[region][metric])

    def means(self) -> tuple[dict[str, dict[str, float | None]], dict[str, str]]:
        """Mean per region and metric over the frames that have it, and "region.metric" -> reason.

        A figure that some frames lack keeps a reason that says how many.
        """
        means: dict[str, dict[str, float | None]] = {}
        reasons: dict[str, str] = {}
        for (region, metric), values in self._values.items():
            numbers = [value for value in values if not isinstance(value, Absent)]
            gaps = [value.reason for value in values if isinstance(value, Absent)]
            means.setdefault(region, {})[metric] = sum(numbers) / len(numbers) if numbers else None
            if gaps and numbers:
                reasons[f"{region}.{metric}"] = (
                    f"missing in {len(gaps)} of {len(values)}: {gaps[0]}"
                )
            elif not numbers:
                reasons[f"{region}.{metric}"] = gaps[0] if gaps else "no picture to measure"
        return means, reasons


def without_reasons(measured: Measured) -> dict[str, Any]:
    """The figures of one frame for JSON: None where one was not measured."""
    return {
        region: {
            metric: None if isinstance(value, Absent) else value for metric, value in values.items()
        }
        for region, values in measured.items()
    }


def all_absent(reason: str) -> Measured:
    """Every figure missing for one reason."""
    return {region: dict.fromkeys(METRICS, Absent(reason)) for region in REGIONS}
