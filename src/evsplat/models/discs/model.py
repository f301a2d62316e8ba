"""A closed surface of flat discs in the light of a room: the model of method `evsplat`.

Each Gaussian has a colour of its own (in a scene of random points a network gives it), and the
person's hang on the nearest point of the body's surface. Light falls on them from lamps, which the
person hides from the scene and itself; for what else the pose does to them a network is asked.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor, nn

from evsplat.body import BodyTrack, skin_with_linear, up_axis
from evsplat.camera import Camera, distinct
from evsplat.capture import Frame
from evsplat.gaussians import GaussianSet
from evsplat.models.discs.deformation import Deformation
from evsplat.models.discs.pose_shade import PoseShade
from evsplat.models.discs.reach import within_reach
from evsplat.models.discs.relief import Relief
from evsplat.models.discs.shading import NearestSurface, Shading, SurfaceLight
from evsplat.models.discs.shadow import BodyShadow, Lamps
from evsplat.models.discs.still import Still
from evsplat.models.drawing import Drawing, draw_for_training
from evsplat.models.kept import Kept
from evsplat.models.layers import SHADOW_STEP_PX, Layers, SceneShadow, human_splats
from evsplat.models.model import PosedModel, RowCache, nearest_time
from evsplat.models.networks.colour import SceneColour, scene_rgb
from evsplat.models.networks.non_rigid import draw_pose_noise
from evsplat.models.pose_correction import PoseCorrection
from evsplat.models.scene_places import SceneAlone, ScenePlaces

NORMAL_SAMPLES = 20_000
"""Points of the body's surface among which a Gaussian finds its normal and its bones."""
CASTERS = 400
"""Points of the body that hide lights."""
_PLACES_REFRESH = 8
"""Steps after which the places that shadows fall on are drawn anew."""
_TIMES_AT_ONCE = 1_024
"""Of the recorded poses, whose places alone are kept."""
_RELIEF_START = 500.0
"""Nominal iteration from which shadows tell where the scene lies; lamps need to be found first."""
_DIRECTION_DROPOUT = 0.5
"""Share of the steps that hide the view direction from the scene's network."""


@dataclass(frozen=True)
class _View:
    """Camera that colours are seen from."""

    center: Float[Tensor, "3"] | None
    """Where a network is asked for colours."""
    hide_direction: bool = False
    shown: tuple[Camera, ...] = ()
    """Only these cameras' pictures are asked for: one of all times, or one of each."""


