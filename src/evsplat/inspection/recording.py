"""`evsplat inspect` for a bare event recording: its content, and how it fits its frames."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int64
from PIL import Image

from evsplat.calibration import (
    MOST_PAIRS,
    NoiseEstimate,
    NoiseMeter,
    SensorEstimate,
    dead_lines_text,
    estimate_from_pairs,
    exposure,
    pair,
    pair_indices,
)
from evsplat.errors import DataError
from evsplat.events import EventRecording, EventStream, RecordedFrame, open_recording
from evsplat.files import try_target
from evsplat.inspection.capture import InspectReport, inspect_capture
from evsplat.inspection.drawing import (
    EVENT_WINDOW_US,
    event_tile,
    save_drawings,
    sheet,
    short_number,
)
from evsplat.inspection.folder import note_inspected
from evsplat.inspection.plots import draw_curve
from evsplat.inspection.sensor import sensor_lines

MOST_EVENTS = 20_000_000
"""Kept in memory to compare with frames and to draw; statistics are of the whole recording."""
_RATE_BIN_US = 10_000
_TILES = 8
_SHOWN_HOT_PIXELS = 6


def inspect(path: Path | str, out_dir: Path | str, *, repair: bool = False) -> InspectReport:
    """Inspect a capture folder (`inspect_capture`) or an event recording (`inspect_recording`).

    ``repair`` is of recordings alone.
    """
    path = Path(path)
    # a ROS 2 bag is a folder with a metadata.yaml
    if path.is_file() or (path / "metadata.yaml").is_file():
        return inspect_recording(path, out_dir, repair=repair)
    return inspect_capture(path, out_dir)


def inspect_recording(
    path: Path | str, out_dir: Path | str, *, repair: bool = False
) -> InspectReport:
    """Sum up an event recording of any format and draw it into ``out_dir``.

    Writes events.png and rate.png; where frames were recorded beside the events (AEDAT4) also
    clock.png, how well both agree by the shift between their clocks, and inspected.json, what they
    show. ``repair`` reads on where the file is damaged.

    Raises:
        DataError: not a recording, or one without events.
    """
    path, out_dir = Path(path), Path(out_dir)
    try_target(out_dir)
    recording = open_recording(path, repair=repair)
    totals = _Totals.of(recording)
    spans = [frame.exposure_us for frame in recording.frames()]
    frames = _chosen_frames(recording, spans, totals)
    estimate = _estimate(frames, totals)
    lag_us = estimate.clock.lag_us if estimate is not None else 0.0
    lines = [
        f"{path}",
        f"format     {recording.format}, sensor {_size_text(recording, totals)}",
        f"events     {totals.text(recording.has_polarity)}",
        f"noise      {_noise_text(totals.noise)}",
    ]
    if totals.dead_lines:
        lines.append(f"dead       no event in {totals.dead_lines}, beside which there are many")
    drawings = {
        "events": _events_sheet(path.name, frames, totals, lag_us),
        "rate": totals.draw(path.name),
    }
    if spans:
        lines.append(f"frames     {_frames_text(spans, frames)}")
        lines += sensor_lines(estimate, 0, has_polarity=recording.has_polarity)
    if estimate is not None:
        clock = estimate.clock
        drawings["clock"] = draw_curve(
            f"{path.name}: clock",
            "correlation of brightness change and event count, by how late the events are",
            clock.lags_us,
            clock.correlations,
            x_label="milliseconds",
            x_unit=1000.0,
            marks=[clock.lag_us],
        )
    lines += [f"note       {note}" for note in recording.notes]
    note_inspected(path, out_dir)
    pictures = save_drawings(drawings, out_dir)
    lines.append(f"pictures   {out_dir}: " + ", ".join(picture.name for picture in pictures))
    return InspectReport(path, (), "\n".join(lines), pictures)


@dataclass
class _Totals:
    """Statistics of one pass over the recording."""

    width: int
    height: int
    noise: NoiseEstimate
    dead_lines: str
    """Rows and columns that record nothing, in words; empty where there are none."""
    count: int
    brighter: int
    start_us: int
    end_us: int
    """One past the last event."""
    rate: Float[np.ndarray, "B"]
    """Events per second, in bins of 10 ms from ``start_us``, or one that is as long as all."""
    sample: EventStream
    """The first `MOST_EVENTS` events."""

    @classmethod
    def of(cls, recording: EventRecording) -> "_Totals":
        width, height = _sensor_size(recording)
        meter = NoiseMeter(width, height)
        start = end = count = brighter = 0
        kept: list[EventStream] = []
        bins: list[Int64[np.ndarray, "B 2"]] = []
        for chunk in recording.chunks():
            if not len(chunk):
                continue
            meter.add(chunk)
            start = start if count else int(chunk.t[0])
            end = int(chunk.t[-1]) + 1
            if sum(map(len, kept)) < MOST_EVENTS:
                kept.append(chunk)
            count += len(chunk)
            brighter += int((chunk.p > 0).sum())
            found = np.unique((chunk.t - start) // _RATE_BIN_US, return_counts=True)
            bins.append(np.stack(found, axis=-1))
        if not count:
            raise DataError(f"{recording.path}: holds no events; is it the right file?")
        rows = np.concatenate(bins)
        # of a recording that is shorter than a bin the bin is no longer either
        rate = np.bincount(rows[:, 0], rows[:, 1]) / (min(_RATE_BIN_US, end - start) / 1e6)
        noise, sample = meter.estimate(end - start), EventStream.joined(kept)
        dead = dead_lines_text(meter.total)
        return cls(width, height, noise, dead, count, brighter, start, end, rate, sample)

    def text(self, has_polarity: bool) -> str:
        seconds = (self.end_us - self.start_us) / 1e6
        polarity = (
            f"{100 * self.brighter / self.count:.1f} % brighter" if has_polarity else "no polarity"
        )
        return (
            f"{self.count:,} over {seconds:.3f} s ({short_number(self.count / seconds)}/s, "
            f"at most {short_number(float(self.rate.max()))}/s), {polarity}"
        )

    def draw(self, name: str) -> Image.Image:
        time = np.arange(len(self.rate)) * _RATE_BIN_US
        step = -(-len(time) // 2000)
        shown = [self.rate[k : k + step].mean() for k in range(0, len(time), step)]
        return draw_curve(
            f"{name}: event rate",
            f"{self.count:,} events; events per second over time",
            time[::step].astype(np.float64),
            np.array(shown),
            x_label="seconds from the first event",
            x_unit=1e6,
        )


def _size_text(recording: EventRecording, totals: _Totals) -> str:
    size = f"{totals.width}x{totals.height}"
    return size if recording.width else f"{size} as far as events reach"


def _sensor_size(recording: EventRecording) -> tuple[int, int]:
    """Width and height that the file gives, or as far as events reach."""
    if recording.width is not None and recording.height is not None:
        return recording.width, recording.height
    width = height = 0
    for chunk in recording.chunks():
        if len(chunk):
            width = max(width, int(chunk.x.max()) + 1)
            height = max(height, int(chunk.y.max()) + 1)
    return width, height


def _chosen_frames(
    recording: EventRecording, spans: list[tuple[int, int]], totals: _Totals
) -> list[tuple[RecordedFrame, RecordedFrame]]:
    """Pairs of frames that the events in memory cover; only these are kept."""
    sample = totals.sample
    first, last = int(sample.t[0]), int(sample.t[-1])
    covered = [k for k, (start, end) in enumerate(spans) if first <= start and end <= last]
    pairs = pair_indices([spans[k] for k in covered], MOST_PAIRS)
    wanted = {covered[k] for both in pairs for k in both}
    kept = {k: frame for k, frame in enumerate(recording.frames()) if k in wanted}
    return [(kept[covered[i]], kept[covered[j]]) for i, j in pairs]


def _estimate(
    frames: list[tuple[RecordedFrame, RecordedFrame]], totals: _Totals
) -> SensorEstimate | None:
    t = totals.sample.t
    recorded_us = int(t[0]), int(t[-1]) + 1
    pairs = []
    for both in frames:
        # A DAVIS stores what it measures, without a transfer curve.
        before, after = (
            exposure(_unit(frame.image), frame.exposure_us, transfer="linear") for frame in both
        )
        pairs.append(pair(before, after, recorded_us))
    return estimate_from_pairs(pairs, totals.sample)


def _unit(image: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(image.astype(np.float32) / 255)


def _noise_text(noise: NoiseEstimate) -> str:
    if noise.rate_hz is None:
        text = "not estimated: events all over the picture"
    else:
        share = noise.brighter_share
        text = f"{noise.rate_hz:.2g} Hz per pixel where nothing moves"
        text += "" if share is None else f" ({100 * share:.0f} % brighter)"
    hot = noise.hot_pixels
    if len(hot) == 0:
        return f"{text}; no hot pixels"
    shown = ", ".join(f"({x}, {y})" for x, y in hot[:_SHOWN_HOT_PIXELS])
    more = ", ..." if len(hot) > _SHOWN_HOT_PIXELS else ""
    return f"{text}; {len(hot)} hot pixels (x, y): {shown}{more}"


def _frames_text(
    spans: list[tuple[int, int]], frames: list[tuple[RecordedFrame, RecordedFrame]]
) -> str:
    starts = np.array([start for start, _ in spans])
    text = f"{len(spans)}"
    if frames:
        height, width = frames[0][0].image.shape[:2]
        text += f": {width}x{height}"
    if len(spans) > 1:
        text += f", {1e6 / np.median(np.diff(starts)):.4g} frames/s"
    exposure_ms = np.median([end - start for start, end in spans]) / 1000
    return f"{text}, exposure {exposure_ms:.4g} ms"


def _events_sheet(
    name: str,
    frames: list[tuple[RecordedFrame, RecordedFrame]],
    totals: _Totals,
    lag_us: float,
) -> Image.Image:
    """Events over the frames of the same time or, without frames, over nothing."""
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(_TILES, len(frames))).astype(int))
    shown = [frames[k][0] for k in chosen]
    blank = torch.full((totals.height, totals.width, 3), 0.25)
    t = totals.sample.t
    instants = np.linspace(t[0], t[-1], 2 * _TILES + 1)[1::2]
    pictures_at = [(blank, int(time)) for time in instants]
    if shown:
        pictures_at = [
            (_rgb(frame.image), round(sum(frame.exposure_us) / 2 + lag_us)) for frame in shown
        ]
    tiles = [
        event_tile(totals.sample, picture, middle, f"{(middle - totals.start_us) / 1e6:.3f} s")
        for picture, middle in pictures_at
    ]
    over = "over the frames, the clock's lag taken out" if shown else "at eight instants"
    subtitle = f"{EVENT_WINDOW_US / 1000:g} ms of events {over}; red: brighter, blue: darker"
    return sheet(f"{name}: events", subtitle, tiles, columns=4)


def _rgb(image: np.ndarray) -> torch.Tensor:
    picture = _unit(image)
    return picture if picture.ndim == 3 else picture[..., None].expand(-1, -1, 3)
