"""Checks of the event file; the deep ones read it in pieces."""

import os
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

from evsplat.calibration import dead_lines_text
from evsplat.capture.finding import Findings, reason_and_remedy
from evsplat.capture.metadata import EventsEntry, Metadata
from evsplat.capture.stillness import nothing_moves
from evsplat.errors import DataError
from evsplat.events.store import INDEX_PIECE
from evsplat.untrusted.faults import BROKEN, reason
from evsplat.untrusted.hdf5 import open_hdf5, wrong_data_set

_COLUMNS = {"t": np.int64, "x": np.uint16, "y": np.uint16, "p": np.uint8}
_SCAN_EVENTS = 1 << 20
_SHORT = 500_000
"""Events of a recording that is scanned whenever it is opened, which takes some 20 ms."""
_INDEX_SAMPLES = 64
_MOST_PIXELS = 1 << 24
"""Of a sensor whose events are counted by pixel: more are announced, not built."""
_REPAIR = "Copy the file again or write it anew."


def check_events(metadata: Metadata, findings: Findings, *, deep: bool) -> None:
    """Layout, clock and sensor size; every event if ``deep``, and of short recordings always."""
    entry = metadata.events
    if entry is None:
        _check_unnamed(metadata, findings)
        return
    _check_sensor(metadata, entry, findings)
    if not os.path.isfile(entry.file):
        findings.error(entry.file, "", "no such file", "the event recording", "Restore the file.")
        return
    try:
        with open_hdf5(entry.file) as file:
            if not _check_layout(entry.file, file, findings):
                return
            _check_clock(metadata, entry, file, findings)
            if deep or len(file["events/t"]) <= _SHORT:
                _Scan(entry, file, findings, counting=deep).run()
            else:
                _check_index(entry, file, findings)
    except DataError as error:
        found, remedy = reason_and_remedy(error, entry.file)
        findings.error(entry.file, "", found, "a whole HDF5 file", remedy)
    except BROKEN as error:
        found = f"a file that HDF5 cannot read ({reason(error)})"
        findings.error(entry.file, "", found, "a whole HDF5 file", _REPAIR)


def _check_unnamed(metadata: Metadata, findings: Findings) -> None:
    """A video alone is a capture as well, unless its events were forgotten."""
    if any(finding.field.partition(".")[0] == "events" for finding in findings.items):
        return  # an entry there is, with faults
    if os.path.isfile(metadata.path / "events.h5"):
        findings.warning(
            metadata.path / "capture.json",
            "events",
            "no such entry, though events.h5 lies beside",
            "the events that were recorded",
            "Name the file and its sensor's size there, or remove it if it is of something else.",
        )


def _check_sensor(metadata: Metadata, entry: EventsEntry, findings: Findings) -> None:
    file = metadata.path / "capture.json"
    names = sorted({frame.camera for frame in metadata.frames})
    if len(names) > 1:
        findings.error(
            file,
            "events",
            f"frames of {len(names)} cameras {names}",
            "frames of the one camera that the events belong to",
            "Split the capture, one per camera.",
        )
    for name in names:
        camera = metadata.cameras[name]
        if (entry.width, entry.height) != (camera.width, camera.height):
            findings.error(
                file,
                "events.width",
                f"a sensor of {entry.width}x{entry.height} pixels",
                f"{camera.width}x{camera.height} pixels of camera {name!r}",
                "Events and pictures share their pixels: resample or crop one of them.",
            )


