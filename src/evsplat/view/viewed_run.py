"""A run as the viewer draws it: cached networks, rough drafts, poses by hand, newer checkpoints."""

import contextlib
import os
import threading
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from evsplat.body import BodyTrack
from evsplat.camera import Camera
from evsplat.errors import DataError
from evsplat.export.cloud import SplatCloud
from evsplat.export.gaussians import cloud_at
from evsplat.film import Look, load_motion_of
from evsplat.film.gaps import close_gaps
from evsplat.film.looks import depth_colours
from evsplat.film.surroundings import CalmRoom
from evsplat.methods.reconstruction import Parts
from evsplat.pictures import Transfer
from evsplat.render import Backdrop
from evsplat.training.reconstruction import GaussianReconstruction
from evsplat.training.run import Run, load_run, reload_run
from evsplat.training.watching import newest_state, watch
from evsplat.training_sign import is_training
from evsplat.view.network_cache import set_draft, with_cached_networks
from evsplat.view.posing import HeldPose, PoseSlider, pose_sliders, turned
from evsplat.view.request import Motion

_DRAFT_SHADOW_STEP_PX = 4
_POLL_S = 1.0
"""A run is looked at for newer states this often."""


class ViewedRun:
    """Draws one run; only the render thread calls what draws or reloads."""

    def __init__(self, run: Run, name: str) -> None:
        self.run = run
        self.name = name
        self.capture = run.capture
        self._motions: dict[str, BodyTrack] = {}
        self._rooms: dict[str | None, CalmRoom] = {}
        self._clear_caches()

    def reload(self, state: Path) -> None:
        """Take the parameters of another checkpoint or snapshot of the run."""
        self.run = reload_run(self.run, state)
        self._clear_caches()

    def _clear_caches(self) -> None:
        """Begin caches anew: the parameters have changed."""
        self._recorded = _cached(self.run.reconstruction)
        self._posed: tuple[GaussianReconstruction, HeldPose] | None = None

    @cached_property
    def sliders(self) -> tuple[PoseSlider, ...]:
        """Angles by which the person can be posed."""
        return pose_sliders(self.run.reconstruction.track.body)

    def track(self, motion: str | None) -> BodyTrack:
        """A motion on the person's body, placed where the recording was."""
        recorded = self.run.reconstruction.track
        if motion is None:
            return recorded
        if motion not in self._motions:
            self._motions[motion] = load_motion_of(motion, recorded)
        return self._motions[motion]

    def picture(
        self,
        camera: Camera,
        time_us: int,
        motion: Motion,
        look: Look,
        *,
        draft: bool,
        elsewhere: bool = False,
    ) -> Float[np.ndarray, "H W 3"]:
        """One instant, sRGB in [0, 1].

        A ``draft`` evaluates networks for a part of the Gaussians only and has softer shadows. A
        run that cannot tell what it saw, its training going on, shows colours for certainty. From
        ``elsewhere`` than where a camera recorded, person and scene stand in a calm room, as in
        films.
        """
        if look.shown == "certainty" and self.run.reconstruction.seen is None:
            look = replace(look, shown="rgb")
        drawn = self._moving(time_us, motion, draft=draft)
        if draft:
            drawn = replace(drawn, shadow_step_px=_DRAFT_SHADOW_STEP_PX)
        with torch.no_grad():
            if look.shown == "rgb" and look.parts == "all" and elsewhere:
                return self._in_a_room(drawn, camera, time_us, motion)
            if look.shown == "rgb":
                rgb = drawn.render(camera, [time_us], parts=look.parts).rgb[0]
                return self.capture.shown(rgb).numpy()
            look = replace(look, transfer=self._transfer)
            exposure = look.expose(drawn, camera, [time_us])[0]
        if look.shown == "depth":
            exposure = depth_colours(exposure, self._nearest_m)
        return exposure.astype(np.float32) / 255

    def _in_a_room(
        self, drawn: GaussianReconstruction, camera: Camera, time_us: int, motion: Motion
    ) -> Float[np.ndarray, "H W 3"]:
        """Holes show a floor and an even gradient, and what hides the person fades."""
        room = self._rooms.get(motion.name)
        if room is None:
            frame = self.capture.frames[0]
            recording = self.capture.camera(frame) if self.capture.is_static_camera else None
            recorded = self.run.reconstruction.track.to("cpu")
            room = CalmRoom.of(recorded, self.track(motion.name).to("cpu"), recording)
            self._rooms[motion.name] = room
        shown = drawn.elsewhere(room.clear, room.soften).render(camera, [time_us])
        rgb, alpha = close_gaps(shown.rgb.cpu(), shown.alpha.cpu().clamp(0, 1), shown.human.cpu())
        picture, holes = self.capture.shown(rgb[0]), 1 - alpha[0, ..., None]
        return (picture + holes * room.behind_coarsely(camera, time_us)).clamp(0, 1).numpy()

    def cloud(self, camera: Camera, time_us: int, motion: Motion, parts: Parts) -> SplatCloud:
        """The Gaussians of one instant in the world, coloured as ``camera`` sees them."""
        drawn = self._moving(time_us, motion, draft=False).elsewhere()
        cloud = cloud_at(drawn, camera, time_us, parts)
        return cloud.shown(self._transfer)

    @property
    def _transfer(self) -> Transfer:
        return self.capture.transfer(self.capture.frames[0])

    @cached_property
    def _nearest_m(self) -> float:
        """Depth that is shown brightest, the same in all pictures: the person's at its nearest."""
        frame = self.capture.frames[0]
        camera = self.capture.camera(frame)
        depth = self.run.reconstruction.depth(camera, [frame.mid_us])
        seen = depth[depth > 0]
        return 0.8 * float(seen.quantile(0.02)) if len(seen) else 1.0

    def _moving(self, time_us: int, motion: Motion, *, draft: bool) -> GaussianReconstruction:
        """The reconstruction that shows a motion at a time, as a draft or exactly."""
        drawn, made = self._recorded, self.run.reconstruction
        if not motion.is_recorded:
            if self._posed is None:
                held = HeldPose(made.track)
                self._posed = _cached(made.in_new_motion(held)), held
            drawn, pose = self._posed
            rotations, transl = self.track(motion.name).at([time_us])
            if any(motion.angles):
                rotations = turned(self.sliders, motion.angles, rotations[0])[None]
            pose.hold(rotations, transl)
        assert isinstance(drawn.model, nn.Module)
        set_draft(drawn.model, draft)
        return drawn


