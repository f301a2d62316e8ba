"""Peak signal-to-noise ratio and structural similarity of two images, every choice explicit."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from evsplat.compiled import native, runs_native
from evsplat.devices import constant


def psnr(
    image: Float[Tensor, "H W C"],
    reference: Float[Tensor, "H W C"],
    *,
    mask: Bool[Tensor, "H W"] | None = None,
) -> Float[Tensor, ""]:
    """-10 log10(MSE) of pictures in [0, 1], over all pixels and channels; infinite for equal ones.

    With ``mask`` only its true pixels count; a mask without any is a ValueError.
    """
    _check_same_shape(image, reference)
    error = (image - reference).square()
    if mask is not None:
        if not bool(mask.any()):
            raise ValueError("the mask selects no pixel")
        error = error[mask]
    return -10.0 * torch.log10(error.mean())


def psnr_channel_mean(
    image: Float[Tensor, "H W C"], reference: Float[Tensor, "H W C"]
) -> Float[Tensor, ""]:
    """Mean of the PSNRs of the channels of pictures in [0, 1], dB; never below `psnr` (Jensen)."""
    _check_same_shape(image, reference)
    error = (image - reference).square().mean(dim=(0, 1))
    return (-10.0 * torch.log10(error)).mean()


@dataclass(frozen=True)
class Ssim:
    """One definition of structural similarity (Wang et al. 2004); each field changes the value."""

    window: Literal["gaussian", "uniform"] = "gaussian"
    size: int = 11
    """Side of the square window in pixels, odd."""
    sigma: float = 1.5
    """Standard deviation of the Gaussian window in pixels; not read by the uniform one."""
    padding: Literal["valid", "zero"] = "valid"
    """valid: only windows inside the image count. zero: they reach over its border into zeros."""
    data_range: float = 1.0
    """Largest minus smallest possible value; the stabilising constants scale with its square."""
    sample_covariance: bool = False
    """Divide (co)variances by N - 1 instead of N, N the number of pixels of the window."""

    @property
    def stabilisers(self) -> tuple[float, float]:
        """The constants C1 and C2 of Wang et al. 2004, with their K1 = 0.01 and K2 = 0.03."""
        return (0.01 * self.data_range) ** 2, (0.03 * self.data_range) ** 2


GAUSSIAN_SSIM = Ssim()
"""Gaussian 11/1.5, range 1: scikit-image's gaussian_weights, sigma=1.5, no sample covariance."""

SCIKIT_DEFAULT_SSIM = Ssim("uniform", 7, data_range=2.0, sample_covariance=True)
"""scikit-image's up to 0.19 for float images where no data range is given."""

ZERO_PADDED_SSIM = Ssim(padding="zero")
"""Gaussian 11/1.5, range 1, with zero padding: the SSIM of most 3DGS code."""


def ssim_map(
    image: Float[Tensor, "H W C"], reference: Float[Tensor, "H W C"], settings: Ssim
) -> Float[Tensor, "C h w"]:
    """Structural similarity at every window position; float64 input keeps its precision."""
    return SsimReference(reference, settings).map(image)


@dataclass(frozen=True, eq=False)
class SsimReference:
    """A picture that others are compared with, whose moments are found once."""

    picture: Float[Tensor, "H W C"]
    settings: Ssim = GAUSSIAN_SSIM

    def map(self, image: Float[Tensor, "H W C"]) -> Float[Tensor, "C h w"]:
        """As `ssim_map`.

        A ValueError where shapes differ, or no window fits into the picture.
        """
        settings = self.settings
        _check_same_shape(image, self.picture)
        if settings.size % 2 == 0:
            raise ValueError(f"the window's side must be odd, not {settings.size}")
        if settings.padding == "valid" and min(image.shape[:2]) < settings.size:
            raise ValueError(f"the {settings.size}-pixel window is larger than the image")
        parts = zip(self._parts(image), self._parts(self.picture), self._moments, strict=True)
        return torch.cat([self._similarity(*part) for part in parts])

    def _similarity(
        self,
        x: Float[Tensor, "c H W"],
        y: Float[Tensor, "c H W"],
        moments: tuple[Float[Tensor, "c h w"], ...],
    ) -> Float[Tensor, "c h w"]:
        """Of some planes, and the moments of those of the picture."""
        mean_x, mean_xx, mean_xy = self._means(x, x * x, x * y)
        mean_y, square_y, variance_y = moments
        square_x = mean_x**2
        variance_x = self._unbiased(mean_xx - square_x)
        covariance = self._unbiased(mean_xy - mean_x * mean_y)
        c1, c2 = self.settings.stabilisers
        luminance = (2 * mean_x * mean_y + c1) / (square_x + square_y + c1)
        structure = (2 * covariance + c2) / (variance_x + variance_y + c2)
        return luminance * structure

    @cached_property
    def _moments(self) -> list[tuple[Float[Tensor, "c h w"], ...]]:
        """Of each part: the mean, its square, and the variance in each window."""
        found: list[tuple[Tensor, ...]] = []
        for y in self._parts(self.picture):
            mean, mean_yy = self._means(y, y * y)
            square = mean**2
            found.append((mean, square, self._unbiased(mean_yy - square)))
        return found

    def _parts(self, picture: Float[Tensor, "H W C"]) -> tuple[Float[Tensor, "c H W"], ...]:
        """Planes to take together: one, which a cache holds; on a device all, in few operations."""
        planes = picture.movedim(-1, 0)
        return planes.split(1 if planes.device.type == "cpu" else len(planes))

    def _unbiased(self, moments: Float[Tensor, "C h w"]) -> Float[Tensor, "C h w"]:
        """Of a sample where the settings ask for it."""
        count = self.settings.size**2
        return count / (count - 1) * moments if self.settings.sample_covariance else moments

    def _means(self, *values: Float[Tensor, "C H W"]) -> tuple[Float[Tensor, "C h w"], ...]:
        """Weighted means in each window."""
        pad = self.settings.size // 2 if self.settings.padding == "zero" else 0
        if values[0].device.type == "cpu":
            return tuple(_smooth(planes, self.settings, pad) for planes in values)
        return _smooth(torch.cat(values), self.settings, pad).split(len(values[0]))