def _check_layout(path: Path, file: h5py.File, findings: Findings) -> bool:
    """True where all data sets are there, one-dimensional and equally long."""
    before = findings.error_count()
    names = [f"events/{column}" for column in _COLUMNS]
    for name in [*names, "ms_to_idx", "t_offset"]:
        found = wrong_data_set(file, name)
        if found:
            findings.error(path, name, found, "a data set", "Write the file anew.")
    if findings.error_count() > before:
        return False
    lengths = {name: file[name].shape for name in names}
    if len(set(lengths.values())) != 1 or len(lengths["events/t"]) != 1:
        found = ", ".join(f"{name} {shape}" for name, shape in lengths.items())
        findings.error(path, "events", found, "four equally long columns", _REPAIR)
    for column, dtype in _COLUMNS.items():
        stored = file[f"events/{column}"].dtype
        if stored.kind not in "iu":
            findings.error(
                path, f"events/{column}", f"{stored}", f"{np.dtype(dtype)}", "Convert the column."
            )
        elif stored != dtype:
            findings.warning(
                path, f"events/{column}", f"{stored}", f"{np.dtype(dtype)}", "Convert the column."
            )
    for name, shape in (("ms_to_idx", 1), ("t_offset", 0)):
        data = file[name]
        if data.ndim != shape or data.dtype.kind not in "iu":
            findings.error(
                path,
                name,
                f"{data.dtype} with {data.ndim} dimensions",
                f"whole numbers with {shape} dimensions",
                "Write the file anew.",
            )
    for name in names:
        _check_filters(path, name, file[name], findings)
    return findings.error_count() == before


def _check_filters(path: Path, name: str, data: h5py.Dataset, findings: Findings) -> None:
    properties = data.id.get_create_plist()
    for position in range(properties.get_nfilters()):
        number, _, _, label = properties.get_filter(position)
        if not h5py.h5z.filter_avail(number):
            findings.error(
                path,
                name,
                f"compression filter {number} ({label.decode(errors='replace')})",
                "a filter that this HDF5 can read",
                "Install and import hdf5plugin, or rewrite the file with gzip.",
            )


def _check_clock(
    metadata: Metadata, entry: EventsEntry, file: h5py.File, findings: Findings
) -> None:
    """Findings where the recording does not cover the exposures, on the camera's clock.

    Of a sensor without noise it covers what moves: none where nothing moves in the pictures beside.
    """
    t = file["events/t"]
    if len(t) == 0:
        findings.warning(
            entry.file, "events", "no event", "events", "Check the recording of the sensor."
        )
        return
    if not metadata.frames:
        return
    shift = entry.clock_offset_us + int(file["t_offset"][()])
    first, last = int(t[0]) + shift, int(t[-1]) + shift
    start = min(frame.exposure_us[0] for frame in metadata.frames)
    end = max(frame.exposure_us[1] for frame in metadata.frames)
    found, expected = f"events from {first} to {last} us", f"events over {start}..{end} us"
    clock = "events.clock_offset_us or t_offset (added to t to get the camera's clock)."
    if last < start or first >= end:
        findings.error(entry.file, "events/t", found, expected, f"Correct {clock}")
        return
    spacing = (end - start) / len(metadata.frames)
    before = [frame for frame in metadata.frames if frame.exposure_us[1] <= first]
    after = [frame for frame in metadata.frames if frame.exposure_us[0] > last]
    late = first > start + spacing and not nothing_moves(metadata, before)
    early = last < end - spacing and not nothing_moves(metadata, after)
    if late or early:
        remedy = f"Correct {clock}"
        if last - first < end - start - spacing:
            remedy = (
                "They last shorter than the frames, whatever their clock: the sensor was switched "
                "on later or off earlier, or t is not in microseconds. If their clock is wrong as "
                f"well, correct {clock}"
            )
        remedy += (
            " Where more than two frames, or such as differ, lie beside them, these are learned "
            "from their blur alone."
        )
        findings.warning(entry.file, "events/t", found, expected, remedy)


