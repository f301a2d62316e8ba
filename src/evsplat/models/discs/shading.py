"""The person's surface: which of its points Gaussians lie on, and its brightness by its normal."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from evsplat.body.surface import SurfaceSamples
from evsplat.compiled import native, runs_native
from evsplat.devices import constant
from evsplat.gaussians.surface_graph import harmonic, laplacian
from evsplat.models.networks.spherical_harmonics import sh_basis
from evsplat.neighbours import nearest

_NORMAL_DIM = 9
_DARKEST, _BRIGHTEST = 0.2, 3.0
_NEAREST_M = 0.3
_EVEN = 1.0
"""Strength of a link between neighbours in `NearestSurface.even_out`, against a weight's own."""


class Shading(nn.Module):
    """A factor on the person's canonical colours, shared by all Gaussians and times.

    It is a polynomial of degree 2 in the world normal (nine spherical harmonics, the irradiance of
    distant light; Ramamoorthi and Hanrahan 2001) whose coefficients vary linearly with the place,
    per colour: 108 numbers, no pose among its inputs, so that what it learns holds for poses that
    no frame shows. Starts at 1 everywhere.
    """

    center: Tensor
    radius_m: Tensor
    quadratic: Tensor

    def __init__(self, center: Float[Tensor, "3"], radius_m: float, lamps: int = 0) -> None:
        """Places are relative to ``center``, in units of ``radius_m``: where the person goes."""
        super().__init__()
        self.register_buffer("center", center.clone())
        self.register_buffer("radius_m", torch.tensor(float(radius_m)))
        self.register_buffer("quadratic", _quadratic().float(), persistent=False)
        self.coefficients = nn.Parameter(torch.zeros(4, _NORMAL_DIM, 3))
        self.intensities = nn.Parameter(torch.zeros(lamps, 3))

    def terms(
        self,
        normals: Float[Tensor, "T N 3"],
        places: Float[Tensor, "T N 3"],
        lamps: Float[Tensor, "L 3"] | None = None,
        lit: Float[Tensor, "L #T N"] | None = None,
    ) -> Float[Tensor, "T N K"]:
        """What factors within the limits are linear in: the factor is 1 plus their weighted sum.

        Weights of the first 36 are `coefficients`, place by normal, and of the rest `intensities`.
        """
        terms = self.ambient(normals, places)
        if lamps is None:
            return nn.functional.pad(terms, (0, len(self.intensities)))
        each = self.falling(lamps, normals, places).light
        return torch.cat([terms, (each if lit is None else each * lit).movedim(0, -1)], -1)

    def ambient(
        self, normals: Float[Tensor, "T N 3"], places: Float[Tensor, "T N 3"]
    ) -> Float[Tensor, "T N 36"]:
        """The first of `terms`."""
        ends = nn.functional.pad(normals, (0, 1), value=1.0)
        turned = (ends[..., :, None] * ends[..., None, :]).flatten(-2) @ self.quadratic
        moved = ((places - self.center) / self.radius_m).clamp(-2, 2)
        around = nn.functional.pad(moved, (1, 0), value=1.0)
        return (around[..., :, None] * turned[..., None, :]).flatten(-2)

    def falling(
        self, lamps: Float[Tensor, "L 3"], normals: Float[Tensor, "T N 3"], places: Tensor
    ) -> "_Falling":
        """Light of lamps that hide nowhere, of intensity 1."""
        ray = lamps[:, None, None] - places
        apart = ray.norm(dim=-1)
        away = lamps - self.center
        reach = away.square().sum(-1)
        bright = reach[:, None, None] / (apart.clamp_min(_NEAREST_M).square() * apart)
        light = (ray * normals).sum(-1).clamp_min(0) * bright
        return _Falling(light, bright, apart, away, reach)

    def forward(
        self,
        normals: Float[Tensor, "T N 3"],
        places: Float[Tensor, "T N 3"],
        lamps: Float[Tensor, "L 3"] | None = None,
        lit: Float[Tensor, "L #T N"] | None = None,
    ) -> Float[Tensor, "T N 3"]:
        """Factors in 0.2..3 at unit world normals and world places (metres).

        ``lit``: share of each lamp's light that reaches the places; all of it without.
        """
        terms = self.terms(normals, places, lamps, lit)
        weights = torch.cat([self.coefficients.flatten(0, 1), self.intensities])
        return (1 + terms @ weights).clamp(_DARKEST, _BRIGHTEST)


class _Falling(NamedTuple):
    light: Float[Tensor, "L T N"]
    """Of lamps on places."""
    bright: Float[Tensor, "L T N"]
    """That by metre by which a place faces the lamp."""
    apart: Float[Tensor, "L T N"]
    """Distances, metres."""
    away: Float[Tensor, "L 3"]
    """Of the lamps from the middle, metres."""
    reach: Float[Tensor, "L"]
    """Its length, squared."""


