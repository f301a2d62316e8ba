"""Your own recording: pictures, events, poses of a tool and a camera, put together."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Int64

from evsplat.body.pose_errors import PoseSource
from evsplat.body.pose_files import PoseSequence
from evsplat.capture.write import CaptureWriter
from evsplat.errors import ConfigError, DataError
from evsplat.footage import Footage, TimedPicture, open_footage
from evsplat.importers.base import (
    GUIDE,
    Importer,
    chosen_frames,
    exposure_around,
    human_mask,
    need,
    short_exposure,
)
from evsplat.importers.clock_offset import offset_or_changes
from evsplat.importers.exposures import read_exposures
from evsplat.importers.option_types import (
    ClockOffset,
    Contrast,
    Curve,
    Exposure,
    FileOption,
    Focal,
    FrameRange,
    HomographyOption,
    Name,
    OwnRate,
    Shrink,
    TimeUs,
)
from evsplat.importers.place_finder import given_mover, place_finder
from evsplat.importers.poses import Motion, add_motion, frames_with_poses, read_motion
from evsplat.importers.recorded import (
    add_recorded_events,
    add_recorded_frame,
    large_pictures,
    pictures_of,
    recorded_camera,
    shrunk_camera,
)
from evsplat.importers.smpl import chosen_poses
from evsplat.options.declare import Flag, option
from evsplat.wording import counted

_VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm")


@dataclass(frozen=True, kw_only=True)
class Folder(Importer):
    """Your own recording: pictures or a video, an event file, a pose file and a camera."""

    frames: FrameRange = None
    """First picture and one past the last, counted from 0; by default all."""
    shrink: Shrink = 1
    """Make pictures and events smaller by this factor."""
    images: FileOption = None
    """Folder of pictures, or a video; by default SOURCE/images or the video in SOURCE."""
    events: FileOption = None
    """Event recording of any known format; by default SOURCE/events.* if there is one."""
    homography: HomographyOption = None
    """From the events' pixels to those of the pictures as recorded: 3 lines of 3 numbers, or .npy;
    auto finds it by what moves; by default events are there already."""
    poses: FileOption = None
    """Poses of any known tool, or body.npz; by default poses.*, poses/ or body.npz in SOURCE;
    without any there is no body."""
    pose_source: Annotated[PoseSource | None, option(default="")] = None
    """Where the poses come from; by default what the tool is known for."""
    camera: FileOption = None
    """One camera as in capture.json; by default SOURCE/camera.json, else what the poses assume."""
    focal: Focal = None
    """Focal length in pixels, instead of a camera; without poses 60 degrees of view are guessed."""
    transfer: Curve = None
    """From the values of the pictures to light: power (2.2), srgb, or linear as a DAVIS stores."""
    masks: FileOption = None
    """Masks of the person, named as the pictures; by default SOURCE/masks if there is one."""
    fps: OwnRate = None
    """Pictures per second; a video has its own."""
    exposure_us: Exposure = None
    """Exposure time, microseconds; not needed with SOURCE/exposures.txt."""
    start_us: TimeUs = 0
    """Middle of the exposure of picture 0."""
    clock_offset_us: ClockOffset = 0
    """Added to the events' times to get the clock of the pictures; auto finds it."""
    contrast: Contrast = None
    """Contrast thresholds of the sensor, brighter and darker, where they are known."""
    person: Name = None
    """Choice among several people in the pose file."""
    repair: Flag = False
    """Read on where the event recording is damaged."""

    def write(self, source: Path, writer: CaptureWriter, smpl: Path | None) -> list[str]:
        """Put the parts together; see `Importer.write`."""
        footage, exposures = self._recording(source)
        middles = exposures.sum(axis=1) // 2
        path = self._poses(source)
        size = footage.width, footage.height
        mover = given_mover(self.homography, size)
        motion: Motion | None = None
        if path is not None:
            motion = read_motion(path, self.person, self.pose_source, size, smpl)
        camera, focal, note = self._camera(source, size, motion)
        if self.transfer is not None:
            camera["transfer"] = self.transfer
        camera, small = shrunk_camera(camera, size, self.shrink)
        writer.add_camera("main", *small, **camera)
        kept = chosen_frames(self.frames, list(range(len(middles))), source)
        seen = _with_poses(kept, motion, middles, path)
        views = _camera_poses(motion)
        masks = _Masks(self._masks(source))
        clock_offset = offset_or_changes(self.clock_offset_us, camera, size)
        spans = {index: (int(exposures[index, 0]), int(exposures[index, 1])) for index in seen}
        finder = place_finder(self.homography, list(spans.values()), camera)
        for index, timed in pictures_of(footage, seen):
            if finder is not None:
                finder.add(timed, spans[index])
            add_recorded_frame(
                writer,
                timed,
                spans[index],
                clock_offset,
                shrink=self.shrink,
                mask=masks.of(timed),
                world_to_camera=views.get(index),
            )
        notes = masks.notes(len(seen)) + add_recorded_events(
            writer,
            self.events or _only("events", sorted(source.glob("events.*"))),
            size,
            clock_offset,
            contrast=self.contrast,
            repair=self.repair,
            mover=mover or finder,
            exposed_only=self.frames is not None,
            shrink=self.shrink,
        )
        notes += [*short_exposure(self.exposure_us), *large_pictures(small)]
        notes += [note] if note else []
        if len(seen) < len(kept):
            lacking = counted(len(kept) - len(seen), "picture")
            notes.append(f"left out: {lacking} without a pose")
        writer.provenance |= {
            "source": "own recording",
            "focal": focal,
            "notes": notes,
            "frames": [kept[0], kept[-1] + 1],
            "shrink": self.shrink,
        }
        return notes + _add_body(writer, path, motion, middles[seen], seen, smpl)

    def _recording(self, source: Path) -> tuple[Footage, Int64[np.ndarray, "N 2"]]:
        """The pictures of a folder, and start and end of every exposure, microseconds."""
        need(source, "the folder of the recording")
        if not source.is_dir():
            raise DataError(
                f"{source}: is a file, expected the folder of the recording; a video alone is read "
                "by 'evsplat import video', a DAVIS recording by 'evsplat import davis'."
            )
        images = self._images(source)
        footage = open_footage(images, self._rate(source, images), rate_option="--fps")
        return footage, self._exposures(source, footage)

    def _images(self, source: Path) -> Path:
        if self.images is not None:
            return self.images
        videos = [path for path in sorted(source.iterdir()) if path.suffix.lower() in _VIDEOS]
        if (source / "images").is_dir() or len(videos) != 1:
            return need(source / "images", "a folder of pictures, or one video beside it")
        return videos[0]

    def _rate(self, source: Path, images: Path) -> float | None:
        if self.fps is not None or not images.is_dir():
            return self.fps
        if not (source / "exposures.txt").exists():
            raise ConfigError(
                f"{images}: pictures have no times; give --fps, or the start and end of every "
                "exposure in exposures.txt."
            )
        # only counts the pictures: their times come from the list
        return 1.0

    def _exposures(self, source: Path, footage: Footage) -> Int64[np.ndarray, "N 2"]:
        """Start and end of every picture's exposure."""
        path, count = source / "exposures.txt", len(footage.times_us)
        if path.exists():
            said = {"fps": self.fps, "exposure-us": self.exposure_us, "start-us": self.start_us}
            for name, value in said.items():
                if value:
                    raise ConfigError(
                        f"--{name} {value:g}: {path} says when every picture was exposed; leave "
                        "out the one or the other."
                    )
            return read_exposures(path, count)
        if self.exposure_us is None:
            raise ConfigError(
                f"{source}: how long the shutter was open is not known; give --exposure-us, or the "
                "start and end of every exposure in exposures.txt."
            )
        times = footage.times_us + self.start_us
        return np.array([exposure_around(int(time), self.exposure_us) for time in times])

    def _masks(self, source: Path) -> Path | None:
        """Folder of the masks; None where there is none."""
        if self.masks is None:
            folder = source / "masks"
            return folder if folder.is_dir() else None
        if not self.masks.is_dir():
            raise DataError(
                f"--masks {self.masks}: no such folder, expected one of pictures NAME.png of the "
                "person, named as the pictures; correct the path."
            )
        return self.masks

    def _poses(self, source: Path) -> Path | None:
        """The poses; None where there are none, or none are wanted."""
        if self.no_poses:
            if self.poses is not None:
                raise ConfigError(
                    f"--poses {self.poses}: contradicts --no-poses and --find-poses; leave one out."
                )
            return None
        if self.poses is not None:
            return need(self.poses, "the poses")
        found = sorted(source.glob("poses.*")) + [
            path for path in (source / "poses", source / "body.npz") if path.exists()
        ]
        return _only("poses", found)

    def _camera(
        self, source: Path, size: tuple[int, int], motion: Motion | None
    ) -> tuple[dict[str, Any], str, str]:
        """`recorded_camera` of the file, else of what the tool that made the poses assumed."""
        path = self.camera or source / "camera.json"
        if self.camera is not None or (path.exists() and self.focal is None):
            return recorded_camera(path, self.focal, size)
        K = motion.K if isinstance(motion, PoseSequence) else None
        if K is not None and self.focal is None:
            return {"K": K}, "assumed by the pose tool", ""
        if motion is not None and self.focal is None:
            raise DataError(
                f"{path}: not found, expected the camera (width, height, K, world_to_camera); "
                f"{GUIDE}."
            )
        return recorded_camera(None, self.focal, size)


