"""Captures of a suite drawn at random, so that nobody chose them."""

from dataclasses import dataclass
from typing import Annotated, get_args

import numpy as np

from evsplat.body.motion import load_motion
from evsplat.options import StageSettings
from evsplat.options.captures import PoseNoise
from evsplat.options.declare import Sensor
from evsplat.ranges import AtLeast, Within
from evsplat.staging.assets import characters, find_motion, motions

RATES_HZ = (12.5, 15.0, 20.0, 25.0)
_SENSORS: tuple[Sensor, ...] = get_args(Sensor)
_POSE_NOISE: tuple[PoseNoise, ...] = get_args(PoseNoise)
LONGEST_EXPOSURE_MS = 80.0
LEAST_FRAMES = 16
"""Of short motions; the frame rate is raised until there are as many, or is the highest."""


@dataclass(frozen=True)
class Draw:
    """Captures that are staged with settings drawn by a seed."""

    seed: Annotated[int, AtLeast(0)] = 0
    """Seed of the draw; `evsplat bench SUITE --seed` replaces it."""
    captures: Annotated[int, Within(1, 1000)] = 24
    """Number of captures."""
    frames: Annotated[int, AtLeast(4)] = 32
    """Frames of a capture at most; short motions have fewer."""
    width: Annotated[int, Within(16, 4096)] = 128
    """Width and height of the pictures, px."""
    characters: tuple[str, ...] = ()
    """Characters to draw from; all where none are given."""


def drawn_settings(draw: Draw) -> dict[str, StageSettings]:
    """Settings of all captures of a draw, by their names.

    Character, motion, frame rate, exposure (30 to 90 % of the time between frames, at most 80 ms),
    direction, sensor and errors of the poses are independent of each other and uniform. The first
    captures of a longer draw are those of a shorter one.
    """
    rng = np.random.default_rng(draw.seed)
    people = list(draw.characters) or list(characters())
    found = {}
    for number in range(draw.captures):
        settings = _one(rng, people, draw)
        name = f"draw{draw.seed}-{number:02d}-{settings.character}-{settings.motion}"
        found[name] = settings
    return found


def _one(rng: np.random.Generator, people: list[str], draw: Draw) -> StageSettings:
    fps = float(rng.choice(RATES_HZ))
    character, motion = str(rng.choice(people)), str(rng.choice(motions()))
    lasts_s = float(np.ptp(load_motion(find_motion(motion)).times_us)) * 1e-6
    if int(lasts_s * fps) < LEAST_FRAMES:
        enough = (rate for rate in RATES_HZ if int(lasts_s * rate) >= LEAST_FRAMES)
        fps = next(enough, RATES_HZ[-1])
    return StageSettings(
        character=character,
        motion=motion,
        fps=fps,
        frames=min(draw.frames, int(lasts_s * fps)),
        exposure_ms=float(rng.uniform(0.3, 0.9) * min(1000 / fps, LONGEST_EXPOSURE_MS)),
        yaw_deg=float(rng.uniform(0, 360)),
        events=_SENSORS[rng.integers(len(_SENSORS))],
        pose_noise=_POSE_NOISE[rng.integers(len(_POSE_NOISE))],
        seed=int(rng.integers(1 << 30)),
        width=draw.width,
    )
