"""A person and a scene in one Gaussian set, posed at any time: the paper's model (eq. 1-7)."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from evsplat.body import BodyTrack, bounding_box, skin, up_axis
from evsplat.body.rotations import axis_angle_to_matrix
from evsplat.capture import Camera, Frame
from evsplat.deform.colour import HumanColour, SceneColour, view_directions, view_jitter
from evsplat.deform.drawing import Drawing, draw
from evsplat.deform.frame_weights import UnseenFrames, interpolated, seen, seen_or_last
from evsplat.deform.lamps import Lamps
from evsplat.deform.model import RowCache
from evsplat.deform.non_rigid import NonRigidNetwork
from evsplat.deform.pose_encoder import PoseEncoder, normalise_joints
from evsplat.deform.pose_spline import PoseSpline
from evsplat.deform.shading import NearestSurface, Shading, SurfaceLight
from evsplat.deform.shadow import BodyShadow
from evsplat.deform.skinning_network import SkinningNetwork
from evsplat.deform.skinning_turns import SkinningTurns
from evsplat.devices import send
from evsplat.errors import ConfigError
from evsplat.gaussians import (
    ATTRIBUTES,
    GaussianSet,
    PosedGaussians,
    PosedHuman,
    StaticScene,
)
from evsplat.gaussians.initialise import COLOUR_LOGITS
from evsplat.render import LOW_PASS, PinholeCamera, rows_in_view

NORMAL_SAMPLES = 20_000
"""Points of the body's surface among which a Gaussian finds its normal."""
CASTERS = 400
"""Points of the body that hide lights."""

Semantics = Literal["fixed", "ste", "rendered"]


@dataclass(frozen=True)
class DeformConfig:
    """Networks that move and colour Gaussians (3DGS-Avatar; reference 1.4-1.8)."""

    width: int = 128
    """Hidden width of the non-rigid and the skinning network."""
    non_rigid_depth: int = 3
    """Hidden layers of the non-rigid network."""
    non_rigid_last_std: float | None = 1e-3
    """Start of its last layer; null starts it at random as 3DGS-Avatar does, which makes every
    point jump when the network is switched on."""
    skinning_depth: int = 4
    """Hidden layers of the skinning network."""
    skinning: Literal["network", "surface"] = "network"
    """Where a Gaussian's skinning weights come from: the network (eq. 2), or the nearest point of
    the body's surface, which costs nothing and is what the network's prior asks for."""
    skinning_turns: int = 4
    """A training step looks up the skinning weights of one row in so many, in turns; 1 = of all."""
    human_colour: Literal["network", "own"] = "network"
    """The person's canonical colours: by the network, or a colour of each Gaussian's own."""
    colour_width: int = 64
    """Hidden width of the colour networks (A10)."""
    latent_dim: int = 16
    """Size of the per-frame latent of the person's colour."""
    non_rigid_start: float = 3_000
    """Nominal iteration at which the non-rigid network is switched on (A9)."""
    pose_noise: float = 0.1
    """Standard deviation of the noise on the rotation matrices fed to the pose encoder."""
    pose_noise_probability: float = 0.5
    """How often that noise is added in training."""
    view_noise: bool = True
    """Turn all canonical view directions of a training step at random, 45 degrees per axis."""
    view_noise_symmetric: bool = True
    """False: about the third axis by 0 to 45 degrees only, as the released 3DGS-Avatar does."""
    scene_view_dependent: bool = True
    """Whether the scene's colour sees the view direction (paper eq. 7, A10)."""
    scene_direction_dropout: float = 0.5
    """How often a training step hides that direction; a static camera cannot teach it (A10)."""
    networks_once: bool = False
    """Look the person's networks up once per training step, at the drawn frame's middle, instead
    of at each of its times, which lie within a frame of it."""
    shading: bool = False
    """The person's brightness depends on the surface's normal and place in the world."""
    shadow_lights: int = 0
    """Lamps at learned places, at most 16, whose shadows of the person fall on the scene and which,
    with ``shading``, light the person; 0 = none."""
    self_shadow: bool = False
    """With ``shading`` and lamps: parts of the person that are nearer to a lamp shade others."""
    pose_correction_start: float | None = None
    """Nominal iteration from which pose residuals are learned; null = never.
    3DGS-Avatar starts at 5000 (A9). Exact poses get worse by it, noisy ones better."""
    low_pass: float = LOW_PASS
    """What a pixel integrates over, px^2, at most 0.3, which 3DGS and viewers take."""
    unseen_frames: UnseenFrames = "interpolated"
    """Latent and pose residual of instants that are not the middle of a training frame (A22)."""


