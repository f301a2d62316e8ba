"""Measured frames: their pictures, whole and around the person, and figures over time."""

from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from jaxtyping import UInt8

from evsplat.capture import Frame, load_body_track
from evsplat.capture.policy import Terms, terms_of
from evsplat.evaluation.regions import HumanRegions
from evsplat.evaluation.report.charts import Series, line_chart
from evsplat.evaluation.report.figures import frame_figures, no_test_figures
from evsplat.evaluation.report.source import Source
from evsplat.evaluation.splits import split_of, words_of
from evsplat.objectives import motion_px
from evsplat.pages import (
    Embedder,
    compare,
    figure,
    folded,
    legend,
    more,
    section,
)
from evsplat.pictures import to_bytes
from evsplat.pictures.box import Box
from evsplat.pictures.colours import ERROR_FULL_SCALE, css_gradient
from evsplat.spread import evenly_spread
from evsplat.wording import begun

_WORTH_ENLARGING = 0.8
"""Crops wider than this share of the picture show nothing new."""
_FRAMES_OPEN = 4
"""Test frames shown at once, evenly spread; the others are folded."""
_MOST_PIXELS = 24_000_000
"""Pixels of all pictures of test frames on a page; of a longer recording fewer frames are shown."""
_TRAINING_TERMS = (
    "Training saw the blurry pictures and the events of these times; the sharp truth it never sees."
)
_OWN_TRUTH_TERMS = (
    "Training saw the pictures and the events of these times; the pictures are taken as the sharp "
    "truth."
)
_INPUT, _OWN_TRUTH, _RENDER = "blurry input", "recorded picture, taken as sharp", "our render"
_REGIONS = {"person_crop": "person crop", "full": "full frame"}
_MOST_FRAMES = 400
"""Frames whose speed is looked up, evenly spread over a long recording."""

Pictures = dict[str, UInt8[np.ndarray, "H W 3"]]
"""Pictures by title; without truth there is neither truth nor error."""


