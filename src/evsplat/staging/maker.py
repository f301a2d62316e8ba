"""`stage` films a character that moves in the room and writes what a camera would have recorded."""

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32
from tqdm import tqdm

import evsplat
from evsplat.body import BodyTrack, PoseSource
from evsplat.body.make import rig_arrays
from evsplat.body.motion import load_motion
from evsplat.body.pose_noise import noise_errors, poses_off_by
from evsplat.body.retarget import SkeletonMotion
from evsplat.capture import Camera, CaptureWriter
from evsplat.capture.parse_frames import default_split
from evsplat.errors import ConfigError
from evsplat.events import EventStream
from evsplat.events.simulator import PRESETS, SensorSimulator
from evsplat.options import StageSettings
from evsplat.options.captures import PoseNoise
from evsplat.options.declare import given
from evsplat.pictures import encode, luminance
from evsplat.staging.assets import find_character, find_motion
from evsplat.staging.camera import (
    MAIN,
    NOVEL,
    CameraPath,
    FrameTimes,
    frame_times,
    make_camera,
)
from evsplat.staging.character import Character, load_character
from evsplat.staging.cloth import Cloth
from evsplat.staging.lamp import in_light_of, lamp_at
from evsplat.staging.motion import (
    cut_motion,
    height_m,
    key_poses,
    place_motion,
    warn_of_hiding,
    warn_of_leaving,
)
from evsplat.staging.renderer import StageRenderer
from evsplat.staging.room import load_room

POSE_ERRORS: dict[PoseNoise, float] = {
    "none": 0.0,
    "mocap": 0.003,
    "estimated": 0.01,
    "estimated-blurry": 0.02,
}
"""Mean error of wrists and ankles as a share of the body's height. A pose network run on frames of
a synthetic 512-pixel kick missed them by 1 to 2 % of the height, blurry frames being twice as bad;
0.3 % (5 mm) is what markers reach."""
POSE_SOURCE: dict[PoseNoise, PoseSource] = {
    "none": "exact",
    "mocap": "markers",
    "estimated": "estimated",
    "estimated-blurry": "estimated",
}
"""Where poses with such errors come from in a recording."""
MOST_FRAMES = 100
"""Frames filmed of a long motion where no number is asked for."""
_CHUNK_BYTES = 64 << 20


def stage(
    out: Path | str,
    settings: StageSettings | None = None,
    *,
    threads: int | None = None,
    progress: bool = True,
    **changes: Any,
) -> Path:
    """Make a capture with complete ground truth at ``out``; gives its path.

    ``changes`` are fields of `StageSettings`: ``stage("mine", character="woman", motion="kick")``.
    The capture holds blurry and sharp pictures, masks, events, the bare body with its key poses at
    mid-exposure, its true poses in between, novel views, and every setting in its provenance.
    Equal settings give equal files, whatever ``threads`` is.

    Raises:
        DataError: ``out`` exists, or a character or motion file is missing or damaged.
        ConfigError: a setting is out of range, or the motion is too short for the frames.
    """
    settings = given(StageSettings, settings, changes)
    with CaptureWriter(out) as writer:
        film = _Film.prepare(settings, threads)
        film.describe(writer)
        film.write_body(writer)
        sensor = PRESETS[settings.events]
        writer.set_events(
            film.shoot(writer, progress),
            *settings.size,
            contrast_threshold=(sensor.contrast_on, sensor.contrast_off),
            simulated=True,
        )
    return Path(out)


