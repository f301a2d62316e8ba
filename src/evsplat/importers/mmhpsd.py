"""MMHPSD: the raw recording, and the two preprocessed releases (EventHPE's and the SNN paper's)."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from tqdm import tqdm

from evsplat.body.pose_files import PoseSequence, read_poses
from evsplat.body.pose_files.fields import axis_angles, numbers
from evsplat.body.pose_files.sequence import make_sequence
from evsplat.capture.write import CaptureWriter
from evsplat.errors import ConfigError, DataError
from evsplat.events import EventStream, open_recording
from evsplat.importers.base import (
    GUIDE,
    PICTURES,
    Importer,
    SourceCamera,
    add_picture,
    check_positive,
    chosen_frames,
    need,
    numbered,
    opencv_intrinsics,
)
from evsplat.importers.option_types import FrameRange, Name, Rate, Shrink
from evsplat.importers.smpl import add_body, chosen_poses, some_of, unposed
from evsplat.options.declare import Flag, option
from evsplat.untrusted.arrays import read_npz
from evsplat.untrusted.pickles import read_pickle
from evsplat.untrusted.pictures import image_size
from evsplat.wording import counted

_FOCAL_PX, _CENTRE_PX, _CANVAS_PX = 1679.3, 641.0, 1280
"""Intrinsics of the 800x1280 picture padded to a square; no distortion."""


@dataclass(frozen=True, kw_only=True)
class Mmhpsd(Importer):
    """MMHPSD, one action: the folder ROOT/ACTION of the raw data, or ROOT with --action."""

    blur_recipe: ClassVar[str | None] = "mmhpsd-blur"

    action: Name = None
    """Name of the action, as subject01_group2_time3 (s1g2t3); needed for the releases."""
    frames: FrameRange = None
    """First frame and one past the last; by default all that have a picture and a pose."""
    shrink: Shrink = 1
    """Pictures and events are made smaller by this factor."""
    fps: Rate = 15.0
    """Frames per second; the data set has no time stamps."""
    event_duty: Annotated[float, option("SHARE")] = 0.8
    """Share of a frame's interval over which its events are spread: the sensor sends none while it
    takes a full picture."""
    gender: Literal["male", "neutral", "female"] = "male"
    """SMPL model that the poses were fitted with."""
    repair: Flag = False
    """Read on where an event file is damaged."""

    def write(self, source: Path, writer: CaptureWriter, smpl: Path | None) -> list[str]:
        """Read one action; see `Importer.write`."""
        check_positive(shrink=self.shrink, event_duty=self.event_duty)
        if self.event_duty > 1:
            raise ConfigError(
                f"--event-duty {self.event_duty:g}: expected a share of a frame's interval, at "
                "most 1; events of a frame end before those of the next begin."
            )
        layout = _find(source, self.action)
        pictures = numbered(layout.pictures, "grey pictures", PICTURES)
        poses = numbered(layout.poses, "poses", (".pkl", ".npz"))
        both = [number for number in pictures if number in poses]
        if not both:
            raise DataError(f"{layout.poses}: no number is that of a picture in {layout.pictures}.")
        kept = chosen_frames(self.frames, both, source)
        width, height = image_size(pictures[kept[0]])
        _camera(width, height).add_to(writer, "main", pictures[kept[0]], self.shrink)
        times = []
        for number in tqdm(kept, desc="pictures", unit="frame", leave=False):
            time_us = round(number * 1e6 / self.fps)
            add_picture(writer, f"{number:04d}", pictures[number], time_us, self.shrink)
            times.append(time_us)
        notes = [self._add_events(layout, writer, kept, (width, height))]
        missing = len(pictures) - len(both)
        if missing:
            notes.append(f"left out: {counted(missing, 'picture')} without a pose")
        writer.provenance |= {
            "source": "MMHPSD",
            "layout": layout.name,
            "sequence": layout.action,
            "frames": [kept[0], kept[-1] + 1],
            "shrink": self.shrink,
            "fps_nominal": self.fps,
            "event_duty": self.event_duty,
            "events": notes[0],
        }
        files = [poses[number] for number in kept]
        released = files[0].suffix == ".npz"
        sequence = _read_npz_poses(files, kept) if released else read_poses(layout.poses)
        sequence = replace(chosen_poses(sequence, kept), gender=self.gender)
        return notes + add_body(writer, times, sequence, smpl, rest_joints=_rest_joints(files))

    def _add_events(
        self, layout: "_Layout", writer: CaptureWriter, kept: list[int], size: tuple[int, int]
    ) -> str:
        """Write the events where they have a sign; gives a note."""
        if layout.events is None:
            return "events: this release holds binary pictures without polarity; simulate them"
        files = numbered(layout.events, "events", (".csv", ".npz"))
        files = {number: path for number, path in files.items() if number in kept}
        if not any(
            open_recording(path, repair=self.repair).has_polarity for path in files.values()
        ):
            return "events: without polarity (all zero), so they were left out; simulate them"
        repaired: list[Path] = []
        count = writer.set_events(
            self._events(files, size, repaired),
            size[0] // self.shrink,
            size[1] // self.shrink,
            contrast_threshold=None,
            simulated=False,
        )
        note = f"events: {count:,} recorded ones; their times within a frame are reconstructed"
        return note + (f"; {counted(len(repaired), 'file')} repaired" if repaired else "")

    def _events(
        self, files: dict[int, Path], size: tuple[int, int], repaired: list[Path]
    ) -> Iterator[EventStream]:
        """The events of a file belong between its picture and the next."""
        interval_us = 1e6 / self.fps
        for number, path in tqdm(files.items(), desc="events", unit="file", leave=False):
            recording = open_recording(path, width=size[0], height=size[1], repair=self.repair)
            stream = recording.read()
            if any(note.startswith("repaired") for note in recording.notes):
                repaired.append(path)
            if not len(stream):
                continue
            span = max(1, int(stream.t[-1] - stream.t[0]))
            place = (stream.t - stream.t[0]) / span
            t = np.rint((number + self.event_duty * place) * interval_us).astype(np.int64)
            x, y = stream.x // self.shrink, stream.y // self.shrink
            inside = (x < size[0] // self.shrink) & (y < size[1] // self.shrink)
            yield EventStream(t[inside], x[inside], y[inside], stream.p[inside])


@dataclass(frozen=True)
class _Layout:
    """Folders and files of an action."""

    name: str
    action: str
    pictures: Path
    poses: Path
    events: Path | None


def _find(source: Path, action: str | None) -> _Layout:
    need(source, "the folder of MMHPSD or of one action")
    folder = source / action if action and (source / action).is_dir() else source
    name = action or folder.resolve().name
    if (folder / "event_camera").is_dir():
        camera = folder / "event_camera"
        inside, beside = folder / "pose_events", folder.resolve().parent / "pose_events" / name
        above = folder.resolve().parents[1] / "pose_events" / name
        poses = next((path for path in (inside, beside, above) if path.is_dir()), beside)
        return _Layout("raw", name, camera / "full_pic", poses, camera / "events")
    if action is None and any((source / f).is_dir() for f in ("events_256", "mmhpsd_events")):
        raise DataError(f"{source}: holds many actions; choose one with --action.")
    if (source / "full_pic_256").is_dir() or (source / "events_256").is_dir():
        return _Layout(
            "release A", name, source / "full_pic_256" / name, source / "pose_events" / name, None
        )
    if (source / "mmhpsd_events").is_dir():
        own = source / "mmhpsd_events" / name
        grey = source / "mmhpsd_grayscale_img" / name / "imgs"
        return _Layout("release B", name, grey, own / "poses", own / "events")
    raise DataError(
        f"{source}: holds neither event_camera/ (raw), events_256/ and full_pic_256/ (release A) "
        f"nor mmhpsd_events/ (release B), expected MMHPSD; {GUIDE}."
    )


def _camera(width: int, height: int) -> SourceCamera:
    """The camera of a picture that shows the square canvas, or its middle columns."""
    scale = height / _CANVAS_PX
    centre = np.array([_CENTRE_PX - (_CANVAS_PX - width / scale) / 2, _CENTRE_PX])
    K = np.array([[_FOCAL_PX, 0, centre[0]], [0, _FOCAL_PX, centre[1]], [0, 0, 1]])
    K = opencv_intrinsics(K)
    K[:2] *= scale
    return SourceCamera(K, np.eye(4))


def _read_npz_poses(paths: list[Path], frames: list[int]) -> PoseSequence:
    """Poses of release B: one npz per frame."""
    poses, shifts, shapes = [], [], []
    for path in paths:
        arrays, where = read_npz(path, what="pose of MMHPSD"), str(path)
        poses.append(_joint_rotations(arrays, where))
        shifts.append(numbers(arrays, "trans", (3,), where, flat=True))
        shapes.append(numbers(arrays, "beta", (10,), where, flat=True))
    return make_sequence(
        model="smpl",
        frames=frames,
        poses=np.array(poses),
        transl=np.array(shifts),
        betas=np.array(shapes),
        source=str(paths[0].parent),
        world="camera",
        pose_source="markers",
    )


def _joint_rotations(arrays: dict[str, Any], where: str) -> np.ndarray:
    """Axis-angle (24, 3), which the file holds so or as matrices."""
    if np.asarray(arrays.get("body_pose")).size == 24 * 9:
        matrices = numbers(arrays, "body_pose", (24, 3, 3), where, flat=True)
        return axis_angles(matrices, f"{where}: body_pose")
    return numbers(arrays, "body_pose", (24, 3), where, flat=True)


def _rest_joints(paths: list[Path]) -> np.ndarray | None:
    """Joints at rest, from the posed joints that both releases keep."""
    samples = []
    for path in some_of(paths):
        where = str(path)
        if path.suffix == ".npz":
            arrays: dict[str, Any] = read_npz(path, what="pose of MMHPSD")
            if "joints3d" not in arrays:
                return None
            poses = _joint_rotations(arrays, where)
        else:
            parts = read_pickle(path, what="pose of MMHPSD")
            arrays = {"trans": parts[2], "joints3d": parts[3], "theta": parts[1]}
            poses = numbers(arrays, "theta", (24, 3), where, flat=True)
        joints = numbers(arrays, "joints3d", (24, 3), where, flat=True)
        samples.append((poses, joints, numbers(arrays, "trans", (3,), where, flat=True)))
    return unposed(samples)