@dataclass(frozen=True)
class Noise:
    """Random perturbations of one training step, drawn outside so that a resume repeats them."""

    rotations: Float[Tensor, "T J 3 3"] | None
    """Added to what the pose encoder sees."""
    view_turn: Float[Tensor, "3 3"]
    """Rotation applied to canonical view directions."""
    hide_scene_direction: bool


class HumanSceneModel(nn.Module):
    """Gaussians, networks and the body track; `at` poses them at given times.

    ``frame_times_us`` are the mid-exposures of the training frames, the anchors of the per-frame
    latents and pose residuals; what other instants get is ``config.unseen_frames`` (A22). With a
    ``pose_spline`` the residuals are its control points instead.
    """

    def __init__(
        self,
        config: DeformConfig,
        semantics: Semantics,
        track: BodyTrack,
        frame_times_us: Sequence[int],
        gaussians: GaussianSet,
        pose_spline: PoseSpline | None = None,
    ) -> None:
        """Build the networks for the track's body; ``gaussians`` is the start."""
        super().__init__()
        body = track.body
        joints = len(body.parents)
        if not 0 < config.low_pass <= LOW_PASS:
            raise ConfigError(
                f"deform.low_pass is {config.low_pass}; it takes px^2 above 0 and up to {LOW_PASS}."
            )
        self.config, self.semantics, self.track = config, semantics, track
        self.gaussians = gaussians
        parents = body.parents.tolist()
        joints_seen = normalise_joints(body.rest_joints, body.rest_vertices)
        self.pose_encoder = PoseEncoder(parents, joints_seen)
        self.non_rigid = NonRigidNetwork(
            self.pose_encoder.dim,
            width=config.width,
            depth=config.non_rigid_depth,
            last_layer_std=config.non_rigid_last_std,
        )
        self.skinning: SkinningNetwork | None = None
        """None where weights are those of the nearest surface."""
        if config.skinning == "network":
            self.skinning = SkinningNetwork(
                parents, width=config.width, depth=config.skinning_depth
            )
        elif semantics == "ste":
            raise ConfigError(
                "semantics is ste, which deforms points far from the body, and deform.skinning is "
                "surface, which knows weights on it only; set deform.skinning=network."
            )
        self.skinning_turns = SkinningTurns(config.skinning_turns)
        self.human_colour: HumanColour | None = None
        """None where each Gaussian has a colour of its own."""
        if config.human_colour == "network":
            self.human_colour = HumanColour(latent_dim=config.latent_dim, width=config.colour_width)
        self.scene_colour = SceneColour(
            view_dependent=config.scene_view_dependent, width=config.colour_width
        )
        frames = len(frame_times_us)
        self.sensor: nn.Module | None = None
        """What is learned of the event camera, by methods that do."""
        self.shading: Shading | None = None
        self.shadow: BodyShadow | None = None
        self.row_caches: dict[str, RowCache] = {"skinning_turns": self.skinning_turns}
        generator = torch.Generator().manual_seed(0)
        if config.shading or config.skinning == "surface":
            surface = body.sample_surface(NORMAL_SAMPLES, generator)
            self.surface = NearestSurface(surface)
            self.row_caches["surface"] = self.surface
        self.lamps: Lamps | None = None
        if config.shading or config.shadow_lights:
            roots = track.at(torch.as_tensor(list(frame_times_us)))[1] + body.rest_joints[0]
            middle = roots.mean(0).float()
        if config.shadow_lights:
            self.lamps = Lamps(middle, up_axis(track), config.shadow_lights)
            casters = body.sample_surface(CASTERS, generator)
            self.shadow = BodyShadow(
                casters, config.shadow_lights, on_body=config.self_shadow and config.shading
            )
        if config.shading:
            radius = max(1.0, float((roots - middle).norm(dim=-1).max()))
            self.shading = Shading(middle, radius, config.shadow_lights)
        # Zero, not random: what a frame has not learned must not show between frames.
        self.latents = nn.Parameter(torch.zeros(frames, config.latent_dim))
        self.pose_spline = pose_spline
        anchors = frames if pose_spline is None else pose_spline.count
        self.rotation_residuals = nn.Parameter(torch.zeros(anchors, joints, 3))
        self.translation_residuals = nn.Parameter(torch.zeros(anchors, 3))
        low, high = bounding_box(body)
        self.box_low: Tensor
        self.box_high: Tensor
        self.nominal: Tensor
        self.register_buffer("box_low", low.float())
        self.register_buffer("box_high", high.float())
        self.register_buffer("frame_times", torch.tensor(frame_times_us, dtype=torch.float64))
        self.register_buffer("nominal", torch.zeros((), dtype=torch.float64))

    def _apply(self, fn: Any, recurse: bool = True) -> "HumanSceneModel":
        """Move to another device, the body track as well; progress stays where it is read."""
        nominal = self.nominal
        super()._apply(fn, recurse)
        self.nominal = nominal
        self.track = self.track.to(self.box_low.device)
        return self

    @property
    def device(self) -> torch.device:
        """Where the Gaussians are."""
        return self.box_low.device

    @property
    def low_pass(self) -> float:
        """What a pixel integrates over, px^2."""
        return self.config.low_pass

    @property
    def sets(self) -> dict[str, GaussianSet]:
        """The one set of both classes."""
        return {"gaussians": self.gaussians}

    @property
    def non_rigid_active(self) -> bool:
        """Whether training has reached the start of the non-rigid network."""
        return float(self.nominal) >= self.config.non_rigid_start

    @property
    def pose_correction_active(self) -> bool:
        """Whether training has reached the start of pose correction."""
        start = self.config.pose_correction_start
        return start is not None and float(self.nominal) >= start

    def normalise(self, positions: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
        """Canonical metres to [-1, 1] over the enlarged bounding box of the body."""
        return 2 * (positions - self.box_low) / (self.box_high - self.box_low) - 1

    def pose(self, times_us: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Local rotations (T, J, 3, 3) and bone transforms canonical to world (T, J, 4, 4)."""
        rotations, translation = self.track.at(torch.as_tensor(times_us))
        if self.pose_correction_active:
            turn, shift = self.pose_residual(times_us)
            rotations = rotations @ axis_angle_to_matrix(turn)
            translation = translation + shift
        return rotations, self.track.body.canonical_to_world(rotations, translation)

    def pose_residual(self, times_us: Sequence[int]) -> tuple[Tensor, Tensor]:
        """What is learned of the track's errors: axis-angle (T, J, 3) and shifts (T, 3), metres."""
        if self.pose_spline is not None:
            turn = self.pose_spline.rotation(self.rotation_residuals, times_us)
            return turn, self.pose_spline.translation(self.translation_residuals, times_us)
        share = interpolated if self.config.unseen_frames == "interpolated" else seen
        weights = share(self.get_buffer("frame_times"), times_us)
        turn = torch.einsum("tf,fjc->tjc", weights, self.rotation_residuals)
        return turn, weights @ self.translation_residuals

    def skinning_weights(self, centers: Float[Tensor, "N 3"]) -> Float[Tensor, "N J"]:
        """Weights of the bones for the person's Gaussians, their canonical centres (metres) here.

        Weights of the surface are those that `at` draws with, whatever the centres.
        """
        if self.skinning is None:
            return self.surface.weights(self.gaussians.means[self.gaussians.human])
        return self.skinning(self.normalise(centers))

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
        noise: Noise | None = None,
        hard_semantics: bool = False,
        share_skinning: bool = False,
        networks_at_us: int | None = None,
        shown: PinholeCamera | None = None,
    ) -> PosedGaussians:
        """All Gaussians in world space at ``times_us``, coloured for a camera at that centre.

        ``share_skinning`` reads the skinning weights once, at the mean of a Gaussian's deformed
        places, instead of at each (eq. 2): for the neighbouring times of a training step, whose
        deformations differ by less than the weights notice, this halves the network's cost.

        ``networks_at_us`` is the time of the pose and latent that the non-rigid and colour networks
        see, for all of ``times_us``; without it they see each time's own.

        ``hard_semantics`` puts the hard label into the semantic channel (evaluation); otherwise it
        is the soft attribute m.

        ``shown``: only this camera's picture is asked for; rows of the scene outside of it may be
        black.
        """
        gaussians = self.gaussians
        parts = {name: gaussians.of_parts(getattr(gaussians, name)) for name in ATTRIBUTES}
        rotations, bones = self.pose(times_us)
        moving = self._moving(parts)
        seen_times, seen = list(times_us), rotations
        if networks_at_us is not None:
            seen_times, seen = [networks_at_us], self.pose([networks_at_us])[0]
        deformed, scales, quaternions, feature = self._non_rigid(moving, seen, noise)
        if self.skinning is None:
            weights = self.surface.weights(parts["means"][0])[None]
        elif share_skinning:
            shared = self.normalise(deformed.mean(0))
            weights = self.skinning_turns.weights(self.skinning, shared)[None]
        else:
            weights = self.skinning(self.normalise(deformed))
        world, transforms = skin(deformed, weights, bones)

        people = slice(0, gaussians.human_count)
        human_means, scene_means = world[:, people], parts["means"][1]
        if self.semantics == "ste":
            human_means, scene_means = self._straight_through(world, moving)
        human_features, scene_features = parts["features"]
        middle = slice(None)
        if networks_at_us is not None:
            nearest = min(range(len(times_us)), key=lambda t: abs(times_us[t] - networks_at_us))
            middle = slice(nearest, nearest + 1)
        rgb = self._human_rgb(
            human_features,
            human_means[middle],
            transforms[middle, people],
            feature[:, people],
            camera_center,
            seen_times,
            noise,
        )
        casters = None if self.shadow is None else self.shadow.place(bones)
        light = self.surface_light()
        if light is not None:
            # Geometry gets no gradient by the light.
            places, lit = human_means.detach(), None
            if self.shadow is not None and self.shadow.on_body and light.lamps is not None:
                assert casters is not None
                lit = self.shadow.lit(casters[middle].detach(), places[middle], light.lamps)
            rgb = rgb * light.factors(transforms[:, people].detach(), places, lit)
        soft = gaussians.human_mask().float() if hard_semantics else gaussians.semantics()
        opacities = gaussians.opacities()
        times = len(times_us)

        def posed(rows: slice, means: Tensor, colours: Tensor) -> PosedHuman:
            return PosedHuman(
                means,
                quaternions[:, rows].expand(times, -1, -1),
                scales[:, rows].expand(times, -1, -1),
                colours.expand(times, -1, -1),
                transforms[:, rows],
            )

        scene_scales = parts["scales_log"][1].exp()
        rows = None
        if shown is not None:
            rows = rows_in_view(scene_means, scene_scales, shown)
        scene_rgb = self._scene_rgb(scene_features, scene_means, rows, camera_center, noise)
        human_opacities, scene_opacities = gaussians.of_parts(opacities)
        human_semantics, scene_semantics = gaussians.of_parts(soft)
        return PosedGaussians(
            posed(people, human_means, rgb),
            StaticScene(scene_means, parts["quaternions"][1], scene_scales, scene_rgb),
            human_opacities,
            scene_opacities,
            human_semantics,
            scene_semantics,
            casters=casters,
            low_pass=self.low_pass,
        )

    def training_drawing(
        self,
        times_us: Sequence[int],
        frame: Frame,
        camera: Camera,
        generator: torch.Generator,
    ) -> Drawing:
        """Pictures of a training step, with all its noise; see `Model`."""
        once = self.config.networks_once
        posed = self.at(
            times_us,
            camera.center(),
            noise=self.draw_noise(1 if once else len(times_us), generator),
            share_skinning=True,
            networks_at_us=frame.mid_us if once else None,
            shown=camera,
        )
        return draw(self, posed, camera, center_gradients=True)

    def following(self, track: BodyTrack) -> "HumanSceneModel":
        """The same person doing what ``track`` says, see `Model`.

        Pose residuals are left out, and the colour takes the mean of the latents.
        """
        model = copy.deepcopy(self)
        model.track = track.to(self.device)
        with torch.no_grad():
            model.latents.copy_(model.latents.mean(0))
            model.rotation_residuals.zero_()
            model.translation_residuals.zero_()
        return model

    def draw_noise(self, times: int, generator: torch.Generator) -> Noise:
        """The random perturbations of one training step."""
        config, joints = self.config, len(self.track.body.parents)
        rotations = None
        if float(torch.rand((), generator=generator)) < config.pose_noise_probability:
            rotations = config.pose_noise * torch.randn(1, joints, 3, 3, generator=generator)
            rotations = send(rotations, self.box_low.device).expand(times, -1, -1, -1)
        turn = torch.eye(3)
        if config.view_noise:
            turn = view_jitter(generator, symmetric=config.view_noise_symmetric)
        hide = float(torch.rand((), generator=generator)) < config.scene_direction_dropout
        return Noise(rotations, send(turn, self.box_low.device), hide)

    def _moving(self, parts: dict[str, tuple[Tensor, Tensor]]) -> dict[str, Tensor]:
        """What the networks see: the person, with ``ste`` scene rows inside the box as well."""
        if self.semantics != "ste":
            return {name: human for name, (human, _) in parts.items()}
        inside = self._scene_inside_box()
        return {name: torch.cat([human, scene[inside]]) for name, (human, scene) in parts.items()}

    def _scene_inside_box(self) -> Bool[Tensor, " S"]:
        """Scene rows whose centre, read as canonical, lies in the body's box (literal eq. 6)."""
        scene = self.gaussians.means[self.gaussians.scene].detach()
        return ((scene > self.box_low) & (scene < self.box_high)).all(-1)

    def _straight_through(self, world: Tensor, moving: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Both placements of each row, chosen by the hard label, with the gradient of m (A2 ii).

        Forward: ``h * deformed + (1 - h) * canonical`` with the hard label h; backward: dm/dl. Rows
        outside the canonical box have no deformed placement and so no gradient.
        """
        count = self.gaussians.human_count
        soft = torch.sigmoid(moving["semantic_logits"])
        slope = (soft - soft.detach())[None, :, None]
        step = slope * (world.detach() - moving["means"].detach())
        human = world[:, :count] + step[:, :count]
        scene = self.gaussians.means[self.gaussians.scene]
        if step.shape[1] > count:
            inside = torch.nonzero(self._scene_inside_box())[:, 0]
            # The scene is drawn once for all times; its label sees the mean placement.
            scene = scene.index_add(0, inside, step[:, count:].mean(0))
        return human, scene

    def _non_rigid(
        self, moving: dict[str, Tensor], rotations: Tensor, noise: Noise | None
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Deformed centres, scales, quaternions and colour feature (eq. 1), time leading.

        Before the network is switched on all but the feature have a leading axis of 1.
        """
        canonical, quaternions = moving["means"], moving["quaternions"]
        if not self.non_rigid_active:
            feature = canonical.new_zeros(
                len(rotations), len(canonical), self.non_rigid.feature_dim
            )
            return canonical[None], moving["scales_log"].exp()[None], quaternions[None], feature
        seen = (
            rotations if noise is None or noise.rotations is None else rotations + noise.rotations
        )
        delta = self.non_rigid(self.normalise(canonical), self.pose_encoder(seen))
        return delta.shape(canonical, moving["scales_log"], quaternions)

    def _scene_rgb(
        self,
        features: Tensor,
        means: Tensor,
        rows: Int[Tensor, " V"] | None,
        camera_center: Tensor,
        noise: Noise | None,
    ) -> Float[Tensor, "S 3"]:
        """Colours of the scene, of some ``rows`` of it or of all; the others are black."""
        count = len(means)
        if rows is not None:
            features, means = features.index_select(0, rows), means.detach().index_select(0, rows)
        directions = view_directions(means[None], camera_center)[0]
        if noise is not None and noise.hide_scene_direction:
            directions = torch.zeros_like(directions)
        rgb: Tensor = self.scene_colour(features, directions)
        return rgb if rows is None else rgb.new_zeros(count, 3).index_copy(0, rows, rgb)

    def _human_rgb(
        self,
        features: Tensor,
        world: Tensor,
        transforms: Tensor,
        feature: Tensor,
        camera_center: Tensor,
        times_us: Sequence[int],
        noise: Noise | None,
    ) -> Float[Tensor, "T H 3"]:
        """Colours of the person, from the view direction turned back into canonical space."""
        if self.human_colour is None:
            return features[None, :, COLOUR_LOGITS].sigmoid()
        # Detached as in 3DGS-Avatar: colour must not be bought by moving the body.
        turn = None if noise is None else noise.view_turn
        canonical_view = view_directions(world, camera_center, transforms, turn)
        share = interpolated if self.config.unseen_frames == "interpolated" else seen_or_last
        latent = share(self.get_buffer("frame_times"), times_us) @ self.latents
        return self.human_colour(features, canonical_view, feature, latent)