def _smooth(planes: Float[Tensor, "C H W"], settings: Ssim, pad: int) -> Float[Tensor, "C h w"]:
    """Weighted means in each window, ``pad`` pixels of zeros around the planes."""
    if planes.device.type != "cpu":
        # The number of operations counts there; channels apart, as no tensor cores round those.
        weights = constant(_window(settings), planes)
        down = weights.expand(len(planes), 1, -1)[..., None]
        smooth = F.conv2d(planes[None], down, padding=(pad, 0), groups=len(planes))
        return F.conv2d(smooth, down.mT, padding=(0, pad), groups=len(planes))[0]
    if native is not None and planes.dtype == torch.float64 and not planes.requires_grad:
        return _native_means(planes, settings, pad)
    # Shifted sums: torch's convolution is many times slower in float64. A cache holds a plane.
    return torch.cat([_shifted_sums(plane, settings, pad) for plane in planes.split(1)])


def _native_means(
    planes: Float[Tensor, "C H W"], settings: Ssim, pad: int
) -> Float[Tensor, "C h w"]:
    """As `_shifted_sums` of each plane, in the same order."""
    rows, columns = (side + 2 * pad - settings.size + 1 for side in planes.shape[1:])
    means = planes.new_empty(len(planes), rows, columns)
    window = constant(_window(settings), planes)
    native.window_means(planes.contiguous(), window, pad, means, torch.get_num_threads())
    return means


def _shifted_sums(
    plane: Float[Tensor, "1 H W"], settings: Ssim, pad: int
) -> Float[Tensor, "1 h w"]:
    """Weighted means in each window of one plane.

    Its rows are taken as one line, on which sums are fastest; what reaches over the end of a row is
    left out.
    """
    size, kernel = settings.size, _window(settings)
    padded = F.pad(plane, (pad, pad, pad, pad)) if pad else plane
    _, height, width = padded.shape
    line = padded.reshape(-1)
    count = (height - size + 1) * width
    down = kernel[0] * line[:count]
    for k in range(1, size):
        down.add_(line[k * width : k * width + count], alpha=kernel[k])
    whole = count - size + 1
    across = kernel[0] * down[:whole]
    for k in range(1, size):
        across.add_(down[k : k + whole], alpha=kernel[k])
    rows, columns = height - size + 1, width - size + 1
    return across.as_strided((1, rows, columns), (whole, width, 1))


def ssim(
    image: Float[Tensor, "H W C"],
    reference: Float[Tensor, "H W C"],
    settings: Ssim = GAUSSIAN_SSIM,
) -> Float[Tensor, ""]:
    """Mean structural similarity over channels and window positions.

    A ValueError where no window fits into the image.
    """
    if settings == GAUSSIAN_SSIM and _runs_native(image, reference):
        return _native_l1_ssim(image, reference)[1]
    return ssim_map(image, reference, settings).mean()