def _cached(reconstruction: GaussianReconstruction) -> GaussianReconstruction:
    assert isinstance(reconstruction.model, nn.Module)
    model: Any = with_cached_networks(reconstruction.model)
    # No `posed`: a draft of the same times is another.
    drawn = reconstruction.at_any_size()
    return replace(drawn, model=model, backdrop=Backdrop(), posed=None)


def load_newest(path: Path, device: str) -> Run:
    """The run at its newest checkpoint or snapshot; waits for the first one of a training.

    Raises:
        DataError: No run, or none to be waited for: its training ended before its first step.
    """
    waited = False
    while newest_state(path) is None and is_training(path):
        if not waited:
            print(f"{path}: nothing to see before its first step; waiting for it.", flush=True)
            waited = True
        watch(path)
        threading.Event().wait(_POLL_S)
    newest = newest_state(path)
    if waited and newest is None:
        raise DataError(
            f"{path}: its training ended before its first step, so that there is nothing to see; "
            "mend what it said, and train again."
        )
    # Of checkpoints the newest that can be read.
    snapshot = newest if newest is not None and newest.parent == path else None
    return load_run(path, device=device, state=snapshot)


class RunFollower:
    """Looks for newer states of a run, which may be trained on at any time, in its own thread."""

    def __init__(
        self,
        viewed: ViewedRun,
        submit: Callable[[Callable[[], None]], None],
        is_watched: Callable[[], bool],
        changed: Callable[[], None],
    ) -> None:
        """``submit`` has a job done by the render thread; ``is_watched`` while a browser is there.

        ``changed`` is called by the render thread when the run has new parameters.
        """
        self._viewed, self._submit = viewed, submit
        self._is_watched, self._changed = is_watched, changed
        self._stop = threading.Event()
        self._yielded = False
        self._loaded = self._newest()
        threading.Thread(target=self._run, name="evsplat-follow", daemon=True).start()

    def stop(self) -> None:
        """Look for newer states no more."""
        self._stop.set()

    def _run(self) -> None:
        path = self._viewed.run.path
        while not self._stop.wait(_POLL_S):
            # Not asked whether it trains: that takes the lock for a moment, and a training that
            # begins just then would be refused.
            if self._is_watched():
                watch(path)
            newest = self._newest()
            if newest is not None and newest != self._loaded:
                self._loaded = newest
                self._submit(self._reload)

    def _newest(self) -> tuple[Path, int] | None:
        """The newest state and when it was written."""
        with contextlib.suppress(OSError):  # replaced just now
            state = newest_state(self._viewed.run.path)
            return None if state is None else (state, state.stat().st_mtime_ns)
        return None

    def _reload(self) -> None:
        assert self._loaded is not None
        try:
            self._viewed.reload(self._loaded[0])
        except (DataError, OSError):
            return  # replaced or removed before it was read; there will be another one
        if not self._yielded and is_training(self._viewed.run.path):
            self._yielded = True
            yield_to_training()
        self._changed()


def yield_to_training() -> None:
    """Let this process have only what processors have left, from now on.

    Reading the run is better done before: it takes seconds once, and without end on what is left.
    """
    if not hasattr(os, "SCHED_IDLE"):
        os.nice(19)
        return
    for thread in threading.enumerate():
        _set_idle(thread.native_id or 0)
    with contextlib.suppress(OSError):  # the pools of threads that Python does not know
        for entry in Path("/proc/self/task").iterdir():
            _set_idle(int(entry.name))


def _set_idle(thread: int) -> None:
    with contextlib.suppress(OSError):
        os.sched_setscheduler(thread, os.SCHED_IDLE, os.sched_param(0))
