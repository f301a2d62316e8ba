"""HUGS: a triplane person and a scene of its own, drawn together (reference 2.1 to 2.3)."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from evsplat.body import BodyTrack, skin_with_linear
from evsplat.body.rotations import six_to_matrix
from evsplat.capture import Camera, Frame
from evsplat.devices import send
from evsplat.gaussians import OneClassRows
from evsplat.models.drawing import Drawing, draw_for_training
from evsplat.models.hugs.gaussians import Decoded, SphericalScene, TriplaneHuman
from evsplat.models.layers import Layers, human_splats, scene_splats
from evsplat.models.model import PosedModel, RowCache, nearest_time
from evsplat.render import LOW_PASS

DEGREE_EVERY = 1_000
"""Nominal iterations after which the scene's colour gets one more degree of harmonics."""
_NO_TURN = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)


@dataclass(frozen=True, eq=False)
class HugsDrawing(Drawing):
    """A drawing that remembers what the person was decoded to."""

    decoded: Decoded


class HugsModel(PosedModel):
    """Both sets, and the body track with a correction of the pose per training frame."""

    frame_times: Tensor

    def __init__(
        self,
        human: TriplaneHuman,
        scene: SphericalScene,
        track: BodyTrack,
        frame_times_us: Sequence[int],
    ) -> None:
        """``frame_times_us`` are the mid-exposures of the training frames."""
        super().__init__(track)
        self.human, self.scene = human, scene
        frames, joints = len(frame_times_us), len(track.body.parents)
        self.turns = nn.Parameter(torch.tensor(_NO_TURN).repeat(frames, joints, 1))
        """Rotation after each joint's own, six numbers, see `six_to_matrix`."""
        self.shifts = nn.Parameter(torch.zeros(frames, 3))
        """Added to the body's translation, metres."""
        times = torch.tensor(list(frame_times_us), dtype=torch.float64)
        self.register_buffer("frame_times", times)

    @property
    def low_pass(self) -> float:
        """Variance of the filter of a pixel, px^2: that of 3DGS."""
        return LOW_PASS

    @property
    def sets(self) -> dict[str, OneClassRows]:
        """The two sets, by class."""
        return {"human": self.human, "scene": self.scene}

    @property
    def row_caches(self) -> dict[str, RowCache]:
        """Skinning weights that are a few steps old."""
        return {"skinning_turns": self.human.skinning_turns}

    @property
    def active_degree(self) -> int:
        """Degree of the scene's harmonics that are drawn."""
        return min(3, int(self.nominal) // DEGREE_EVERY)

    def pose(self, times_us: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Local rotations (T, J, 3, 3) and bone transforms canonical to world (T, J, 4, 4).

        A training frame's middle has that frame's correction; any other time the recorded pose.
        """
        rotations, translation = self.track.at(torch.as_tensor(list(times_us)))
        times = send(torch.tensor(list(times_us), dtype=torch.float64), self.device)
        frames = (times[:, None] == self.frame_times).float()
        kept = self.turns.new_tensor(_NO_TURN) * (1 - frames.sum(1))[:, None, None]
        turns = kept + torch.einsum("tf,fjc->tjc", frames, self.turns)
        rotations = rotations @ six_to_matrix(turns)
        translation = translation + frames @ self.shifts
        return rotations, self.track.body.canonical_to_world(rotations, translation)

    def skinning_weights(self, centers: Float[Tensor, "N 3"]) -> Float[Tensor, "N J"]:
        """Weights of the Gaussians; they belong to the learned centres, not to ``centers``."""
        return self.human.look_up(self.human.means).weights

    def surface_light(self) -> None:
        """No light is learned apart from the colours."""

    def at(
        self,
        times_us: Sequence[int],
        camera_center: Float[Tensor, "3"],
        *,
        hard_semantics: bool = True,
    ) -> Layers:
        """All Gaussians in the world; the classes are hard whatever is asked for."""
        return self._layers(self.human.look_up(self.human.means), times_us, camera_center)

    def training_drawing(
        self,
        times_us: Sequence[int],
        frame: Frame,
        cameras: Sequence[Camera],
        generator: torch.Generator,
    ) -> Drawing:
        """Person and scene over a random colour; see `Model`."""
        background = send(torch.rand(3, generator=generator), self.device)
        decoded = self.human.for_training()
        center = cameras[nearest_time(times_us, frame)].center()
        layers = self._layers(decoded, times_us, center)
        drawing = draw_for_training(layers, cameras, background=background)
        return HugsDrawing(**vars(drawing), decoded=decoded)

    def following(self, track: BodyTrack) -> "HugsModel":
        """The same person doing what ``track`` says, without the corrections; see `Model`."""
        model = copy.deepcopy(self)
        model.track = track.to(self.device)
        with torch.no_grad():
            model.turns.copy_(model.turns.new_tensor(_NO_TURN))
            model.shifts.zero_()
        return model

    def _layers(
        self, decoded: Decoded, times_us: Sequence[int], camera_center: Float[Tensor, "3"]
    ) -> Layers:
        human, scene = self.human, self.scene
        _, bones = self.pose(times_us)
        world, transforms, linear = skin_with_linear(
            human.means + decoded.offsets, decoded.weights, bones
        )
        return Layers(
            human_splats(
                world,
                decoded.quaternions()[None],
                (decoded.scales * human.multipliers())[None],
                decoded.opacities,
                decoded.rgb[None],
                torch.ones_like(decoded.opacities),
                linear,
            ),
            scene_splats(
                scene.means,
                scene.quaternions,
                scene.scales_log.exp(),
                scene.opacities(),
                scene.rgb(camera_center, self.active_degree),
                torch.zeros_like(scene.opacity_logits),
            ),
            transforms,
        )