def _with_poses(
    kept: list[int], motion: Motion | None, middles: Int64[np.ndarray, "N"], path: Path | None
) -> list[int]:
    """Those of the kept pictures that have a pose, or all where there are no poses at all."""
    seen = sorted(frames_with_poses(motion, middles).intersection(kept))
    if not seen:
        raise DataError(
            f"{path}: has no pose at the middle of any of the {len(kept)} exposures, which "
            f"are from {middles[kept[0]]} to {middles[kept[-1]]} us; correct --fps, --start-us "
            "or exposures.txt, or leave the poses out with --no-poses."
        )
    return seen


def _add_body(
    writer: CaptureWriter,
    path: Path | None,
    motion: Motion | None,
    times_us: Int64[np.ndarray, "K"],
    seen: list[int],
    smpl: Path | None,
) -> list[str]:
    """The body in the poses of the pictures that were seen, at their times; gives notes."""
    if path is None or motion is None:
        writer.leave_out_body()
        return []
    writer.provenance["poses"] = path.name
    if isinstance(motion, PoseSequence):
        motion = chosen_poses(motion, seen)
    return add_motion(writer, motion, times_us.tolist(), smpl)


def _only(option: str, found: list[Path]) -> Path | None:
    """The one file that was found; None where none was, and an error where several were."""
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise ConfigError(
            f"{found[0].parent}: holds {names}, expected one of them; say which with --{option}."
        )
    return found[0] if found else None


