"""PeopleSnapshot: one person turning before a fixed camera."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import h5py
import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from evsplat.body.pose_files import PoseSequence
from evsplat.body.pose_files.fields import numbers
from evsplat.body.pose_files.sequence import make_sequence
from evsplat.capture.write import CaptureWriter
from evsplat.errors import DataError
from evsplat.importers.base import (
    GUIDE,
    SHARP_EXPOSURE_US,
    Importer,
    SourceCamera,
    check_positive,
    chosen_frames,
    exposure_around,
    need,
    opencv_intrinsics,
    rigid,
    shrunk,
)
from evsplat.importers.option_types import FrameRange, Name, Shrink
from evsplat.importers.smpl import add_body, chosen_poses
from evsplat.untrusted.faults import broken_as
from evsplat.untrusted.hdf5 import data_set, holds, open_hdf5, wrong_data_set
from evsplat.untrusted.pickles import read_pickle
from evsplat.untrusted.videos import opened_video


@dataclass(frozen=True, kw_only=True)
class PeopleSnapshot(Importer):
    """PeopleSnapshot, one subject's folder, such as male-3-casual."""

    brings_masks: ClassVar[bool] = True

    frames: FrameRange = None
    """First frame and one past the last; by default all."""
    shrink: Shrink = 2
    """Pictures are made smaller by this factor (1080 to 540 pixels)."""
    gender: Name = None
    """male or female; by default what the folder's name begins with."""

    def write(self, source: Path, writer: CaptureWriter, smpl: Path | None) -> list[str]:
        """Read one subject; see `Importer.write`."""
        check_positive(shrink=self.shrink)
        need(source, "one subject of PeopleSnapshot")
        name = source.resolve().name
        gender = self.gender or name.split("-")[0]
        if gender not in ("male", "female", "neutral"):
            raise DataError(
                f"{source}: its name does not begin with male or female; give --gender."
            )
        video = _video(source, name)
        sequence = _read_poses(
            source / "reconstructed_poses.hdf5", source / "consensus.pkl", gender
        )
        count = len(sequence.frames)
        kept = chosen_frames(self.frames, list(range(count)), source)
        camera, width, height = _read_camera(source / "camera.pkl")
        camera.add_to(writer, "main", (width, height), self.shrink)
        times = []
        with _Masks(source / "masks.hdf5", count) as masks:
            for index, time_us, pixels in _decode(video, kept, count):
                if pixels.shape[:2] != (height, width):
                    raise DataError(
                        f"{video}: has {pixels.shape[1]}x{pixels.shape[0]} pixels, expected "
                        f"{width}x{height} of camera.pkl."
                    )
                writer.add_frame(
                    f"{index:04d}",
                    "main",
                    shrunk(pixels, self.shrink),
                    exposure_around(time_us, SHARP_EXPOSURE_US),
                    sharp=True,
                    mask=masks.at(index, self.shrink),
                )
                times.append(time_us)
        writer.provenance |= {
            "source": "PeopleSnapshot",
            "sequence": name,
            "frames": [kept[0], kept[-1] + 1],
            "shrink": self.shrink,
        }
        return add_body(writer, times, chosen_poses(sequence, kept), smpl)


def _video(source: Path, name: str) -> Path:
    named = source / f"{name}.mp4"
    found = [named] if named.exists() else sorted(source.glob("*.mp4"))
    if len(found) != 1:
        raise DataError(f"{source}: holds {len(found)} .mp4 files, expected {named.name}; {GUIDE}.")
    return found[0]


def _read_camera(path: Path) -> tuple[SourceCamera, int, int]:
    data, where = read_pickle(need(path, "the camera"), what="camera"), str(path)

    def get(key: str, count: int) -> np.ndarray:
        return numbers(data, key, (count,), where, flat=True)

    (fx, fy), (cx, cy) = get("camera_f", 2), get("camera_c", 2)
    turn = Rotation.from_rotvec(get("camera_rt", 3)).as_matrix()
    pose = rigid(turn, get("camera_t", 3), where)
    K = opencv_intrinsics(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
    camera = SourceCamera(K, pose, tuple(get("camera_k", 5).tolist()))
    return camera, int(get("width", 1)[0]), int(get("height", 1)[0])


def _read_poses(path: Path, consensus: Path, gender: str) -> PoseSequence:
    need(path, "the poses")
    with open_hdf5(path) as file:
        keys = (key for key in ("pose", "trans", "betas") if holds(file, key))
        arrays = {key: _whole(path, file, key) for key in keys}
    if "betas" not in arrays and consensus.exists():
        shape = read_pickle(consensus, what="consensus shape")
        arrays["betas"] = numbers(shape, "betas", (10,), str(consensus), flat=True)
    shifts = numbers(arrays, "trans", (None, 3), str(path))
    return make_sequence(
        model="smpl",
        frames=np.arange(len(shifts)),
        poses=numbers(arrays, "pose", (len(shifts), 24, 3), str(path), flat=True),
        transl=shifts,
        betas=numbers(arrays, "betas", (10,), str(path), flat=True),
        gender=gender,
        source=str(path),
        world="calibration",
        pose_source="estimated",
    )


def _whole(path: Path, file: h5py.File, name: str) -> np.ndarray:
    found = data_set(file, name)
    with broken_as(path, f"{name} cannot be read", "copy the file again"):
        return np.asarray(found)


class _Masks:
    """Rows of masks.hdf5; none where the file is missing."""

    def __init__(self, path: Path, count: int) -> None:
        self._path = path
        self._file = open_hdf5(path) if path.exists() else None
        if self._file is not None and (
            wrong_data_set(self._file, "masks") or self._file["masks"].shape[:1] != (count,)
        ):
            raise DataError(f"{path}: masks: expected {count} masks as there are poses.")

    def __enter__(self) -> "_Masks":
        return self

    def __exit__(self, *error: object) -> None:
        if self._file is not None:
            self._file.close()

    def at(self, index: int, shrink: int) -> np.ndarray | None:
        """(H, W) share of the person."""
        if self._file is None:
            return None
        with broken_as(self._path, f"masks[{index}] cannot be read", "copy the file again"):
            mask = np.asarray(self._file["masks"][index])
        return shrunk((mask != 0).astype(np.float32), shrink)


def _decode(video: Path, kept: list[int], count: int) -> Iterator[tuple[int, int, np.ndarray]]:
    """Index, time and RGB pixels of the wanted frames, in order."""
    wanted = set(kept)
    with opened_video(video) as (container, stream):
        rate = float(stream.average_rate or 30)
        frames = tqdm(container.decode(stream), "pictures", count, unit="frame", leave=False)
        for index, frame in enumerate(frames):
            if index in wanted:
                yield index, round(index * 1e6 / rate), frame.to_ndarray(format="rgb24")
                wanted.discard(index)
            if not wanted:
                return
    raise DataError(
        f"{video}: ends before frame {min(wanted)}, expected {count} frames as there are poses."
    )