def _check_index(entry: EventsEntry, file: h5py.File, findings: Findings) -> None:
    """Whether ms_to_idx ascends, and `_INDEX_SAMPLES` entries lead to the right events."""
    t, index = file["events/t"], file["ms_to_idx"]
    count = len(t)
    if count == 0:
        return
    last_ms = int(t[-1]) // 1000
    if last_ms >= len(index):
        _note_short_index(entry, file, last_ms + 1, findings)
        return
    if (wrong := _descent(index)) is not None:
        _note_wrong_index(entry, wrong, int(index[wrong]), findings)
        return
    first_ms = max(0, int(t[0]) // 1000)
    # Of times below 0 the index has no entries.
    samples = _INDEX_SAMPLES if last_ms >= 0 else 0
    asked = np.unique(np.linspace(first_ms, last_ms, samples).round())
    for ms in map(int, asked):
        row, time = int(index[ms]), 1000 * ms
        found = 0 <= row <= count
        found = found and (row == 0 or int(t[row - 1]) < time)
        if not found or (row < count and int(t[row]) < time):
            _note_wrong_index(entry, ms, row, findings)
            return


def _descent(index: h5py.Dataset) -> int | None:
    """The first millisecond whose entry is less than the one before it."""
    for start in range(0, len(index), INDEX_PIECE):
        piece = index[max(0, start - 1) : start + INDEX_PIECE]
        falls = np.flatnonzero(piece[1:] < piece[:-1])
        if len(falls):
            return max(0, start - 1) + int(falls[0]) + 1
    return None


def _note_wrong_index(entry: EventsEntry, ms: int, row: int, findings: Findings) -> None:
    findings.error(
        entry.file,
        f"ms_to_idx[{ms}]",
        str(row),
        f"the first event with t >= {1000 * ms}",
        "Rebuild ms_to_idx, or write the recording anew with evsplat convert.",
    )


def _note_short_index(entry: EventsEntry, file: h5py.File, needed: int, findings: Findings) -> None:
    remedy = "Rebuild ms_to_idx."
    first, last = int(file["events/t"][0]), int(file["events/t"][-1])
    if last - first < first:  # such as the time since 1970, whose index no disk holds
        remedy = (
            f"Subtract {first // 1000 * 1000} from t, add it to t_offset and rebuild ms_to_idx."
        )
    findings.error(
        entry.file,
        "ms_to_idx",
        f"{len(file['ms_to_idx'])} milliseconds",
        f"at least {needed}, one per millisecond up to the last event",
        remedy,
    )


class _Scan:
    """One pass over the events in pieces: order, coordinates, polarity and the index."""

    def __init__(
        self, entry: EventsEntry, file: h5py.File, findings: Findings, *, counting: bool
    ) -> None:
        self.entry, self.file, self.findings = entry, file, findings
        self.first: dict[str, tuple[int, str]] = {}
        """Per kind of fault the first event and what is wrong with it."""
        self.count: dict[str, int] = {}
        self.index_fault: tuple[int, int, int] | None = None
        """Millisecond, stored index and right index of the first wrong entry of ms_to_idx."""
        counting = counting and entry.height * entry.width <= _MOST_PIXELS
        self.counts = np.zeros((entry.height, entry.width), np.int64) if counting else None
        """Events of each pixel of the sensor, where they are asked for."""
        self.next_ms = 0
        self.previous_t: int | None = None

    def run(self) -> None:
        total = len(self.file["events/t"])
        for start in range(0, total, _SCAN_EVENTS):
            stop = min(start + _SCAN_EVENTS, total)
            try:
                columns = [self.file[f"events/{name}"][start:stop] for name in _COLUMNS]
            except OSError as error:
                self.findings.error(
                    self.entry.file,
                    "events",
                    f"events {start}..{stop - 1} that cannot be read ({error})",
                    "whole compressed data",
                    _REPAIR,
                )
                return
            self.piece(start, *columns)
        if "t" not in self.count:
            self.rest_of_index(total)
        self.report(total)
        if self.counts is not None and not self.count:
            self.report_dead_lines(self.counts)

    def piece(self, start: int, t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray) -> None:
        t = t.astype(np.int64)
        before = t[:1] if self.previous_t is None else np.array([self.previous_t])
        steps = np.diff(t, prepend=before)
        self.previous_t = int(t[-1])
        self.note("t", start, steps < 0, lambda i: f"{t[i]}, {-steps[i]} us before the one before")
        self.note("x", start, (x >= self.entry.width) | (x < 0), lambda i: f"{x[i]}")
        self.note("y", start, (y >= self.entry.height) | (y < 0), lambda i: f"{y[i]}")
        self.note("p", start, (p != 0) & (p != 1), lambda i: f"{p[i]}")
        if self.counts is not None and not self.count.keys() & {"x", "y"}:
            # Of numbers without a sign the sum would be one with a point.
            place = y.astype(np.int64) * self.entry.width + x.astype(np.int64)
            self.counts += np.bincount(place, minlength=self.counts.size).reshape(self.counts.shape)
        if "t" not in self.count:
            self.piece_of_index(start, t)

    def note(self, column: str, start: int, wrong: np.ndarray, words: Callable[[int], str]) -> None:
        if wrong.any():
            at = int(np.argmax(wrong))
            self.first.setdefault(column, (start + at, words(at)))
            self.count[column] = self.count.get(column, 0) + int(wrong.sum())

    def piece_of_index(self, start: int, t: np.ndarray) -> None:
        """Entries of ms_to_idx that this piece decides: those up to its last event."""
        end_ms = int(t[-1]) // 1000 + 1
        if end_ms > self.next_ms:
            stored = self.file["ms_to_idx"][self.next_ms : end_ms].astype(np.int64)
            edges = np.arange(self.next_ms, self.next_ms + len(stored)) * 1000
            self.compare_index(stored, start + np.searchsorted(t, edges, side="left"))
            self.next_ms = end_ms

    def rest_of_index(self, total: int) -> None:
        length = len(self.file["ms_to_idx"])
        if self.next_ms > length:
            _note_short_index(self.entry, self.file, self.next_ms, self.findings)
            return
        stored = self.file["ms_to_idx"][self.next_ms :].astype(np.int64)
        self.compare_index(stored, np.full(len(stored), total))

    def compare_index(self, stored: np.ndarray, right: np.ndarray) -> None:
        wrong = stored != right
        if wrong.any() and self.index_fault is None:
            at = int(np.argmax(wrong))
            self.index_fault = (self.next_ms + at, int(stored[at]), int(right[at]))

    def report_dead_lines(self, counts: np.ndarray) -> None:
        """A warning where rows or columns have no event between others with many."""
        if lines := dead_lines_text(counts):
            self.findings.warning(
                self.entry.file,
                "events/y" if lines.startswith("row") else "events/x",
                f"no event in {lines}",
                "events there as in the rows and columns beside, which have many",
                "The sensor or its link loses them, or they were put into more pixels than it "
                "has. A few such lines cost next to nothing in training.",
            )

    def report(self, total: int) -> None:
        width, height = self.entry.width, self.entry.height
        expected = {
            "t": ("ascending times", "Sort the events by t and rebuild ms_to_idx."),
            "x": (f"a column below {width}", "Correct events.width or remove these events."),
            "y": (f"a row below {height}", "Correct events.height or remove these events."),
            "p": ("0 (darker) or 1 (brighter)", "Convert the polarities."),
        }
        for column, (index, words) in self.first.items():
            rule, remedy = expected[column]
            self.findings.error(
                self.entry.file,
                f"events/{column}[{index}]",
                f"{words} ({self.count[column]} of {total} events)",
                rule,
                remedy,
            )
        if self.index_fault is not None:
            millisecond, stored, right = self.index_fault
            self.findings.error(
                self.entry.file,
                f"ms_to_idx[{millisecond}]",
                str(stored),
                f"{right}, the first event with t >= {millisecond * 1000}",
                "Rebuild ms_to_idx.",
            )
