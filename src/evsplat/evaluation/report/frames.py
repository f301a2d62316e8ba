"""Figures frame by frame beside how fast the person moves."""

from typing import Any

from evsplat.capture import load_body_track
from evsplat.evaluation.report.charts import Series, line_chart
from evsplat.evaluation.report.html import section
from evsplat.evaluation.report.source import Source
from evsplat.objectives import motion_px

_REGIONS = {"person_crop": "person crop", "full": "full frame"}
_MOST_FRAMES = 400
"""Frames whose speed is looked up, evenly spread over a long recording."""


def frame_by_frame(source: Source) -> str:
    """PSNR over time, the person's speed over time, and the one against the other."""
    entries = source.metrics["per_frame"]
    speeds = _speeds(source)
    region = next((r for r in _REGIONS if any(_ours(e, r) is not None for e in entries)), None)
    rows: dict[str, dict[str, float]] = {}
    if region is not None:
        rows[source.metrics["method"]] = _known(entries, lambda e: _ours(e, region))
        compared = [entry for entry in entries if "blurry_input" in entry.get("others", {})]
        camera = _known(compared, lambda e: e["others"]["blurry_input"][region]["psnr"])
        if camera:
            rows["blurry input itself"] = camera
    times = {entry["frame"]: entry["time_us"] / 1e6 for entry in entries}
    charts = []
    if region is not None:
        charts.append(
            line_chart(
                [_series(name, times, values) for name, values in rows.items()],
                x_title="time, s",
                y_title=f"PSNR of the {_REGIONS[region]}, dB",
                dots=True,
            )
        )
    if speeds:
        when = {frame.name: frame.mid_us / 1e6 for frame in source.capture.frames}
        charts.append(
            line_chart(
                [_series("blur", when, speeds)],
                x_title="time, s",
                y_title="Longest path of the body during an exposure, pixels",
            )
        )
    if speeds and region is not None:
        charts.append(
            line_chart(
                [_series(name, speeds, values) for name, values in rows.items()],
                x_title="path during the exposure, pixels",
                y_title=f"PSNR of the {_REGIONS[region]}, dB",
                dots=True,
                lines=False,
            )
        )
    shown = "".join(charts)
    if not shown:
        return ""
    intro = (
        "How far the body moves while the shutter is open."
        if region is None
        else "Held-out frames. The faster the person, the more of a frame is smeared: a picture of "
        "the camera falls with the speed, a reconstruction should not."
    )
    return section("Frame by frame", intro, f'<div class="charts">{shown}</div>')


def _ours(entry: dict[str, Any], region: str) -> float | None:
    value: float | None = entry["protocols"]["standard"][region]["psnr"]
    return value


def _known(entries: list[dict[str, Any]], value: Any) -> dict[str, float]:
    return {e["frame"]: v for e in entries if (v := value(e)) is not None}


def _series(name: str, x: dict[str, float], y: dict[str, float]) -> Series:
    names = sorted((frame for frame in y if frame in x), key=lambda frame: x[frame])
    return Series(name, [x[frame] for frame in names], [y[frame] for frame in names])


def _speeds(source: Source) -> dict[str, float]:
    """Blur of frames in pixels; empty where the capture has no body."""
    capture = source.capture
    if not capture.has_body:
        return {}
    track = load_body_track(capture)
    test = {entry["frame"] for entry in source.metrics["per_frame"]}
    step = -(-len(capture.frames) // _MOST_FRAMES)
    frames = [f for i, f in enumerate(capture.frames) if i % step == 0 or f.name in test]
    return {frame.name: motion_px(capture.camera(frame), track, frame) for frame in frames}
