"""A person at rest, ready to be moved by a skeleton alone: the mean over recorded times."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from evsplat.body import Body, BodyTrack, skin
from evsplat.capture import Camera
from evsplat.models.correctives import Correctives, bake_correctives
from evsplat.models.discs.shading import SurfaceLight
from evsplat.models.model import Model
from evsplat.render import Splats


@dataclass(frozen=True, eq=False)
class SkinnedGaussians:
    """H Gaussians in canonical space with weights of the body's J bones, and the light on them.

    What a pose does to a person beyond that (cloth, muscles, own shadow) is in the correctives.
    """

    body: Body
    means: Float[Tensor, "H 3"]
    """Centres, canonical metres."""
    quaternions: Float[Tensor, "H 4"]
    """Unit, (w, x, y, z)."""
    scales: Float[Tensor, "H 3"]
    """Standard deviations, metres."""
    opacities: Float[Tensor, " H"]
    rgb: Float[Tensor, "H 3"]
    """sRGB; without the light, where that is known."""
    weights: Float[Tensor, "H J"]
    """Of bones, each row sums to 1."""
    light: SurfaceLight | None
    """None: it is in the colours."""
    correctives: Correctives | None = None
    """None: what poses do beyond skinning is dropped."""

    def at_rest(self) -> Splats:
        """Splats in the canonical pose, without light; channels as those of `posed`."""
        identity = torch.eye(4).expand(1, self.weights.shape[1], 4, 4)
        return replace(self, light=None).posed(identity)

    @torch.no_grad()
    def posed(
        self, bones: Float[Tensor, "T J 4 4"], rotations: Float[Tensor, "T J 3 3"] | None = None
    ) -> Splats:
        """Splats for bone transforms canonical to world; channels R, G, B and 1 (a person).

        ``rotations`` of the joints against their parents bring the correctives in, if there are.
        """
        centers, rgb = self.means, self.rgb.expand(len(bones), -1, -1)
        if self.correctives is not None and rotations is not None:
            offsets, factors = self.correctives.at(rotations)
            centers, rgb = centers + offsets, rgb * factors
        means, transforms = skin(centers, self.weights, bones)
        if self.light is not None:
            rgb = rgb * self.light.factors(transforms, means)
        channels = torch.cat([rgb, torch.ones_like(rgb[..., :1])], -1)
        return Splats(
            means,
            self.quaternions,
            self.scales,
            self.opacities,
            channels,
            transforms[..., :3, :3],
        )


class Skinned(Model, Protocol):
    """A model whose person follows bones by weights that it can tell."""

    def following(self, track: BodyTrack) -> "Skinned":
        """A copy whose person does what ``track`` says; see `Model`."""
        ...

    def stay_together(self) -> None:
        """Keep neighbours on the person together in poses that were not recorded."""
        ...

    def pose(self, times_us: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Local rotations (T, J, 3, 3) and bone transforms canonical to world (T, J, 4, 4)."""
        ...

    def skinning_weights(self, centers: Float[Tensor, "N 3"]) -> Float[Tensor, "N J"]:
        """Weights of the bones for the person's Gaussians, their canonical centres (metres) here.

        Rows sum to 1.
        """
        ...

    def surface_light(self) -> SurfaceLight | None:
        """The light on the person's Gaussians, where it is learned apart from their colours."""
        ...


