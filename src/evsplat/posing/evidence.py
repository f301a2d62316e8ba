"""What pictures say of a pose: landmarks in pixels, and the detector's own depths."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.posing.kinematics import Points, Posed
from evsplat.posing.rig import Rig
from evsplat.posing.views import Views


@dataclass(frozen=True)
class Terms:
    """Price of T pictures and its Gauss-Newton approximation, per time."""

    price: float
    square: Float[Tensor, "T S S"]
    slope: Float[Tensor, "T S"]
    border: Float[Tensor, "T S E"]
    corner: Float[Tensor, "E E"]
    shared_slope: Float[Tensor, "E"]


@dataclass(frozen=True, eq=False)
class Evidence:
    """Landmarks of T pictures that sit on a rig."""

    times_s: Float[Tensor, "T"]
    views: Views
    points: Points
    places: Float[Tensor, "T L 2"]
    sigma_px: Float[Tensor, "T L"]
    weight: Float[Tensor, "T L"]
    """How much each counts, 0 to 1."""
    depths: Float[Tensor, "T L"] | None
    """Along the view, from the middle of the hips, metres; the detector's."""
    hips: tuple[int, int]
    """Which of the landmarks are left and right hip."""

    def terms(
        self,
        rig: Rig,
        posed: Posed,
        scale_log: Float[Tensor, ""],
        *,
        depth: float,
        depth_m: float,
        blunt: float = 1.0,
    ) -> Terms:
        """Price of the posed rig: mean over the pictures.

        In standard deviations e, a landmark costs ``2 log(1 + e^2 / 4)``: half its square where it
        is near, hardly more where it is lost (a limb that the detector took for another pulls on
        nothing). A depth d costs ``depth (sqrt(1 + d^2) - 1) / 2``. The
        detector's depths are multiplied by ``exp(scale_log)``; ``blunt`` multiplies ``sigma_px``.
        """
        count = len(self.times_s)
        places = self.points.of(posed)
        by_vector, by_shape = self.points.jacobian(rig, posed)
        pixels, by_place = self.views.project(places)
        off = pixels - self.places
        sigma = blunt * self.sigma_px
        ratio = 1 + off.square().sum(-1) / sigma**2 / 4
        price = 2 * (self.weight * ratio.log()).sum()
        weight = self.weight / sigma**2 / ratio / count
        rate = (by_place @ by_vector).flatten(1, 2)
        shared = by_shape.shape[-1] + 1
        rate_shared = torch.zeros(count, rate.shape[1], shared, dtype=rate.dtype)
        rate_shared[..., :-1] = (by_place @ by_shape).flatten(1, 2)
        rates, weights = [rate], [weight.repeat_interleave(2, 1)]
        rates_shared, errors = [rate_shared], [off.flatten(1)]
        if self.depths is not None and depth > 0:
            error, deep, deep_shared = self._depth_errors(places, by_vector, by_shape, scale_log)
            root = (1 + (error / depth_m) ** 2).sqrt()
            price = price + 0.5 * depth * (self.weight * (root - 1)).sum()
            weights.append(0.5 * depth * self.weight / depth_m**2 / root / count)
            rates.append(deep)
            rates_shared.append(deep_shared)
            errors.append(error)
        rate, rate_shared = torch.cat(rates, 1), torch.cat(rates_shared, 1)
        weight, error = torch.cat(weights, 1), torch.cat(errors, 1)
        weighted = rate * weight[..., None]
        weighted_shared = rate_shared * weight[..., None]
        return Terms(
            price=float(price) / count,
            square=weighted.mT @ rate,
            slope=(weighted.mT @ error[..., None])[..., 0],
            border=weighted.mT @ rate_shared,
            corner=(weighted_shared.mT @ rate_shared).sum(0),
            shared_slope=(weighted_shared * error[..., None]).sum((0, 1)),
        )

    def price(
        self,
        posed: Posed,
        scale_log: Float[Tensor, ""],
        *,
        depth: float,
        depth_m: float,
        blunt: float = 1.0,
    ) -> Float[Tensor, "T"]:
        """The price of each picture, as in `terms`."""
        places = self.points.of(posed)
        off = self.views.project(places)[0] - self.places
        ratio = 1 + off.square().sum(-1) / (blunt * self.sigma_px) ** 2 / 4
        price = 2 * (self.weight * ratio.log()).sum(-1)
        if self.depths is not None and depth > 0:
            error = self._depth_error(places, scale_log)[0] / depth_m
            root = (1 + error**2).sqrt()
            price = price + 0.5 * depth * (self.weight * (root - 1)).sum(-1)
        return price

    def _depth_error(
        self, places: Float[Tensor, "T L 3"], scale_log: Float[Tensor, ""]
    ) -> tuple[Float[Tensor, "T L"], Float[Tensor, "T 3"]]:
        """Depth from the hips minus the detector's, metres; and the direction of depth."""
        assert self.depths is not None
        middle = places[:, list(self.hips)].mean(1)
        away = torch.nn.functional.normalize(middle - self.centres(), dim=-1)
        deep = ((places - middle[:, None]) * away[:, None]).sum(-1)
        return deep - self.depths * scale_log.exp(), away

    def _depth_errors(
        self, places: Tensor, by_vector: Tensor, by_shape: Tensor, scale_log: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """With derivatives; the direction of depth is taken as fixed."""
        assert self.depths is not None
        error, away = self._depth_error(places, scale_log)
        hips = list(self.hips)
        deep = [
            torch.einsum("tc,tlcs->tls", away, rate - rate[:, hips].mean(1, keepdim=True))
            for rate in (by_vector, by_shape)
        ]
        by_scale = -(self.depths * scale_log.exp())[..., None]
        return error, deep[0], torch.cat((deep[1], by_scale), -1)

    def centres(self) -> Float[Tensor, "T 3"]:
        """Optical centres in the world."""
        shift = self.views.world_to_camera[:, :3, 3, None]
        return -(self.views.rotation.mT @ shift)[..., 0]
