"""A plain video, with the events recorded beside it where there are any."""

from dataclasses import dataclass
from pathlib import Path

from evsplat.capture.write import CaptureWriter
from evsplat.errors import ConfigError
from evsplat.footage import open_footage
from evsplat.importers.base import (
    Importer,
    chosen_frames,
    exposure_around,
    short_exposure,
)
from evsplat.importers.clock_offset import offset_or_changes
from evsplat.importers.option_types import (
    ClockOffset,
    Contrast,
    Curve,
    Exposure,
    FileOption,
    Focal,
    FrameRange,
    HomographyOption,
    OwnRate,
    Shrink,
    TimeUs,
)
from evsplat.importers.place_finder import given_mover, place_finder
from evsplat.importers.recorded import (
    add_recorded_events,
    add_recorded_frame,
    large_pictures,
    pictures_of,
    recorded_camera,
    shrunk_camera,
)
from evsplat.options.declare import Flag


@dataclass(frozen=True, kw_only=True)
class Video(Importer):
    """A video of your own, without poses: pictures, an event file if there is one, a camera."""

    frames: FrameRange = None
    """First picture and one past the last, counted from 0; by default all."""
    shrink: Shrink = 1
    """Make pictures and events smaller by this factor."""
    events: FileOption = None
    """Event recording of any known format, in the pixels of the video or brought there."""
    homography: HomographyOption = None
    """From the events' pixels to those of the pictures as recorded: 3 lines of 3 numbers, or .npy;
    auto finds it by what moves; by default events are there already."""
    exposure_us: Exposure = None
    """Exposure time, microseconds; it has to be known."""
    fps: OwnRate = None
    """Rate at which it was shot, where the file does not say (slow motion)."""
    camera: FileOption = None
    """One camera as in capture.json."""
    focal: Focal = None
    """Focal length in pixels, instead of --camera; without both 60 degrees of view are guessed."""
    transfer: Curve = None
    """From the values of the pictures to light: power (2.2), srgb or linear."""
    start_us: TimeUs = 0
    """Middle of the exposure of picture 0."""
    clock_offset_us: ClockOffset = 0
    """Added to the events' times to get the clock of the pictures; auto finds it."""
    contrast: Contrast = None
    """Contrast thresholds of the sensor, brighter and darker, where they are known."""
    repair: Flag = False
    """Read on where the event recording is damaged."""

    def write(self, source: Path, writer: CaptureWriter, smpl: Path | None) -> list[str]:
        """Read the video; see `Importer.write`."""
        footage = open_footage(source, self.fps, rate_option="--fps")
        if self.exposure_us is None:
            raise ConfigError(
                f"{source}: how long the shutter was open is not known, and blur is made of it; "
                "give --exposure-us."
            )
        size = footage.width, footage.height
        mover = given_mover(self.homography, size)
        camera, focal, note = recorded_camera(self.camera, self.focal, size)
        if self.transfer is not None:
            camera["transfer"] = self.transfer
        camera, small = shrunk_camera(camera, size, self.shrink)
        writer.add_camera("main", *small, **camera)
        clock_offset = offset_or_changes(self.clock_offset_us, camera, size)
        kept = chosen_frames(self.frames, list(range(len(footage.times_us))), source)
        middles = (footage.times_us + self.start_us).tolist()
        spans = {index: exposure_around(middles[index], self.exposure_us) for index in kept}
        finder = place_finder(self.homography, list(spans.values()), camera)
        for index, timed in pictures_of(footage, kept):
            if finder is not None:
                finder.add(timed, spans[index])
            add_recorded_frame(writer, timed, spans[index], clock_offset, shrink=self.shrink)
        notes = add_recorded_events(
            writer,
            self.events,
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
        writer.provenance |= {
            "source": f"video {source.name}",
            "focal": focal,
            "notes": notes,
            "frames": [kept[0], kept[-1] + 1],
            "shrink": self.shrink,
        }
        writer.leave_out_body()
        return notes
