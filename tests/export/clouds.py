"""Random Gaussians, and readers of the files written here from what the formats' authors say."""

import gzip
import struct
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from evsplat.export.cloud import SplatCloud
from evsplat.render import Splats

SH_C0 = 0.28209479177387814


def random_splats(rng: np.random.Generator, count: int, times: int = 2) -> Splats:
    """A person in the skinned form: any matrix, any quaternion length."""

    def tensor(values) -> torch.Tensor:
        return torch.from_numpy(np.float32(values))

    channels = np.concatenate([rng.random((times, count, 3)), np.ones((times, count, 1))], axis=-1)
    return Splats(
        means=tensor(rng.normal(size=(times, count, 3))),
        quaternions=tensor(rng.normal(size=(count, 4))),
        scales=tensor(np.exp(rng.uniform(-6, -2, size=(count, 3)))),
        opacities=tensor(rng.random(count)),
        channels=tensor(channels),
        linear=tensor(np.eye(3) + 0.4 * rng.normal(size=(times, count, 3, 3))),
    )


def random_cloud(rng: np.random.Generator, count: int) -> SplatCloud:
    quaternions = rng.normal(size=(count, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    quaternions *= np.where(quaternions[:, :1] < 0, -1, 1)
    return SplatCloud(
        means=np.float32(rng.normal(size=(count, 3)) * 2),
        quaternions=np.float32(quaternions),
        scales=np.float32(np.exp(rng.uniform(-8, 0, size=(count, 3)))),
        opacities=np.float32(rng.random(count)),
        rgb=np.float32(rng.uniform(-0.2, 1.2, size=(count, 3))),
        semantic=np.float32(rng.random(count) > 0.5),
        seen=np.float32(rng.random(count)),
    )


def covariances(quaternions: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """R S S R^T by scipy, (N, 3, 3) in float64; quaternions are (w, x, y, z)."""
    turned = Rotation.from_quat(quaternions[:, [1, 2, 3, 0]]).as_matrix()
    axes = turned * np.float64(scales)[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


def read_ply(path: Path) -> tuple[list[str], dict[str, np.ndarray]]:
    """Comment lines and columns of a binary PLY of float properties."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    names = [line.split()[2] for line in lines if line.startswith("property float ")]
    (count,) = [int(line.split()[2]) for line in lines if line.startswith("element vertex ")]
    table = np.frombuffer(body, "<f4").reshape(count, len(names))
    comments = [line.removeprefix("comment ") for line in lines if line.startswith("comment ")]
    return comments, {name: table[:, column] for column, name in enumerate(names)}


def read_spz(path: Path) -> dict[str, np.ndarray]:
    """Version 3 without harmonics, value by value as Niantic's reader unpacks it."""
    data = gzip.decompress(path.read_bytes())
    magic, version, count, degree, bits, flags, reserved = struct.unpack("<IIIBBBB", data[:16])
    assert (magic, version, degree, flags, reserved) == (0x5053474E, 3, 0, 0, 0)
    assert len(data) == 16 + 20 * count
    values = {name: [] for name in ("mean", "opacity", "rgb", "scale", "quaternion")}
    for k in range(count):
        for axis in range(3):
            place = 16 + 9 * k + 3 * axis
            number = int.from_bytes(data[place : place + 3], "little", signed=True)
            values["mean"].append(number / 2**bits)
        base = 16 + 9 * count
        values["opacity"].append(data[base + k] / 255)
        base += count
        for channel in data[base + 3 * k : base + 3 * k + 3]:
            values["rgb"].append(0.5 + SH_C0 * (channel / 255 - 0.5) / 0.15)
        base += 3 * count
        values["scale"] += [
            np.exp(byte / 16 - 10) for byte in data[base + 3 * k : base + 3 * k + 3]
        ]
        base += 3 * count
        word = int.from_bytes(data[base + 4 * k : base + 4 * k + 4], "little")
        largest, xyzw = word >> 30, [0.0] * 4
        for axis in (3, 2, 1, 0):
            if axis != largest:
                magnitude = (word & 511) / 511 / np.sqrt(2)
                xyzw[axis] = -magnitude if word >> 9 & 1 else magnitude
                word >>= 10
        xyzw[largest] = np.sqrt(max(0.0, 1 - sum(v * v for v in xyzw)))
        values["quaternion"] += [xyzw[3], *xyzw[:3]]
    return {name: np.array(flat).reshape(count, -1).squeeze() for name, flat in values.items()}
