"""A run as the viewer draws it: networks remember, drafts are rough, the person can be posed."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from evsplat.body import BodyTrack
from evsplat.capture import Camera
from evsplat.export.cloud import SplatCloud
from evsplat.export.gaussians import Instant, cloud_at
from evsplat.film import load_motion_of
from evsplat.film.looks import Look, depth_colours
from evsplat.methods.reconstruction import (
    Parts,
    Posable,
    Reconstruction,
    SplatReconstruction,
    WithDepth,
)
from evsplat.render import Backdrop
from evsplat.training.run import GaussianReconstruction, Run, reload_run
from evsplat.view.network_cache import set_rough, with_cached_networks
from evsplat.view.posing import HeldPose, PoseSlider, pose_sliders, turned
from evsplat.view.request import Motion

_ROUGH_SHADOW_STEP_PX = 4


@dataclass(frozen=True, eq=False)
class _Posed:
    reconstruction: Reconstruction
    pose: HeldPose


class Subject:
    """Draws one run; for the drawing thread alone but for what is fixed."""

    def __init__(self, run: Run, name: str) -> None:
        self.run = run
        self.name = name
        self.capture = run.capture
        self._motions: dict[str, BodyTrack] = {}
        self._recorded = run.reconstruction
        self._posed: _Posed | None = None
        self._remember()

    def reload(self, state: Path) -> None:
        """Take the parameters of another checkpoint or snapshot of the run."""
        self.run = reload_run(self.run, state)
        self._remember()

    def _remember(self) -> None:
        """Begin anew to remember: the parameters have changed."""
        self._recorded = _remembering(self.run.reconstruction)
        self._posed = None

    @property
    def is_posable(self) -> bool:
        """Whether the person can be made to move otherwise than it was recorded."""
        return isinstance(self.run.reconstruction, Posable)

    @property
    def knows_depth(self) -> bool:
        """Whether depth can be shown."""
        return isinstance(self.run.reconstruction, WithDepth)

    @property
    def has_splats(self) -> bool:
        """Whether its Gaussians can be had as a file."""
        return isinstance(self.run.reconstruction, SplatReconstruction)

    @cached_property
    def sliders(self) -> tuple[PoseSlider, ...]:
        """Angles by which the person can be posed."""
        made = self.run.reconstruction
        return pose_sliders(made.track.body) if isinstance(made, Posable) else ()

    def track(self, motion: str | None) -> BodyTrack:
        """A motion on the person's body, placed where the recording was."""
        made = self.run.reconstruction
        assert isinstance(made, Posable)
        if motion is None:
            return made.track
        if motion not in self._motions:
            self._motions[motion] = load_motion_of(motion, made.track)
        return self._motions[motion]

    def picture(
        self, camera: Camera, time_us: int, motion: Motion, look: Look, *, rough: bool
    ) -> Float[np.ndarray, "H W 3"]:
        """One instant, sRGB in [0, 1].

        ``rough`` asks networks about a part of the Gaussians only and makes shadows softer.
        """
        drawn = self._moving(time_us, motion)
        if isinstance(drawn, GaussianReconstruction):
            assert isinstance(drawn.model, nn.Module)
            set_rough(drawn.model, rough)
            if rough:
                drawn = replace(drawn, shadow_step_px=_ROUGH_SHADOW_STEP_PX)
        with torch.no_grad():
            if look.shown == "rgb":
                return drawn.render(camera, [time_us], parts=look.parts).rgb[0].numpy()
            exposure = look.expose(drawn, camera, [time_us])[0]
        if look.shown == "depth":
            exposure = depth_colours(exposure, self._nearest_m)
        return exposure.astype(np.float32) / 255

    def cloud(self, camera: Camera, time_us: int, motion: Motion, parts: Parts) -> SplatCloud:
        """The Gaussians of one instant in the world, coloured as ``camera`` sees them."""
        drawn = self._moving(time_us, motion)
        if isinstance(drawn, GaussianReconstruction):
            assert isinstance(drawn.model, nn.Module)
            set_rough(drawn.model, False)
        assert isinstance(drawn, SplatReconstruction)
        return cloud_at(drawn, Instant(time_us, camera, "the viewer's", ""), parts)

    @cached_property
    def _nearest_m(self) -> float:
        """Depth that is shown brightest, the same in all pictures: the person's at its nearest."""
        frame = self.capture.frames[0]
        camera = self.capture.camera(frame)
        made = self.run.reconstruction
        assert isinstance(made, WithDepth)
        depth = made.depth(camera, [frame.mid_us])
        seen = depth[depth > 0]
        return 0.8 * float(seen.quantile(0.02)) if len(seen) else 1.0

    def _moving(self, time_us: int, motion: Motion) -> Reconstruction:
        """The reconstruction that shows a motion at a time."""
        made = self.run.reconstruction
        if motion.is_recorded or not isinstance(made, Posable):
            return self._recorded
        if self._posed is None:
            pose = HeldPose(made.track)
            self._posed = _Posed(_remembering(made.following(pose)), pose)
        rotations, transl = self.track(motion.name).at([time_us])
        if any(motion.angles):
            rotations = turned(self.sliders, motion.angles, rotations[0])[None]
        self._posed.pose.hold(rotations, transl)
        return self._posed.reconstruction


def _remembering(reconstruction: Reconstruction) -> Reconstruction:
    if not isinstance(reconstruction, GaussianReconstruction):
        return reconstruction
    assert isinstance(reconstruction.model, nn.Module)
    model: Any = with_cached_networks(reconstruction.model)
    return replace(reconstruction, model=model, backdrop=Backdrop())