@dataclass(frozen=True, eq=False)
class _Film:
    settings: StageSettings
    character: Character
    track: BodyTrack
    path: CameraPath
    camera: Camera
    renderer: StageRenderer
    cloth: Cloth | None
    times: list[FrameTimes]

    @classmethod
    def prepare(cls, settings: StageSettings, threads: int | None) -> "_Film":
        character = load_character(find_character(settings.character))
        motion = load_motion(find_motion(settings.motion))
        frames = _frame_count(settings, motion)
        times = frame_times(frames, settings.fps, settings.exposure_ms, settings.subframe_hz)
        duration_s = frames / settings.fps
        track = place_motion(
            cut_motion(motion, settings.start_s, duration_s),
            character,
            yaw_deg=settings.yaw_deg,
            in_place=settings.in_place,
        )
        cloth = None
        if settings.cloth_mm > 0:
            cloth = Cloth(character, track, settings.cloth_mm * 1e-3, settings.seed)
        return cls(
            settings,
            character,
            track,
            CameraPath(
                settings.camera, duration_s, orbit_deg=settings.orbit_deg, seed=settings.seed
            ),
            make_camera(MAIN, *settings.size),
            _renderer(settings, character, threads),
            cloth,
            times,
        )

    @property
    def mids_us(self) -> np.ndarray:
        return np.array([times.mid_us for times in self.times])

    def describe(self, writer: CaptureWriter) -> None:
        """Write the cameras and the provenance."""
        settings, moving = self.settings, self.settings.camera != "static"
        poses = self.path.at(self.mids_us)
        size = settings.size
        writer.add_camera("main", *size, self.camera.K, poses[len(poses) // 2])
        if settings.novel_views != "none":
            for name, eye in NOVEL.items():
                camera = make_camera(eye, *size)
                writer.add_camera(name, *size, camera.K, camera.world_to_camera)
        cameras = [
            replace(self.camera, world_to_camera=torch.from_numpy(pose).float()) for pose in poses
        ]
        warn_of_leaving(self.character, self.track, cameras, self.mids_us)
        first = self.times[0]
        exposure_us = first.end_us - first.start_us
        writer.provenance |= {
            "text": "Synthetic: a textured character with recorded motion in a furnished room, "
            "rendered without noise; blur and events from the sub-frames.",
            "made_by": f"evsplat stage, evsplat {evsplat.__version__}",
            "character": settings.character,
            "motion": settings.motion,
            "fps": settings.fps,
            "exposure_us": exposure_us,
            "subframe_hz": len(first.exposure) / (exposure_us * 1e-6),
            "gamma": 2.2,
            "blur": "mean of the sub-frames of the exposure in linear light",
            "events": PRESETS[settings.events].to_dict(),
            "camera_moves": moving,
            "settings": asdict(settings),
        }

    def write_body(self, writer: CaptureWriter) -> None:
        """The bare body, its key poses (with noise where asked for) and the truth in between."""
        body, settings = self.track.body, self.settings
        x, y, z = self.camera.world_to_camera[2, :3].tolist()
        poses, transl, error_m, noise = poses_off_by(
            body,
            *key_poses(self.track, self.mids_us),
            self.mids_us,
            POSE_ERRORS[settings.pose_noise] * height_m(body),
            seed=settings.seed,
            view=(x, y, z),
        )
        source = POSE_SOURCE[settings.pose_noise]
        errors = noise_errors(body, noise, len(poses), source, view=(x, y, z))
        writer.provenance["pose_error_wrists_ankles_m"] = error_m
        dense = np.concatenate([np.concatenate((t.exposure, t.after)) for t in self.times])
        writer.set_body(
            "rig",
            self.mids_us,
            poses,
            transl,
            rig=rig_arrays(body),
            dense=(dense, *key_poses(self.track, dense)),
            source=source,
            pose_std_rad=errors.joint_rad,
            transl_std_m=errors.root_m,
        )

    def shoot(self, writer: CaptureWriter, progress: bool) -> Iterator[EventStream]:
        """Write the pictures frame by frame and give the events of each."""
        settings = self.settings
        sensor = SensorSimulator(*settings.size, PRESETS[settings.events], settings.seed)
        area = 0.0
        bar = tqdm(self.times, desc="filming", unit="frame", disable=not progress)
        for index, times in enumerate(bar):
            blurry = np.zeros((*reversed(settings.size), 3))
            events: list[EventStream] = []
            for time, picture in self._draw(np.concatenate((times.exposure, times.after))):
                if time < times.end_us:
                    blurry += picture
                events.append(sensor.step(luminance(torch.from_numpy(picture)), time))
            name = f"{index:04d}"
            sharp, mask = self._draw_at(times.mid_us)
            area += float(mask.mean()) / len(self.times)
            writer.add_frame(
                name,
                "main",
                _coded(blurry / len(times.exposure)),
                (times.start_us, times.end_us),
                sharp=_coded(sharp),
                mask=mask,
                world_to_camera=self.path.at(np.array([times.mid_us]))[0]
                if settings.camera != "static"
                else None,
            )
            if settings.novel_views in ("all", default_split(index)):
                for camera, eye in NOVEL.items():
                    view = make_camera(eye, *settings.size)
                    seen, _ = self._draw_at(times.mid_us, view)
                    writer.add_novel_view(camera, name, times.mid_us, _coded(seen))
            yield EventStream.joined(events)
        warn_of_hiding(area)

    def _draw(self, times_us: np.ndarray) -> Iterator[tuple[int, Float32[np.ndarray, "H W 3"]]]:
        """Time and linear picture of the recording camera, drawn in batches."""
        pixels = math.prod(self.settings.size)
        step = max(1, _CHUNK_BYTES // (16 * pixels))
        for first in range(0, len(times_us), step):
            part = times_us[first : first + step]
            pictures, _ = self._render(part, self.camera, moving=self.settings.camera != "static")
            yield from zip(part.tolist(), pictures, strict=True)

    def _draw_at(
        self, time_us: int, camera: Camera | None = None
    ) -> tuple[Float32[np.ndarray, "H W 3"], Float32[np.ndarray, "H W"]]:
        """Linear picture and person mask at one time, of the recording camera by default."""
        moving = camera is None and self.settings.camera != "static"
        pictures, masks = self._render(np.array([time_us]), camera or self.camera, moving=moving)
        return pictures[0], masks[0]

    def _render(
        self, times_us: np.ndarray, camera: Camera, *, moving: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        bones = self.track.body.bone_transforms(*self.track.at(times_us.tolist()))
        vertices, normals = (None, None) if self.cloth is None else self.cloth.at(times_us)
        pictures, masks = self.renderer.draw(
            camera,
            bones,
            world_to_camera=self.path.at(times_us) if moving else None,
            vertices=vertices,
            normals=normals,
            shadows=self.settings.shadows,
        )
        return pictures * np.float32(self.settings.brightness), masks


def _renderer(settings: StageSettings, character: Character, threads: int | None) -> StageRenderer:
    room, place = load_room(), (settings.lamp_azimuth_deg, settings.lamp_elevation_deg)
    if place == (None, None):
        return StageRenderer(room, character, threads=threads)
    light = lamp_at(room, *place)
    return StageRenderer(in_light_of(room, light), character, light, threads=threads)


def _frame_count(settings: StageSettings, motion: SkeletonMotion) -> int:
    lasts = float(motion.times_us[-1] - motion.times_us[0]) * 1e-6
    there = int(np.floor((lasts - settings.start_s) * settings.fps + 1e-6))
    wanted = min(there, MOST_FRAMES) if settings.frames is None else settings.frames
    if wanted > there or wanted < 1:
        raise ConfigError(
            f"--motion {settings.motion}: lasts {lasts:.2f} s, which gives {max(there, 0)} frames "
            f"at {settings.fps:g} per second from {settings.start_s:g} s on; {max(wanted, 1)} are "
            "asked for. Ask for fewer (--frames), start earlier (--start), raise --fps, or take a "
            "longer motion."
        )
    return wanted


def _coded(linear: np.ndarray) -> np.ndarray:
    """sRGB-coded (power 2.2), clipped to [0, 1]."""
    return encode(torch.from_numpy(linear).clamp(0, 1)).numpy()