@torch.no_grad()
def mean_at_rest(model: Skinned, views: Sequence[tuple[int, Camera]]) -> SkinnedGaussians:
    """Mean of a model over ``views``, instants (us) and their cameras, as skinning can show it.

    Centre, log-scales, rotation and colour are the means of what the model shows at those instants
    with the skinning undone, and the light where the model knows it. That drops less than switching
    the pose-dependent part off: what all poses have in common stays. Weights are those at the mean
    centre.
    """
    light = model.surface_light()
    sums: list[Tensor] = []
    first: Tensor | None = None
    for view in views:
        shown = _undone(model, view, light)
        quaternions = shown.quaternions
        first = quaternions if first is None else first
        # q and -q are one rotation: only those on one side have a mean.
        quaternions = quaternions * torch.where((quaternions * first).sum(-1) < 0, -1, 1)[:, None]
        values = [
            shown.centers,
            shown.log_scales,
            quaternions,
            shown.rgb * shown.factors,
            shown.factors.square(),
        ]
        sums = [a + b for a, b in zip(sums, values, strict=True)] if sums else values
    centers, log_scales, quaternions, lit, squares = (
        (total / len(views)).float().cpu() for total in sums
    )
    return SkinnedGaussians(
        body=model.track.body.to("cpu"),
        means=centers,
        quaternions=normalize(quaternions, dim=-1),
        scales=log_scales.exp(),
        opacities=shown.opacities.cpu(),
        # The colour c with the least sum of (c * factor - rgb)^2.
        rgb=lit / squares,
        weights=model.skinning_weights(centers.to(model.device)).cpu(),
        light=None if light is None else _on_cpu(light),
    )


@torch.no_grad()
def with_correctives(
    rest: SkinnedGaussians, model: Skinned, views: Sequence[tuple[int, Camera]]
) -> SkinnedGaussians:
    """A person at rest and what the poses at ``views`` change of it, as correctives.

    These are where the centres go beside skinning and, as one factor for all channels, how bright
    the colours are: own shadow, clothes. What poses do to scales, rotations and hues is left out.
    """
    light = model.surface_light()
    changes = []
    for view in views:
        shown = _undone(model, view, light)
        plain = rest.rgb.to(shown.rgb) * shown.factors
        # The factor f with the least sum over the channels of (f * plain - rgb)^2.
        brightness = (shown.rgb * plain).sum(-1) / plain.square().sum(-1).clamp_min(1e-6)
        offsets = shown.centers - rest.means.to(shown.centers)
        changes.append(torch.cat([offsets, brightness[:, None] - 1], -1).float().cpu())
    rotations = model.pose([time_us for time_us, _ in views])[0].float().cpu()
    return replace(rest, correctives=bake_correctives(torch.stack(changes), rotations))


@dataclass(frozen=True, eq=False)
class _Undone:
    """What a model shows at an instant with the skinning and the light undone, in float64."""

    centers: Float[Tensor, "H 3"]
    log_scales: Float[Tensor, "H 3"]
    quaternions: Float[Tensor, "H 4"]
    opacities: Float[Tensor, " H"]
    rgb: Float[Tensor, "H 3"]
    """As shown, with the light."""
    factors: Float[Tensor, "H 3"]
    """Of the light alone, without own shadow; 1 where it is not known."""


def _undone(model: Skinned, view: tuple[int, Camera], light: SurfaceLight | None) -> _Undone:
    time_us, camera = view
    layers = model.at([time_us], camera.center().to(model.device), hard_semantics=True)
    person = layers.human
    transforms = layers.transforms[0].double()
    offset = person.means[0].double() - transforms[:, :3, 3]
    rgb = person.channels[0, :, :3].double()
    factors = torch.ones_like(rgb)
    if light is not None:
        factors = light.factors(layers.transforms, person.means)[0].double()
    return _Undone(
        centers=torch.linalg.solve(transforms[:, :3, :3], offset),
        # Covariances know no sign of a scale; decoders of HUGS may give either.
        log_scales=person.scales[0].double().abs().log(),
        quaternions=normalize(person.quaternions[0].double(), dim=-1),
        opacities=person.opacities,
        rgb=rgb,
        factors=factors,
    )


def _on_cpu(light: SurfaceLight) -> SurfaceLight:
    lamps = None if light.lamps is None else light.lamps.detach().cpu()
    return SurfaceLight(copy.deepcopy(light.shading).to("cpu"), light.normals.cpu(), lamps)