class DiscModel(PosedModel):
    """Discs of person and scene, the light on them, and the body track."""

    residual: PoseCorrection | None

    def __init__(
        self,
        track: BodyTrack,
        frame_times_us: Sequence[int],
        gaussians: GaussianSet,
        *,
        width: int,
        shade_start: float,
        pose_noise: float,
        low_pass: float,
        shading: bool,
        lamps: int,
        self_shadow: bool,
        scene_network: bool,
        camera: Camera | None,
        residual: PoseCorrection | None,
        residual_start: float,
        deformation_start: float | None,
        deformation_freedom: float,
    ) -> None:
        """Start at ``gaussians``, whose colours are their own.

        With ``scene_network`` those of the scene are a network's, for points that start with random
        colours: a network learns at all of them what it is told of some, and that a view direction
        matters. It is told of the direction in half of the steps. The person's are then the first
        three of their features.

        ``camera``: the recording one where it stands still, which sees no depth of its scene.
        ``frame_times_us``: mid-exposures of the training frames, for where the person goes.
        ``width`` of the network of `PoseShade`, used from nominal iteration ``shade_start`` on.
        ``pose_noise``: standard deviation of what training adds to the matrices that it sees.
        ``deformation_start``: nominal iteration from which the person's shape changes in time where
        poses err; None: it never does.
        ``deformation_freedom``: see `Deformation`.
        """
        super().__init__(track)
        body = track.body
        self.gaussians, self._kept = gaussians, Kept()
        self.shade_start, self.pose_noise = shade_start, pose_noise
        self.low_pass = low_pass
        self.shade = PoseShade(track, frame_times_us, width)
        self.scene_colour = SceneColour() if scene_network else None
        self.residual, self.residual_start = residual, residual_start
        self.sensor: nn.Module | None = None
        """Learned properties of the event camera, set by a method that learns any."""
        generator = torch.Generator().manual_seed(0)
        surface = body.sample_surface(NORMAL_SAMPLES, generator)
        self.surface = NearestSurface(surface)
        self.deformation_start, self.deformation = deformation_start, None
        if deformation_start is not None:
            self.deformation = Deformation(frame_times_us, surface, freedom=deformation_freedom)
        times = torch.as_tensor(list(frame_times_us)).split(_TIMES_AT_ONCE)
        roots = torch.cat([track.at(some)[1] for some in times]) + body.rest_joints[0]
        middle = roots.mean(0).float()
        self.places = ScenePlaces(_PLACES_REFRESH)
        self.lamps: Lamps | None = None
        self.shadow: BodyShadow | None = None
        if lamps:
            self.lamps = Lamps(middle, up_axis(track), lamps)
            casters = body.sample_surface(CASTERS, generator)
            self.shadow = BodyShadow(casters, lamps, on_body=self_shadow and shading)
        self.relief = Relief(camera) if camera is not None and lamps else None
        self.shading: Shading | None = None
        if shading:
            radius = max(1.0, float((roots - middle).norm(dim=-1).max()))
            self.shading = Shading(middle, radius, lamps)

    @property
    def sets(self) -> dict[str, GaussianSet]:
        """The one set of both classes."""
        return {"gaussians": self.gaussians}

    @property
    def row_caches(self) -> dict[str, RowCache]:
        """The nearest points of the body's surface, and the scene's places in the pictures."""
        return {"surface": self.surface, "places": self.places}

    @property
    def residual_active(self) -> bool:
        """Whether the pose residual counts: from its start, or where it began at what was found."""
        found = self.residual is not None and bool(self.residual.started)
        return found or super().residual_active

    @property
    def shape_changes(self) -> Deformation | None:
        """What times do to the person's shape; None of exact poses.

        The man of `man_dance_hard_256`, whose body is skinned as ours, lost 0.4 dB by it.
        """
        exact = self.residual is None or bool(self.residual.exact)
        return None if exact else self.deformation

    @property
    def depends_on_view(self) -> bool:
        """Whether the scene's colours are a network's; own colours are those of every camera."""
        return self.scene_colour is not None

    def skinning_weights(self, centers: Float[Tensor, "N 3"]) -> Float[Tensor, "N J"]:
        """Weights of the bones that `at` draws the person's Gaussians with, for any centres."""
        return self.surface.weights(self.gaussians.means[self.gaussians.human])

    def surface_light(self) -> SurfaceLight | None:
        """The light on the person's Gaussians, where it is learned."""
        if self.shading is None:
            return None
        means = self.gaussians.means[self.gaussians.human]
        lamps = None if self.lamps is None else self.lamps.places()
        return SurfaceLight(self.shading, self.surface.normals(means), lamps)

    def at(
        self,
        times_us: Sequence[int],
        camera_center: Float[Tensor, "3"],
        *,
        hard_semantics: bool = False,
    ) -> Layers:
        """All Gaussians in world space; own colours are the same for every camera."""
        rotations, bones = self.pose(times_us)
        view = _View(camera_center)
        offsets = self._offsets(times_us)
        return self._layers(
            bones, rotations, offsets, slice(None), view, hard_semantics=hard_semantics
        )

    def training_drawing(
        self,
        times_us: Sequence[int],
        frame: Frame,
        cameras: Sequence[Camera],
        generator: torch.Generator,
    ) -> Drawing:
        """Pictures of a training step; see `Model`.

        The times of a step lie within a frame of each other: the network sees the pose, and the
        person has the shape, of the frame's middle alone; own shadows are looked up at the time
        nearest to it, from whose camera a network's colours of the scene are seen.
        """
        # Posed together: the skeleton is walked once for all times.
        turned, bones = self.pose([*times_us, frame.mid_us])
        bones, rotations = bones[:-1], turned[-1:]
        joints = rotations.shape[1]
        rotations = rotations + draw_pose_noise(joints, self.pose_noise, generator, self.device)
        nearest, shown = nearest_time(times_us, frame), distinct(cameras)
        view = _View(None, shown=shown)
        if self.scene_colour is not None:
            hidden = float(torch.rand((), generator=generator)) < _DIRECTION_DROPOUT
            view = _View(cameras[nearest].center(), hidden, shown)
        offsets = self._offsets([frame.mid_us])
        layers = self._layers(bones, rotations, offsets, slice(nearest, nearest + 1), view)
        return draw_for_training(layers, cameras, places=self.places)

    def following(self, track: BodyTrack) -> "DiscModel":
        """The same person doing what ``track`` says, without what times did; see `Model`."""
        model = copy.deepcopy(self)
        model.track = track.to(self.device)
        if model.residual is not None:
            model.residual.forget()
        if model.deformation is not None:
            model.deformation.forget()
        return model

    def stay_together(self) -> None:
        """For poses beyond the recorded: bones' weights without jumps, no disc far off the body."""
        gaussians, rows = self.gaussians, self.gaussians.human
        means = gaussians.means[rows].detach()
        self.surface.even_out(means)
        with torch.no_grad():
            sizes, turned = gaussians.scales_log[rows], gaussians.quaternions[rows]
            less = within_reach(means, turned, sizes.exp(), self.surface.surface)
            sizes += less.log()[:, None]

    def _offsets(self, times_us: Sequence[int]) -> Float[Tensor, "T H 3"] | None:
        """What times do to the person's shape; None where it does not change, or not yet."""
        changes, start = self.shape_changes, self.deformation_start
        if changes is None or start is None or float(self.nominal) < start:
            return None
        rows = self.surface.at(self.gaussians.means[self.gaussians.human])
        offsets: Tensor = changes(rows, times_us)
        return offsets

    def _layers(
        self,
        bones: Float[Tensor, "T J 4 4"],
        rotations: Float[Tensor, "#T J 3 3"],
        offsets: Float[Tensor, "#T H 3"] | None,
        lit_at: slice,
        view: _View,
        *,
        hard_semantics: bool = False,
    ) -> Layers:
        """Both classes under ``bones``; the network of shades sees ``rotations``.

        ``offsets``: of the person's canonical centres.

        ``lit_at``: the times, one or all, at which shadows on the person are looked up.
        """
        still = self._still(view, hard_semantics=hard_semantics)
        means, shape = still.means, (still.quaternions[None], still.scales[None], still.opacities)
        weights = self.surface.weights(means)[None]
        placed = means[None] if offsets is None else means + offsets
        world, transforms, linear = skin_with_linear(placed, weights, bones)
        casters = None if self.shadow is None else self.shadow.place(bones)
        light = self.surface_light()
        # Detached: a colour must not be bought by moving or turning the body.
        places = world.detach()
        scene = SceneAlone(still.scene, self.low_pass)
        lit, shaded = self._shadows(light, places[lit_at], casters, lit_at, scene, view.shown)
        rgb = still.rgb[None]
        if float(self.nominal) >= self.shade_start:
            rgb = rgb * self.shade(means, rotations)
        rgb = rgb * self._light(light, places, transforms, lit)
        return Layers(
            human_splats(world, *shape, rgb, still.semantics, linear),
            still.scene,
            transforms,
            self._cast(light, casters),
            self.low_pass,
            shaded,
        )

    def _still(self, view: _View, *, hard_semantics: bool) -> Still:
        """What is the same at all times, kept from one picture to the next where nobody learns."""
        colours = None if self.scene_colour is None else partial(self._scene_rgb, view)
        make = partial(Still.of, self.gaussians, colours, hard_semantics=hard_semantics)
        # A network's colours depend on the view; soft labels are asked for in training alone.
        if self.scene_colour is not None or not hard_semantics:
            return make()
        return self._kept.of([*self.gaussians.parameters()], make)

    def _scene_rgb(
        self,
        view: _View,
        colours: Float[Tensor, "S C"],
        means: Float[Tensor, "S 3"],
        scales: Float[Tensor, "S 3"],
    ) -> Float[Tensor, "S 3"]:
        """The network's colours of the scene, which may be black outside of the picture."""
        assert self.scene_colour is not None and view.center is not None
        return scene_rgb(
            self.scene_colour,
            colours,
            means,
            scales,
            view.center,
            shown=view.shown,
            hide_direction=view.hide_direction,
        )

    def _light(
        self,
        light: SurfaceLight | None,
        places: Float[Tensor, "T H 3"],
        transforms: Float[Tensor, "T H 4 4"],
        lit: Float[Tensor, "L #T H"] | None,
    ) -> Float[Tensor, "T H 3"] | float:
        """Factors on the person's colours; 1 without shading."""
        return 1.0 if light is None else light.factors(transforms.detach(), places, lit)

    def light_terms(self, layers: Layers, time_us: int) -> tuple[Tensor, Tensor]:
        """What the light on the person at a time is linear in, and the light itself.

        `Shading.terms` (1, H, K), and the factors (1, H, 3) on the colours of ``layers``.
        """
        light = self.surface_light()
        assert light is not None
        casters = None if self.shadow is None else self.shadow.place(self.pose([time_us])[1])
        places, transforms = layers.human.means.detach(), layers.transforms.detach()
        lit, _ = self._shadows(light, places, casters, slice(None))
        return light.terms(transforms, places, lit), light.factors(transforms, places, lit)

    def _shadows(
        self,
        light: SurfaceLight | None,
        places: Float[Tensor, "T H 3"],
        casters: Float[Tensor, "T P 3"] | None,
        at: slice,
        scene: SceneAlone | None = None,
        shown: tuple[Camera, ...] = (),
    ) -> tuple[Float[Tensor, "L T H"] | None, Float[Tensor, "T h w"] | None]:
        """Shares of the lamps' light that the body leaves its own ``places``, of the times ``at``.

        None: all of it. And where the pictures that are ``shown`` are known, the shadow in them,
        which costs less beside the other.
        """
        shadow, lamps = self.shadow, None if light is None else light.lamps
        if shadow is None or casters is None or not shadow.on_body or lamps is None:
            return None, None
        if scene is None or not shown:
            return shadow.lit(casters[at].detach(), places, lamps), None
        if len(shown) > 1:
            # What each camera sees lies in the shadow of its own time.
            fallen = [
                self._on_relief(partial(shadow, casters[time : time + 1], lamps=lamps))(
                    self.places.of(scene, camera, SHADOW_STEP_PX)
                )
                for time, camera in enumerate(shown)
            ]
            return shadow.lit(casters[at].detach(), places, lamps), torch.cat(fallen)
        lit: list[Tensor] = []

        def both(fallen_on: Float[Tensor, "h w 3"]) -> Float[Tensor, "T h w"]:
            factors, light_on_body = shadow.both(casters, fallen_on, places, lamps, at)
            lit.append(light_on_body)
            return factors

        shaded = self._on_relief(both)(self.places.of(scene, shown[0], SHADOW_STEP_PX))
        return lit[0], shaded

    def _cast(self, light: SurfaceLight | None, casters: Tensor | None) -> SceneShadow | None:
        """The shadow that the body throws on places of the scene."""
        shadow = self.shadow
        if shadow is None or self.lamps is None or casters is None:
            return None
        lamps = self.lamps.places() if light is None or light.lamps is None else light.lamps
        return self._on_relief(lambda places: shadow(casters, places, lamps))

    def _on_relief(self, shadow: SceneShadow) -> SceneShadow:
        """The same where the scene's places truly are, as far as that is learned."""
        relief = self.relief if float(self.nominal) >= _RELIEF_START else None
        return shadow if relief is None else lambda places: relief.shade(places, shadow)