class _Masks:
    """Masks of the person, NAME.png for each picture; knows how many there were."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._found = 0

    def of(self, timed: TimedPicture) -> np.ndarray | None:
        """(H, W) share of the person in a picture; None where it has no mask."""
        if self._folder is None:
            return None
        path = self._folder / f"{timed.name}.png"
        mask = human_mask(path)
        if mask is None:
            return None
        if mask.shape != timed.pixels.shape[:2]:
            (height, width), size = mask.shape, timed.pixels.shape
            raise DataError(
                f"{path}: has {width}x{height} pixels, expected {size[1]}x{size[0]} as its picture."
            )
        self._found += 1
        return mask

    def notes(self, pictures: int) -> list[str]:
        """How many of so many pictures have no mask; raises where none of them has."""
        if self._folder is None or self._found == pictures:
            return []
        if not self._found:
            raise DataError(
                f"{self._folder}: holds no mask of any picture, expected NAME.png for a picture "
                "NAME.*; name the masks as the pictures, or leave the folder out."
            )
        return [f"{pictures - self._found} of {pictures} pictures have no mask"]


def _camera_poses(motion: Motion | None) -> dict[int, np.ndarray]:
    """Poses of a moving camera by the index of the picture; empty where it stands."""
    if not isinstance(motion, PoseSequence) or motion.world_to_camera is None:
        return {}
    return dict(zip(motion.frames.tolist(), motion.world_to_camera, strict=True))
