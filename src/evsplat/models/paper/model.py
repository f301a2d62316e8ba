"""The paper's model (eq. 1-7): 3DGS-Avatar's networks pose and colour the person, in a scene."""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.body import BodyTrack, skin_with_linear
from evsplat.camera import Camera, distinct
from evsplat.capture import Frame
from evsplat.devices import send
from evsplat.gaussians import GaussianSet
from evsplat.models.drawing import Drawing, draw_for_training
from evsplat.models.layers import Layers, human_splats, scene_splats
from evsplat.models.model import PosedModel, RowCache, nearest_time
from evsplat.models.networks.colour import (
    HumanColour,
    SceneColour,
    scene_rgb,
    view_directions,
    view_jitter,
)
from evsplat.models.networks.non_rigid import (
    COLOUR_FEATURE_DIM,
    PoseDeformation,
    draw_pose_noise,
)
from evsplat.models.networks.skinning_network import SkinningNetwork, SkinningTurns
from evsplat.models.paper.per_frame import FrameLatents, FramePoses, UnseenFrames
from evsplat.models.paper.placement import Placement, StraightThrough
from evsplat.render import LOW_PASS

LATENT_DIM = 16
"""Size of the per-frame latent of the person's colour."""

Semantics = Literal["fixed", "ste", "rendered"]
"""Teacher of the attribute: none, straight-through placement, the rendered attribute."""


@dataclass(frozen=True)
class _Noise:
    """Random perturbations of one training step."""

    rotations: Tensor | float
    """Added to the matrices that the pose encoder sees."""
    view_turn: Float[Tensor, "3 3"]
    """Rotation of canonical view directions."""
    hide_scene_direction: bool


@dataclass(frozen=True, eq=False)
class _Posed:
    """The person deformed and skinned at T times, and where the scene is drawn."""

    means: Float[Tensor, "T H 3"]
    scales: Float[Tensor, "#T H 3"]
    quaternions: Float[Tensor, "#T H 4"]
    transforms: Float[Tensor, "T H 4 4"]
    linear: Float[Tensor, "T H 3 3"]
    """See `skin_with_linear`, as of ``transforms``."""
    feature: Float[Tensor, "T H F"]
    """What the non-rigid network gives to the colour."""
    scene_means: Float[Tensor, "S 3"]