def test_frames(source: Source) -> str:
    """The section with all frames that were measured."""
    words = words_of(source.metrics)
    why = no_test_figures(source.metrics)
    if why is not None:
        return section(words.title, "", f'<p class="note">{begun(why)}</p>')
    entries = source.metrics["per_frame"]
    # Per frame four pictures and crops of about a third of their area.
    camera = source.capture.camera(entries[0]["frame"])
    pixels_each = camera.width * camera.height * 16 // 3
    most = max(2 * _FRAMES_OPEN, _MOST_PIXELS // pixels_each)
    chosen = [FramePictures.of(source, entry) for entry in _chosen_entries(entries, most)]
    embed = Embedder.for_pixels(pixels_each * len(chosen))
    shown = chosen[:_FRAMES_OPEN]
    others = sorted(chosen[_FRAMES_OPEN:], key=lambda one: one.frame.mid_us)
    folds = "".join(_test_frame(one, embed) for one in others)
    scale = legend(
        css_gradient(signed=False), "0", f"{ERROR_FULL_SCALE} levels of 255 and more", "error"
    )
    return section(
        words.title,
        _terms(source.metrics, chosen),
        (scale if any("error" in one.pictures for one in chosen) else "")
        + "".join(_test_frame(one, embed) for one in shown)
        + folded(more(len(others), len(entries) - len(shown), words.frame), folds),
    )


def _terms(metrics: dict[str, Any], shown: list["FramePictures"]) -> str:
    """What training could know of the frames that are shown."""
    if split_of(metrics) != "train":
        return _held_out_terms(terms_of(metrics))
    sharp = all(one.recorded == _OWN_TRUTH for one in shown)
    return _OWN_TRUTH_TERMS if sharp else _TRAINING_TERMS


def _held_out_terms(terms: Terms | None) -> str:
    """Sentences on what training could know of the intervals in which the test frames lie."""
    if terms is None:
        return "Held out; nothing tells what training saw of these times."
    events = ""
    if terms.sees_events:
        events = (
            ", but the events of the intervals around them"
            if terms.held_out_events
            else ", and no event of the intervals around them"
        )
    given = terms.held_out_poses == "given"
    poses = "given" if given else "interpolated from those of training frames"
    return (
        f"Held out: training saw neither picture nor mask of these times{events}. The body’s "
        f"poses there were {poses}."
    )


def _chosen_entries(entries: list[dict[str, Any]], most: int) -> list[dict[str, Any]]:
    """The most blurred frame, then some evenly spread ones, then others, evenly spread."""
    hardest = min(entries, key=_known_psnr)
    first = [hardest, *(e for e in evenly_spread(entries, _FRAMES_OPEN - 1) if e is not hardest)]
    rest = [entry for entry in entries if entry not in first]
    return [*first, *evenly_spread(rest, max(2, most - len(first)))]


def _known_psnr(entry: dict[str, Any]) -> float:
    """PSNR of the blurry input on the person, or on the full frame: how hard the frame is."""
    blurry = entry.get("others", {}).get("blurry_input", {})
    known = [blurry[region]["psnr"] for region in ("person_mask", "person_crop", "full") if blurry]
    return next((value for value in known if value is not None), float("inf"))


@dataclass(frozen=True, eq=False)
class FramePictures:
    """One test frame with all its pictures."""

    frame: Frame
    figures: dict[str, dict[str, float | None]]
    """Figures of protocol standard, by region and metric."""
    pictures: Pictures
    recorded: str
    """Title of the camera's own picture."""
    human: Box | None

    @classmethod
    def of(cls, source: Source, entry: dict[str, Any]) -> "FramePictures":
        """Collect the pictures that the evaluation wrote and those of the capture."""
        capture = source.capture
        frame = capture.frame(entry["frame"])
        recorded = _OWN_TRUTH if capture.is_own_truth(frame) else _INPUT
        pictures = {
            recorded: to_bytes(capture.shown(capture.image(frame))),
            _RENDER: source.picture(entry["pictures"]["render"]),
        }
        if frame.sharp is not None:
            if recorded == _INPUT:
                pictures["sharp truth"] = to_bytes(capture.shown(capture.sharp(frame)))
            pictures["error"] = source.picture(entry["pictures"]["error"])
        return cls(
            frame,
            entry["protocols"]["standard"],
            pictures,
            recorded,
            HumanRegions(capture).crop(frame),
        )

    def crops(self, aspect: float) -> Pictures:
        """The pictures around the person, at least ``aspect`` times as wide as high.

        Empty where nobody is seen or where the person fills the picture anyway.
        """
        if self.human is None:
            return {}
        width = self.pictures[_RENDER].shape[1]
        box = self.human.at_least(aspect, width)
        if box.right - box.left > _WORTH_ENLARGING * width:
            return {}
        return {
            title: np.ascontiguousarray(box.crop(picture))
            for title, picture in self.pictures.items()
        }


def _test_frame(test: FramePictures, embed: Embedder) -> str:
    frame = test.frame
    exposure_ms = (frame.exposure_us[1] - frame.exposure_us[0]) / 1000
    return (
        f'<article class="frame"><h3>Frame {escape(frame.name)} '
        f"<small>{frame.mid_us / 1e6:.3f} s · exposure {exposure_ms:g} ms"
        f"{frame_figures(test.figures)}</small></h3>"
        + _row(test.pictures, test.recorded, f"frame {frame.name}", embed)
        + _row(test.crops(2 / 3), test.recorded, f"person in frame {frame.name}", embed)
        + "</article>"
    )


def _row(pictures: Pictures, recorded: str, place: str, embed: Embedder) -> str:
    """The ``recorded`` picture and the render behind a slider, truth and error beside them."""
    if not pictures:
        return ""
    images = {title: embed.image(p, f"{title}, {place}") for title, p in pictures.items()}
    first = compare(images.pop(recorded), images.pop(_RENDER), f"{recorded} | {_RENDER}")
    rest = "".join(figure(image, title) for title, image in images.items())
    return f'<div class="grid shots n{1 + len(images)}">{first}{rest}</div>'


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
    charts, psnr = "", "" if region is None else f"PSNR of the {_REGIONS[region]}, dB"
    if rows:
        times = {entry["frame"]: entry["time_us"] / 1e6 for entry in entries}
        lines = [_series(name, times, values) for name, values in rows.items()]
        charts += line_chart(lines, x_title="time, s", y_title=psnr, dots=True)
    if speeds:
        mids = {frame.name: frame.mid_us / 1e6 for frame in source.capture.frames}
        title = "Longest path of the body during an exposure, pixels"
        charts += line_chart([_series("blur", mids, speeds)], x_title="time, s", y_title=title)
    if speeds and rows:
        lines = [_series(name, speeds, values) for name, values in rows.items()]
        title = "path during the exposure, pixels"
        charts += line_chart(lines, x_title=title, y_title=psnr, dots=True, lines=False)
    if not charts:
        return ""
    intro = (
        "How far the body moves while the shutter is open."
        if region is None
        else f"{begun(words_of(source.metrics).frame)}s. The faster the person, the more of "
        "a frame is smeared: a picture of the camera falls with the speed, a reconstruction should "
        "not."
    )
    return section("Frame by frame", intro, f'<div class="charts">{charts}</div>')


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
    ends = [capture.cameras_at(frame.camera, frame.exposure_us) for frame in frames]
    return {
        frame.name: motion_px(cameras, track, frame)
        for frame, cameras in zip(frames, ends, strict=True)
    }