def _quadratic() -> Float[Tensor, "16 9"]:
    """The basis of normals n as sums over the products of (n, 1) with itself."""
    points = torch.randn(100, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    points = nn.functional.normalize(points, dim=-1)
    ends = nn.functional.pad(points, (0, 1), value=1.0)
    products = (ends[:, :, None] * ends[:, None, :]).flatten(1)
    basis = torch.cat([torch.ones(100, 1, dtype=torch.float64), sh_basis(points, degree=2)], -1)
    return torch.linalg.pinv(products) @ basis


@dataclass(frozen=True, eq=False)
class SurfaceLight:
    """The light on Gaussians whose normals are known in canonical space."""

    shading: Shading
    normals: Float[Tensor, "N 3"]
    """Unit."""
    lamps: Float[Tensor, "L 3"] | None = None
    """Places, metres."""

    def factors(
        self,
        transforms: Float[Tensor, "T N 4 4"],
        places: Float[Tensor, "T N 3"],
        lit: Float[Tensor, "L #T N"] | None = None,
    ) -> Float[Tensor, "T N 3"]:
        """Factors on colours, for transforms canonical to world and world places (metres).

        ``lit`` as in `Shading`.
        """
        fixed = (transforms, self.normals, places)
        if all(runs_native(tensor) and not tensor.requires_grad for tensor in fixed):
            nothing = places.new_zeros(0, 3)
            factors: Tensor = _NativeLight.apply(
                *fixed,
                self.shading,
                self.shading.coefficients,
                nothing if self.lamps is None else self.lamps,
                nothing if self.lamps is None else self.shading.intensities,
                lit if self.lamps is not None else None,
            )
            return factors
        if self.lamps is None or any(tensor.requires_grad for tensor in fixed):
            return self.shading(self._turned(transforms), places, self.lamps, lit)
        shading = self.shading
        learned = shading.coefficients, shading.intensities, self.lamps
        plain: Tensor = _PlainLight.apply(shading, self._turned(transforms), places, *learned, lit)
        return plain

    def terms(
        self,
        transforms: Float[Tensor, "T N 4 4"],
        places: Float[Tensor, "T N 3"],
        lit: Float[Tensor, "L #T N"] | None = None,
    ) -> Float[Tensor, "T N K"]:
        """`Shading.terms`, for the same as `factors`."""
        return self.shading.terms(self._turned(transforms), places, self.lamps, lit)

    def _turned(self, transforms: Float[Tensor, "T N 4 4"]) -> Float[Tensor, "T N 3"]:
        turned = (transforms[..., :3, :3] @ self.normals[..., None])[..., 0]
        return nn.functional.normalize(turned, dim=-1)


class _PlainLight(torch.autograd.Function):
    """`Shading.forward` for a surface that learns nothing by it.

    Autograd would take twice as many operations for the gradients.
    """

    @staticmethod
    def forward(
        ctx: Any,
        shading: Shading,
        normals: Float[Tensor, "T N 3"],
        places: Float[Tensor, "T N 3"],
        coefficients: Float[Tensor, "4 9 3"],
        intensities: Float[Tensor, "L 3"],
        lamps: Float[Tensor, "L 3"],
        lit: Float[Tensor, "L #T N"] | None,
    ) -> Float[Tensor, "T N 3"]:
        falling = shading.falling(lamps, normals, places)
        lights = (falling.light if lit is None else falling.light * lit).movedim(0, -1)
        terms = torch.cat([shading.ambient(normals, places), lights], -1)
        weights = torch.cat([coefficients.flatten(0, 1), intensities])
        free = torch.addmm(constant((1.0,), terms), terms.flatten(0, 1), weights).view_as(places)
        factors = free.clamp(_DARKEST, _BRIGHTEST)
        ctx.sizes = coefficients.shape
        ctx.save_for_backward(normals, places, intensities, lamps, lit, terms, free, *falling)
        return factors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        normals, places, intensities, lamps, lit, terms, free, *each = ctx.saved_tensors
        falling, bright, apart, away, reach = each
        above = torch.ops.aten.hardtanh_backward(upstream[0], free, _DARKEST, _BRIGHTEST)
        above = above.flatten(0, 1)
        by_weights = terms.flatten(0, 1).mT @ above
        by_coefficients = by_weights[: -len(intensities)].view(ctx.sizes)
        by_light = (intensities @ above.mT).view_as(falling)
        by_lit = None
        if lit is not None:
            by_lit = (by_light * falling).sum_to_size(lit.shape)
            by_light = by_light * lit
        of_each = by_light * falling
        facing = torch.ops.aten.threshold_backward(by_light * bright, falling, 0)
        facing = facing.flatten(1) @ normals.flatten(0, 1)
        # The distance is in the light to the power of -3, and of -1 where it counts as the least.
        far = torch.add(constant((1.0,), apart), apart > _NEAREST_M, alpha=2)
        by_ray = of_each * far / apart.square()
        toward = torch.addmm(facing, by_ray.flatten(1), places.flatten(0, 1))
        share = of_each.sum((1, 2)) / reach
        by_lamps = torch.addcmul(toward, share[:, None], away, value=2)
        by_lamps = torch.addcmul(by_lamps, by_ray.sum((1, 2))[:, None], lamps, value=-1)
        return (None,) * 3 + (by_coefficients, by_weights[-len(intensities) :], by_lamps, by_lit)


class _NativeLight(torch.autograd.Function):
    """`SurfaceLight.factors` in the compiled module, for a surface that learns nothing by it."""

    @staticmethod
    def forward(
        ctx: Any,
        transforms: Tensor,
        normals: Tensor,
        places: Tensor,
        shading: Shading,
        *learned: Tensor | None,
    ) -> Tensor:
        *parts, lit = [None if t is None else t.detach().contiguous() for t in learned]
        coefficients, lamps, intensities = parts
        surface = [tensor.contiguous() for tensor in (transforms, normals, places)]
        room = shading.center.tolist(), float(shading.radius_m)
        ctx.given = (*surface, coefficients, *room, lamps, intensities, lit)
        factors = torch.empty_like(surface[2])
        native.surface_light(*ctx.given, factors, torch.get_num_threads())
        return factors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        coefficients, lamps, intensities, lit = (ctx.given[k] for k in (3, 6, 7, 8))
        sizes = [coefficients.numel(), lamps.numel(), intensities.numel()]
        sums = coefficients.new_empty(sum(sizes))
        by_lit = torch.empty_like(lit) if ctx.needs_input_grad[-1] else None
        native.surface_light_backward(
            *ctx.given, upstream[0].contiguous(), sums, by_lit, torch.get_num_threads()
        )
        parts = (
            part.view_as(like)
            for part, like in zip(
                sums.split(sizes), (coefficients, lamps, intensities), strict=True
            )
        )
        return None, None, None, None, *parts, by_lit


class NearestSurface:
    """Normals and bones of Gaussians by the nearest point of the canonical body's surface.

    Looked up again only after rows have changed: between two densifications a Gaussian moves by
    less than what turns the surface or changes the bones it hangs on.
    """

    def __init__(self, surface: SurfaceSamples) -> None:
        """``surface``: samples of the canonical body."""
        self.surface = surface
        self.index = torch.zeros(0, dtype=torch.long)
        self._found: tuple[Tensor, Tensor, Tensor] | None = None

    def normals(self, means: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Unit normals at the canonical centres of all Gaussians."""
        return self._at_all(means)[0]

    def weights(self, means: Float[Tensor, "N 3"]) -> Float[Tensor, "N J"]:
        """Skinning weights at the canonical centres of all Gaussians."""
        return self._at_all(means)[1]

    def at(self, means: Float[Tensor, "N 3"]) -> Int[Tensor, "N"]:
        """Numbers of the nearest points of the surface at the canonical centres."""
        self._at_all(means)
        return self.index

    def even_out(self, means: Float[Tensor, "N 3"]) -> None:
        """Let weights change evenly along the surface, until rows change.

        Each is drawn to those of the neighbours whose normals agree as much as to its own. Where
        bones meet, as under an arm, neighbouring Gaussians may have found points of the surface
        that go different ways.
        """
        normals, weights = self._at_all(means)
        rough = laplacian(means, normals, torch.ones_like(normals[:, :1]), None)
        even = harmonic(weights, torch.ones_like(weights[:, 0]), _EVEN * rough)
        self._found = (normals, even, self.index)

    def _at_all(self, means: Float[Tensor, "N 3"]) -> tuple[Tensor, Tensor]:
        if self.surface.points.device != means.device:
            self.surface = self.surface.to(means.device)
        if len(self.index) != len(means):
            self.index = nearest(self.surface.points, 1, means.detach())[1][:, 0]
        self.index = self.index.to(means.device)  # after a resume it is on the CPU
        if self._found is None or self._found[2] is not self.index:
            found = self.surface.normals[self.index], self.surface.weights[self.index]
            self._found = (*found, self.index)
        return self._found[:2]

    def rows_changed(self) -> None:
        """Row numbers mean other Gaussians now."""
        self.index = self.index[:0]

    def state(self) -> dict[str, Tensor]:
        """Tensors that a resume needs."""
        return {"index": self.index}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Take back what `state` gave; a `ValueError` where it names no points of the surface."""
        index, count = state["index"], len(self.surface.points)
        if (
            index.dtype != torch.long
            or index.dim() != 1
            or not bool(((index >= 0) & (index < count)).all())
        ):
            raise ValueError(f"surface.index holds others than the numbers of {count} points")
        self.index = index