class PaperModel(PosedModel):
    """Gaussians, networks and the body track; `at` poses them at given times."""

    residual: FramePoses

    def __init__(
        self,
        track: BodyTrack,
        frame_times_us: Sequence[int],
        gaussians: GaussianSet,
        *,
        semantics: Semantics,
        width: int,
        colour_width: int,
        non_rigid_start: float,
        pose_noise: float,
        scene_direction_dropout: float,
        pose_start: float | None,
        released: bool,
    ) -> None:
        """Start at ``gaussians``, which have an attribute ``features``.

        ``frame_times_us`` are the mid-exposures of the training frames, the anchors of latents and
        pose residuals; these are learned from nominal iteration ``pose_start`` on, None: never.
        ``released``: as the released 3DGS-Avatar, where it differs from the better reading of its
        paper. Its last layer starts at random, so that every point jumps when the non-rigid network
        is switched on; its view noise is not symmetric; of instants that are not the
        middle of a training frame it knows nothing (A22); it looks all skinning weights up at every
        step, not one row in four in turns.
        """
        super().__init__(track)
        body = track.body
        self.gaussians, self.semantics, self.released = gaussians, semantics, released
        unseen: UnseenFrames = "released" if released else "interpolated"
        self.non_rigid_start, self.pose_noise = non_rigid_start, pose_noise
        self.scene_direction_dropout = scene_direction_dropout
        self.placement = StraightThrough() if semantics == "ste" else Placement()
        last_std = None if released else 1e-3
        self.deformation = PoseDeformation(body, width=width, last_std=last_std)
        self.skinning = SkinningNetwork(body.parents.tolist(), width=width)
        self.skinning_turns = SkinningTurns(1 if released else 4)
        self.human_colour = HumanColour(
            nonrigid_dim=COLOUR_FEATURE_DIM, latent_dim=LATENT_DIM, width=colour_width
        )
        self.scene_colour = SceneColour(width=colour_width)
        self.latents = FrameLatents(frame_times_us, LATENT_DIM, unseen)
        self.residual = FramePoses(frame_times_us, len(body.parents), unseen)
        self.residual_start = float("inf") if pose_start is None else pose_start

    @property
    def low_pass(self) -> float:
        """Variance of the filter of a pixel, px^2: that of 3DGS."""
        return LOW_PASS

    @property
    def sets(self) -> dict[str, GaussianSet]:
        """The one set of both classes."""
        return {"gaussians": self.gaussians}

    @property
    def row_caches(self) -> dict[str, RowCache]:
        """Skinning weights that are a few steps old."""
        return {"skinning_turns": self.skinning_turns}

    def skinning_weights(self, centers: Float[Tensor, "N 3"]) -> Float[Tensor, "N J"]:
        """Weights of the bones at canonical centres, metres."""
        weights: Tensor = self.skinning(self.deformation.normalise(centers))
        return weights

    def surface_light(self) -> None:
        """No light is learned apart from the colours."""

    def at(
        self,
        times_us: Sequence[int],
        camera_center: Float[Tensor, "3"],
        *,
        hard_semantics: bool = False,
    ) -> Layers:
        """All Gaussians in world space, coloured for a camera at that centre; see `Model`."""
        return self._layers(
            times_us, camera_center, self.skinning_weights, hard_semantics=hard_semantics
        )

    def training_drawing(
        self,
        times_us: Sequence[int],
        frame: Frame,
        cameras: Sequence[Camera],
        generator: torch.Generator,
    ) -> Drawing:
        """Pictures of a training step, with all its noise; see `Model`.

        Colours are those seen from the camera at the time nearest to the frame's middle.
        """
        layers = self._layers(
            times_us,
            cameras[nearest_time(times_us, frame)].center(),
            self._shared_weights,
            noise=self._draw_noise(generator),
            shown=distinct(cameras),
        )
        return draw_for_training(layers, cameras)

    def following(self, track: BodyTrack) -> "PaperModel":
        """The same person doing what ``track`` says, see `Model`.

        Pose residuals are left out, and the colour takes the mean of the latents.
        """
        model = copy.deepcopy(self)
        model.track = track.to(self.device)
        model.latents.take_mean()
        model.residual.forget()
        return model

    def _shared_weights(self, centers: Float[Tensor, "T M 3"]) -> Float[Tensor, "1 M J"]:
        """Skinning weights of a training step: once, at the mean of a Gaussian's places.

        Its neighbouring times differ by less than the weights notice (eq. 2 asks at each).
        """
        shared = self.deformation.normalise(centers.mean(0))
        return self.skinning_turns.weights(self.skinning, shared)[None]

    def _draw_noise(self, generator: torch.Generator) -> _Noise:
        joints = len(self.track.body.parents)
        rotations = draw_pose_noise(joints, self.pose_noise, generator, self.device)
        turn = view_jitter(generator, symmetric=not self.released)
        hide = float(torch.rand((), generator=generator)) < self.scene_direction_dropout
        return _Noise(rotations, send(turn, self.device), hide)

    def _layers(
        self,
        times_us: Sequence[int],
        camera_center: Float[Tensor, "3"],
        weights_at: Callable[[Tensor], Tensor],
        *,
        hard_semantics: bool = False,
        noise: _Noise | None = None,
        shown: Sequence[Camera] = (),
    ) -> Layers:
        """Both classes at given times, with skinning weights by ``weights_at``.

        ``shown``: only these cameras' pictures are asked for, if any are given; rows of the scene
        outside of them may be black.
        """
        gaussians = self.gaussians
        parts = [
            gaussians.of_parts(values)
            for values in (gaussians.means, gaussians.scales_log, gaussians.quaternions)
        ]
        posed = self._posed(times_us, parts, weights_at, noise)
        features, scene_features = gaussians.of_parts(gaussians.get_parameter("features"))
        turn = None if noise is None else noise.view_turn
        # Detached as in 3DGS-Avatar: colour must not be bought by moving the body.
        seen_from = view_directions(posed.means, camera_center, posed.transforms, turn)
        rgb = self.human_colour(features, seen_from, posed.feature, self.latents(times_us))
        labels = gaussians.human_mask().float() if hard_semantics else gaussians.semantics()
        semantics, scene_semantics = gaussians.of_parts(labels)
        opacities, scene_opacities = gaussians.of_parts(gaussians.opacities())
        _, scene_scales_log, scene_quaternions = (scene for _, scene in parts)
        scene_scales = scene_scales_log.exp()
        scene_colours = scene_rgb(
            self.scene_colour,
            scene_features,
            posed.scene_means,
            scene_scales,
            camera_center,
            shown=shown,
            hide_direction=noise is not None and noise.hide_scene_direction,
        )
        return Layers(
            human_splats(
                posed.means,
                posed.quaternions,
                posed.scales,
                opacities,
                rgb,
                semantics,
                posed.linear,
            ),
            scene_splats(
                posed.scene_means,
                scene_quaternions,
                scene_scales,
                scene_opacities,
                scene_colours,
                scene_semantics,
            ),
            posed.transforms,
        )

    def _posed(
        self,
        times_us: Sequence[int],
        parts: list[tuple[Tensor, Tensor]],
        weights_at: Callable[[Tensor], Tensor],
        noise: _Noise | None,
    ) -> _Posed:
        """The person at its times, with the rows of the scene that `placement` poses beside it.

        ``parts`` are centres, log-scales and quaternions, each of person and scene.
        """
        rotations, bones = self.pose(times_us)
        rows = self.placement.posed_scene_rows(self.gaussians, self.deformation)
        given = [
            human if rows is None else torch.cat([human, scene[rows]]) for human, scene in parts
        ]
        centers, scales, quaternions, feature = self._deformed(given, rotations, noise)
        world, transforms, linear = skin_with_linear(centers, weights_at(centers), bones)
        means, scene_means = self.placement.places(self.gaussians, rows, world, parts[0][1])
        people = slice(0, self.gaussians.human_count)
        return _Posed(
            means,
            scales[:, people],
            quaternions[:, people],
            transforms[:, people],
            linear[:, people],
            feature[:, people],
            scene_means,
        )

    def _deformed(
        self, given: list[Tensor], rotations: Float[Tensor, "T J 3 3"], noise: _Noise | None
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Deformed centres, scales, quaternions and colour feature (eq. 1), time leading.

        ``given`` are centres, log-scales and quaternions. Before the network is switched on all but
        the feature have a leading axis of 1.
        """
        means, scales_log, quaternions = given
        if float(self.nominal) < self.non_rigid_start:
            feature = means.new_zeros(len(rotations), len(means), COLOUR_FEATURE_DIM)
            return means[None], scales_log.exp()[None], quaternions[None], feature
        seen = rotations if noise is None else rotations + noise.rotations
        deformed: tuple[Tensor, Tensor, Tensor, Tensor] = self.deformation(
            means, scales_log, quaternions, seen
        )
        return deformed