def l1_and_ssim(
    image: Float[Tensor, "H W C"], reference: Float[Tensor, "H W C"]
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Mean absolute difference, and `ssim` of `GAUSSIAN_SSIM`, for the cost of the latter."""
    if _runs_native(image, reference):
        return _native_l1_ssim(image, reference)
    fits = min(image.shape[:2]) >= GAUSSIAN_SSIM.size
    if fits and image.requires_grad and not reference.requires_grad:
        l1, similarity = _PlainL1Ssim.apply(image, reference)
        return l1, similarity
    return (image - reference).abs().mean(), ssim_map(image, reference, GAUSSIAN_SSIM).mean()


def _window(settings: Ssim) -> list[float]:
    """Weights along one axis of the window; they sum to one."""
    size = settings.size
    if settings.window == "uniform":
        return [1.0 / size] * size
    offsets = range(-(size // 2), size // 2 + 1)
    bell = [math.exp(-0.5 * (offset / settings.sigma) ** 2) for offset in offsets]
    return [weight / sum(bell) for weight in bell]


def _runs_native(image: Tensor, reference: Tensor) -> bool:
    _check_same_shape(image, reference)
    fits = min(image.shape[:2]) >= GAUSSIAN_SSIM.size
    return fits and runs_native(image) and not reference.requires_grad


def _native_l1_ssim(image: Tensor, reference: Tensor) -> tuple[Tensor, Tensor]:
    l1, similarity = _NativeL1Ssim.apply(image, reference)
    return l1, similarity


class _NativeL1Ssim(torch.autograd.Function):
    """`GAUSSIAN_SSIM` in the compiled module; the gradient is found on the way forward."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, reference: Tensor) -> tuple[Tensor, Tensor]:
        x, y = (picture.detach().movedim(-1, 0).contiguous() for picture in (image, reference))
        y = y.float()
        gradient = torch.empty_like(x) if ctx.needs_input_grad[0] else None
        window = torch.tensor(_window(GAUSSIAN_SSIM))
        constants = GAUSSIAN_SSIM.stabilisers
        similarity, difference = native.ssim(
            x, y, window, *constants, gradient, torch.get_num_threads()
        )
        planes, height, width = x.shape
        size = GAUSSIAN_SSIM.size
        ctx.positions = planes * (height - size + 1) * (width - size + 1)
        if gradient is not None:
            ctx.save_for_backward(x, y)
            ctx.similarity_gradient = gradient
        l1, mean = difference / x.numel(), similarity / ctx.positions
        return image.new_tensor(l1), image.new_tensor(mean)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None]:
        x, y = ctx.saved_tensors
        # In place, as a picture's gradient is asked for once; a copy would be another picture.
        gradient, ctx.similarity_gradient = ctx.similarity_gradient, None
        if gradient is None:
            raise RuntimeError("the gradient of l1_and_ssim was asked for twice; compute it anew")
        by_difference, scale = float(upstream[0]) / x.numel(), float(upstream[1]) / ctx.positions
        native.add_sign(x, y, by_difference, scale, gradient, torch.get_num_threads())
        return gradient.movedim(0, -1), None


class _PlainL1Ssim(torch.autograd.Function):
    """`l1_and_ssim` of `GAUSSIAN_SSIM` in plain torch; gradients are found on the way forward.

    Autograd would take three times as many operations, which is what a GPU waits for. Of sums
    s = x + y and differences d = x - y of the pictures, with squared means A and B in a window and
    variances V and W, twice the similarity's numerators are A - B + 2 c1 and V - W + 2 c2 and twice
    its denominators A + B + 2 c1 and V + W + 2 c2, both pairs in one operation.
    """

    @staticmethod
    def forward(ctx: Any, image: Tensor, reference: Tensor) -> tuple[Tensor, Tensor]:
        x, y = (picture.detach().movedim(-1, 0) for picture in (image, reference))
        settings = GAUSSIAN_SSIM
        # First s and d, then their squares.
        planes = x.new_empty(2, 2, *x.shape)
        torch.add(x, y.to(x.dtype), out=planes[0, 0])
        torch.sub(x, y.to(x.dtype), out=planes[0, 1])
        torch.mul(planes[0], planes[0], out=planes[1])
        means, squares = _smooth(planes.flatten(0, 2), settings, 0).unflatten(0, (2, 2, -1))
        # First A and B, then V and W.
        moments = means.new_empty(2, *means.shape)
        torch.mul(means, means, out=moments[0])
        torch.sub(squares, moments[0], out=moments[1])
        of_sums, of_differences = moments.unbind(1)
        twice = constant([[[[2 * c]]] for c in settings.stabilisers], x)
        of_sums = of_sums + twice
        under = of_sums + of_differences
        ratios = (of_sums - of_differences) / under
        similarity = ratios[0] * ratios[1]
        # Slopes by A and V, and those by B and W with the other sign.
        slopes, scale = moments, ratios.flip(0) / under
        less = scale * ratios
        torch.sub(scale, less, out=slopes[:, 0])
        torch.add(scale, less, out=slopes[:, 1])
        # By half of the means, on which the variances depend too, and by the means of squares.
        slopes[0].sub_(slopes[1]).mul_(means)
        # Windows are even: the sum over the windows of a pixel is again one of these means.
        back = _smooth(slopes.flatten(0, 2), settings, settings.size - 1)
        by_means, by_squares = back.unflatten(0, (2, 2, -1))
        half = torch.addcmul(by_means, planes[0], by_squares)
        ctx.windows, apart = similarity.numel(), planes[0, 1]
        ctx.save_for_backward(half[0] - half[1], apart)
        return apart.abs().mean(), similarity.mean()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None]:
        half, apart = ctx.saved_tensors
        by_l1, by_similarity = upstream[0] / apart.numel(), upstream[1] * (2 / ctx.windows)
        return torch.addcmul(half * by_similarity, apart.sign(), by_l1).movedim(0, -1), None


def _check_same_shape(image: Tensor, reference: Tensor) -> None:
    if image.shape != reference.shape:
        raise ValueError(f"images differ in shape: {tuple(image.shape)}, {tuple(reference.shape)}")
