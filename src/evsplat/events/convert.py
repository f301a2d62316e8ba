"""Conversion of any recording that evsplat reads to one that it writes, piece by piece."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from evsplat.errors import ConfigError
from evsplat.events.homography import Mover
from evsplat.events.recording import EventRecording, open_recording
from evsplat.events.stream import EventStream
from evsplat.events.write import write_events
from evsplat.options import ReadOptions


@dataclass(frozen=True)
class Conversion:
    """A recording that was written."""

    path: Path
    events: int
    start_us: int
    """Time of the first event, as written; 0 for an empty recording."""
    end_us: int
    """Time of the last event."""
    width: int | None
    height: int | None
    notes: list[str]
    """Assumptions of the reader, what it repaired, and how many events fell outside of pictures."""

    @property
    def summary(self) -> str:
        """A few lines for the terminal."""
        size = f", {self.width} x {self.height} pixels" if self.width else ""
        seconds = 1e-6 * (self.end_us - self.start_us)
        lines = [f"written: {self.path}", f"  {self.events:,} events in {seconds:.3f} s{size}"]
        return "\n".join([*lines, *(f"  {note}" for note in self.notes)])


def convert_recording(
    source: Path | str,
    out: Path | str | None,
    options: ReadOptions | None = None,
    *,
    from_zero: bool = False,
    to: str | None = None,
    homography: Path | None = None,
    size: tuple[int, int] | None = None,
    invert: bool = False,
    **changes: Any,
) -> Conversion:
    """Read any recording and write it as another; memory does not grow with its length.

    Args:
        source: The recording to read.
        out: The file to write; the suffix chooses the format as in `write_events`. None writes to
            ``source``, which stays as it was until all is written.
        options: The caller's statements about the source.
        from_zero: Let the first event be at 0.
        to: Format to write, whatever the suffix.
        homography: File of 3 lines of 3 numbers, or .npy, by which events are moved into the pixels
            of pictures (`evsplat.events.moved`); those that fall outside are left out.
        size: Width and height of those pictures, 1 to 65536, which becomes that of the recording.
        invert: Exchange the polarities, of a driver that has darker for brighter.
        changes: Fields of ``options``, such as ``repair``, or the source's ``format``.
    """
    source, in_place = Path(source), out is None
    out = source if out is None else Path(out)
    mover = _mover(homography, size)
    if not in_place and out.exists() and source.exists() and out.samefile(source):
        raise ConfigError(
            f"{out}: is the recording itself; write to another file, or replace it by --in-place."
        )
    recording = open_recording(source, options, **changes)
    if invert and not recording.has_polarity:
        raise ConfigError(f"--invert: {source} has no polarity to exchange; leave it out.")
    times: list[int] = []
    pieces = _watched(recording, from_zero, times, mover)
    if invert:
        pieces = (EventStream(piece.t, piece.x, piece.y, -piece.p) for piece in pieces)
    width, height = size or (recording.width, recording.height)
    count = write_events(out, pieces, format=to, width=width, height=height)
    start_us, end_us = times or (0, 0)
    notes = recording.notes if mover is None else mover.notes(recording)
    return Conversion(out, count, start_us, end_us, width, height, notes)


def _mover(homography: Path | None, size: tuple[int, int] | None) -> Mover | None:
    """What moves the events; None where they stay where they are."""
    if homography is None:
        if size is not None:
            raise ConfigError(
                "--size: belongs to --homography; that of the sensor is --width and --height."
            )
        return None
    if str(homography) == "auto":
        raise ConfigError(
            "--homography auto: is found by pictures, of which convert has none; import both with "
            "'evsplat import folder' or 'evsplat import video', or give a file."
        )
    if size is None:
        raise ConfigError(
            "--homography: moves events into pixels of pictures; give --size WIDTH HEIGHT, theirs."
        )
    if not all(1 <= side <= 1 << 16 for side in size):
        raise ConfigError(f"--size {size[0]} {size[1]}: expected pixels from 1 to 65536.")
    return Mover.read(Path(homography), size)


def _watched(
    recording: EventRecording, from_zero: bool, times: list[int], mover: Mover | None
) -> Iterator[EventStream]:
    """The chunks, moved and shifted in time, with a progress bar of those that are read.

    ``times`` becomes the first and the last time of what is written.
    """
    shift = 0
    with tqdm(unit="event", unit_scale=True, desc="convert", dynamic_ncols=True) as progress:

        def read() -> Iterator[EventStream]:
            for chunk in recording.chunks():
                yield chunk
                progress.update(len(chunk))

        for chunk in read() if mover is None else mover.moved(read(), recording.path):
            if not times:
                shift = -int(chunk.t[0]) if from_zero else 0
                times[:] = [int(chunk.t[0]) + shift] * 2
            times[1] = int(chunk.t[-1]) + shift
            yield EventStream(chunk.t + shift, chunk.x, chunk.y, chunk.p) if shift else chunk
