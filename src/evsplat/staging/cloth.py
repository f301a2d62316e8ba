"""Garments that do more than follow the bones: wrinkles that come with the pose and swing on."""

import numpy as np
from jaxtyping import Float, Float32
from scipy.spatial.transform import Rotation

from evsplat.body import BodyTrack
from evsplat.staging.character import Character

_WAVES = 6
_WAVELENGTH_M = (0.08, 0.18)
_SWING_HZ, _DAMPING = 4.0, 0.2
_STEP_S = 1e-3


class Cloth:
    """Displacement of the garments outward along their normals over time.

    A sum of sine waves over the mesh at rest, each driven by its own mixture of the joint angles
    through a damped oscillator: the same pose gives the same wrinkles, fast motion makes them swing
    past. A skinned body without cloth of its own cannot reproduce it.
    """

    def __init__(
        self, character: Character, track: BodyTrack, amplitude_m: float, seed: int
    ) -> None:
        self.character = character
        self.amplitude_m = amplitude_m
        rng = np.random.default_rng([seed, 0xC1])
        direction = rng.normal(size=(_WAVES, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        length = rng.uniform(*_WAVELENGTH_M, size=(_WAVES, 1))
        self._waves = 2 * np.pi * direction / length
        phase = character.vertices @ self._waves.T + rng.uniform(0, 2 * np.pi, _WAVES)
        loose = character.cloth[:, None] * amplitude_m / np.sqrt(_WAVES / 2)
        self._height = (loose * np.sin(phase)).astype(np.float32)
        self._slope = (loose * np.cos(phase)).astype(np.float32)
        self._seconds = np.arange(0, track.times_us[-1] * 1e-6 + 2 * _STEP_S, _STEP_S)
        self._swing = _oscillate(_drive(track, self._seconds, rng))

    def at(
        self, times_us: np.ndarray
    ) -> tuple[Float32[np.ndarray, "T V 3"], Float32[np.ndarray, "T V 3"]]:
        """Vertices and unit normals of the mesh at rest, wrinkled, at each time."""
        seconds = np.asarray(times_us) * 1e-6
        swing = np.stack([np.interp(seconds, self._seconds, wave) for wave in self._swing.T], 1)
        swing = swing.astype(np.float32)
        normals = self.character.normals
        wave = swing @ self._height.T
        # outward only (half the wave plus a rounded half of its size): skin must not come through
        size = np.sqrt(wave**2 + (self.character.cloth * np.float32(self.amplitude_m)) ** 2)
        height = (wave + size) / 2
        slope = np.einsum("tk,vk,kc->tvc", swing, self._slope, self._waves.astype(np.float32))
        slope *= 0.5 * (1 + wave / np.maximum(size, 1e-9))[..., None]
        slope -= (slope * normals).sum(-1, keepdims=True) * normals
        tilted = normals - slope
        tilted /= np.linalg.norm(tilted, axis=-1, keepdims=True)
        return self.character.vertices + height[..., None] * normals, tilted


def _drive(
    track: BodyTrack, seconds: np.ndarray, rng: np.random.Generator
) -> Float[np.ndarray, "S K"]:
    """One signal of about unit size per wave: a random mixture of the joint angles."""
    rotations, _ = track.at(np.round(seconds * 1e6).astype(np.int64).tolist())
    flat = rotations[:, 1:].double().numpy().reshape(-1, 3, 3)
    angles = Rotation.from_matrix(flat).as_rotvec().reshape(len(seconds), -1)
    mixed = angles @ rng.normal(size=(angles.shape[1], _WAVES))
    return mixed / np.maximum(np.sqrt((mixed**2).mean(0)), 1e-6)


def _oscillate(drive: Float[np.ndarray, "S K"]) -> Float[np.ndarray, "S K"]:
    """Damped oscillators that are pulled to the drive, from rest at its start."""
    place, speed = drive[0].copy(), np.zeros(drive.shape[1])
    stiffness = (2 * np.pi * _SWING_HZ) ** 2
    damping = 4 * np.pi * _SWING_HZ * _DAMPING
    swing = np.empty_like(drive)
    for index, target in enumerate(drive):
        speed += _STEP_S * (stiffness * (target - place) - damping * speed)
        place += _STEP_S * speed
        swing[index] = place
    return swing
