"""Conversion of any recording that evsplat reads to one that it writes, piece by piece."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from evsplat.errors import ConfigError
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
    """Assumptions of the reader and what it repaired."""

    @property
    def summary(self) -> str:
        """A few lines for the terminal."""
        size = f", {self.width} x {self.height} pixels" if self.width else ""
        seconds = 1e-6 * (self.end_us - self.start_us)
        lines = [f"written: {self.path}", f"  {self.events:,} events in {seconds:.3f} s{size}"]
        return "\n".join([*lines, *(f"  {note}" for note in self.notes)])


def convert_recording(
    source: Path | str,
    out: Path | str,
    options: ReadOptions | None = None,
    *,
    from_zero: bool = False,
    to: str | None = None,
    **changes: Any,
) -> Conversion:
    """Read any recording and write it as another; memory does not grow with its length.

    Args:
        source: The recording to read.
        out: The file to write; the suffix chooses the format as in `write_events`.
        options: The caller's statements about the source.
        from_zero: Let the first event be at 0.
        to: Format to write, whatever the suffix.
        changes: Fields of ``options``, such as ``repair``, or the source's ``format``.
    """
    source, out = Path(source), Path(out)
    if out.exists() and source.exists() and out.samefile(source):
        raise ConfigError(f"{out}: is the recording itself; write to another file.")
    recording = open_recording(source, options, **changes)
    times: list[int] = []
    pieces = _watched(recording, from_zero, times)
    count = write_events(out, pieces, format=to, width=recording.width, height=recording.height)
    start_us, end_us = times or (0, 0)
    return Conversion(
        out, count, start_us, end_us, recording.width, recording.height, recording.notes
    )


def _watched(recording: EventRecording, from_zero: bool, times: list[int]) -> Iterator[EventStream]:
    """The chunks, shifted, with a progress bar; ``times`` becomes the first and the last time."""
    shift = 0
    with tqdm(unit="event", unit_scale=True, desc="convert", dynamic_ncols=True) as progress:
        for chunk in recording.chunks():
            if not times:
                shift = -int(chunk.t[0]) if from_zero else 0
                times[:] = [int(chunk.t[0]) + shift] * 2
            times[1] = int(chunk.t[-1]) + shift
            yield EventStream(chunk.t + shift, chunk.x, chunk.y, chunk.p) if shift else chunk
            progress.update(len(chunk))
