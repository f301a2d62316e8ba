"""ExFMan's ZJU-MoCap-Blur: HumanNeRF's layout with blurry pictures and simulated events."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from evsplat.body.pose_files import PoseSequence
from evsplat.body.pose_files.fields import has, numbers
from evsplat.body.pose_files.sequence import make_sequence, moved
from evsplat.body.smpl_skeleton import rest_pelvis
from evsplat.capture.write import CaptureWriter
from evsplat.errors import DataError
from evsplat.events import EventStream
from evsplat.importers.base import (
    PICTURES,
    Importer,
    SourceCamera,
    add_picture,
    check_positive,
    chosen_frames,
    human_mask,
    need,
    numbered,
    opencv_intrinsics,
    rigid,
    table,
    whole_number,
)
from evsplat.importers.option_types import FrameRange, Shrink
from evsplat.importers.smpl import add_body
from evsplat.untrusted.pickles import read_pickle
from evsplat.untrusted.pictures import image_size

_EVENTS_PER_PIECE = 1 << 20


@dataclass(frozen=True, kw_only=True)
class ZjuMocapBlur(Importer):
    """ExFMan's ZJU-MoCap-Blur, one sequence's folder (event_info.pkl beside HumanNeRF's files)."""

    brings_masks: ClassVar[bool] = True

    frames: FrameRange = None
    """First number of a picture and one past the last; by default all."""
    shrink: Shrink = 1
    """Pictures and events are made smaller by this factor."""

    def write(self, source: Path, writer: CaptureWriter, smpl: Path | None) -> list[str]:
        """Read one sequence; see `Importer.write`."""
        check_positive(shrink=self.shrink)
        need(source, "one sequence of ZJU-MoCap-Blur")
        tables = {
            name: _read_table(source / f"{name}.pkl")
            for name in ("cameras", "mesh_infos", "event_info")
        }
        pictures = numbered(source / "images", "blurry pictures", PICTURES)
        frames = {path.stem: path for path in pictures.values()}
        moments = _times(tables["event_info"], source / "event_info.pkl", list(frames))
        unit = _microseconds_per_unit(list(moments.values()))
        _check_apart(moments, unit, source / "event_info.pkl")
        first = next(iter(frames))
        cameras = {
            name: _camera(tables["cameras"], name, source / "cameras.pkl") for name in frames
        }
        cameras[first].add_to(writer, "main", frames[first], self.shrink, transfer="linear")
        exposure_us, sub_frames = _exposure(list(moments), list(moments.values()), unit)
        numbers = chosen_frames(self.frames, list(pictures), source)
        kept = {pictures[number].stem for number in numbers}
        moments = {name: time for name, time in moments.items() if name in kept}
        times = []
        for name in tqdm(moments, desc="pictures", unit="frame", leave=False):
            time_us = moments[name] * unit
            add_picture(
                writer,
                name,
                frames[name],
                time_us,
                self.shrink,
                exposure_us=exposure_us,
                mask=human_mask(source / "masks" / f"{name}.png", self.shrink),
                world_to_camera=cameras[name].world_to_camera,
            )
            times.append(round(time_us))
        width, height = image_size(frames[first])
        events = self._events(tables["event_info"], source / "event_info.pkl", unit, width, height)
        exposed_us = writer.exposed_us
        writer.set_events(
            events if self.frames is None else (piece.between(*exposed_us) for piece in events),
            width // self.shrink,
            height // self.shrink,
            contrast_threshold=None,
            simulated=True,
        )
        writer.provenance |= {
            "source": "ZJU-MoCap-Blur of ExFMan",
            "sequence": source.resolve().name,
            "frames": [numbers[0], numbers[-1] + 1],
            "shrink": self.shrink,
            "sub_frames_per_picture": sub_frames,
            "blur": "mean of sub-frames of coded values (not linear light), which therefore count "
            "as light here (transfer linear)",
        }
        infos = source / "mesh_infos.pkl"
        rest = _rest_joints(tables["mesh_infos"], list(moments), infos)
        sequence = _poses(tables["mesh_infos"], list(moments), infos, rest)
        return add_body(writer, times, sequence, smpl, rest_joints=rest)

    def _events(
        self, info: dict[str, Any], path: Path, unit: float, width: int, height: int
    ) -> Iterator[EventStream]:
        count = np.asarray(info["tE"]).size if "tE" in info else 0
        t, x, y, p = (
            numbers(info, key, (count,), str(path), flat=True) for key in ("tE", "xE", "yE", "pE")
        )
        outside = (x < 0) | (y < 0) | (x >= width) | (y >= height)
        if outside.any():
            at = int(np.argmax(outside))
            raise DataError(
                f"{path}: xE[{at}], yE[{at}]: found {x[at]:.0f}, {y[at]:.0f}, expected a pixel of "
                f"the {width}x{height} pictures."
            )
        order = np.argsort(t, kind="stable")
        small = (width // self.shrink, height // self.shrink)
        for start in range(0, count, _EVENTS_PER_PIECE):
            piece = order[start : start + _EVENTS_PER_PIECE]
            column, row = x[piece] // self.shrink, y[piece] // self.shrink
            inside = (column < small[0]) & (row < small[1])
            yield EventStream(
                np.rint(t[piece] * unit).astype(np.int64)[inside],
                column.astype(np.uint16)[inside],
                row.astype(np.uint16)[inside],
                np.where(p[piece] > 0, 1, -1).astype(np.int8)[inside],
            )


def _read_table(path: Path) -> dict[str, Any]:
    content = read_pickle(need(path, f"{path.stem} of the sequence"), what="table by frame")
    return dict(table(content, str(path), "a dictionary by frame"))


def _times(info: dict[str, Any], path: Path, names: list[str]) -> dict[str, float]:
    """Time of each picture, in the file's unit, in order of time."""
    moments = table(info.get("tF"), f"{path}: tF", "the time of every frame by its name")
    absent = [name for name in names if name not in moments]
    if absent:
        raise DataError(f"{path}: tF: has no frame {absent[0]}, expected one for every picture.")
    where = f"{path}: tF"
    times = {name: float(numbers(moments, name, (1,), where, flat=True)[0]) for name in names}
    return dict(sorted(times.items(), key=lambda item: item[1]))


def _microseconds_per_unit(times: list[float]) -> float:
    """Blurry pictures are a few hundredths of a second apart; only one unit makes that of them."""
    spacing = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    return 1e6 if spacing < 1 else 1e3 if spacing < 1000 else 1.0


def _check_apart(times: dict[str, float], unit: float, path: Path) -> None:
    """Captures count whole microseconds, of which neighbours in time need one each."""
    for (before, start), (after, end) in pairwise(times.items()):
        apart_us = (end - start) * unit
        if apart_us <= 1:
            raise DataError(
                f"{path}: tF: {before} and {after}: found times {apart_us:.3g} us apart, "
                "expected more than 1 us. Write tF and tE in seconds, milliseconds or microseconds."
            )


def _exposure(names: list[str], times: list[float], unit: float) -> tuple[float, int]:
    """Length of an exposure and sub-frames from one picture to the next.

    Names count sub-frames, and a picture is the mean of all from one picture to the next but one.
    """
    digits = ["".join(c for c in name if c.isdecimal()) for name in names]
    counts = np.array([whole_number(*pair) for pair in zip(digits, names, strict=True)])
    step = int(np.median(np.diff(counts))) if len(counts) > 1 else 1
    spacing = float(np.median(np.diff(times))) * unit if len(times) > 1 else 20_000.0
    return spacing * max(1, step - 1) / max(1, step), step


def _camera(cameras: dict[str, Any], name: str, path: Path) -> SourceCamera:
    where = f"{path}: {name}"
    if name not in cameras:
        raise DataError(f"{where}: not found, expected a camera for every picture.")
    entry = cameras[name]
    pose = numbers(entry, "extrinsics", (4, 4), where)
    distortion = None
    if has(entry, "distortions") and entry["distortions"] is not None:
        distortion = tuple(numbers(entry, "distortions", (5,), where, flat=True).tolist())
    return SourceCamera(
        opencv_intrinsics(numbers(entry, "intrinsics", (3, 3), where)),
        rigid(pose[:3, :3], pose[:3, 3], f"{where}: extrinsics"),
        distortion,
    )


def _entry(infos: dict[str, Any], name: str, path: Path) -> dict[str, Any]:
    if name not in infos:
        raise DataError(f"{path}: {name}: not found, expected a pose for every picture.")
    return infos[name]


def _rest_joints(infos: dict[str, Any], names: list[str], path: Path) -> np.ndarray | None:
    """The subject's joints at rest, which HumanNeRF's preparation writes with every pose."""
    entries = {name: _entry(infos, name, path) for name in names}
    if not all(has(entry, "tpose_joints") for entry in entries.values()):
        return None
    joints = [
        numbers(entry, "tpose_joints", (24, 3), f"{path}: {name}", flat=True)
        for name, entry in entries.items()
    ]
    return np.median(joints, axis=0)


def _poses(
    infos: dict[str, Any], names: list[str], path: Path, rest: np.ndarray | None
) -> PoseSequence:
    """Poses in the world of the cameras: ``v = R(Rh) v_smpl + Th``, about the origin."""
    poses, roots, shifts = [], [], []
    for name in names:
        entry, where = _entry(infos, name, path), f"{path}: {name}"
        poses.append(numbers(entry, "poses", (24, 3), where, flat=True))
        roots.append(numbers(entry, "Rh", (3,), where, flat=True))
        shifts.append(numbers(entry, "Th", (3,), where, flat=True))
    still = np.zeros((len(names), 3))
    pelvis = (
        rest_pelvis("smpl", np.zeros(0), "neutral", source=str(path)) if rest is None else rest[0]
    )
    turns = Rotation.from_rotvec(roots).as_matrix()
    turned, transl = moved(np.array(poses), still, turns, np.array(shifts), pelvis)
    return make_sequence(
        model="smpl",
        frames=np.arange(len(names)),
        poses=turned,
        transl=transl,
        betas=np.zeros(0),
        source=str(path),
        world="calibration",
        pose_source="markers",
    )
