"""The test frames: input, render, truth and error, whole and around the person."""

from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from jaxtyping import UInt8

from evsplat.capture import Frame, Policy
from evsplat.capture.policy import policy_of
from evsplat.evaluation.regions import Box
from evsplat.evaluation.report.embed import Embedder
from evsplat.evaluation.report.figures import no_test_figures
from evsplat.evaluation.report.html import (
    compare,
    figure,
    folded,
    frame_figures,
    legend,
    more,
    section,
    spread,
)
from evsplat.evaluation.report.source import Source
from evsplat.pictures import to_bytes
from evsplat.pictures.colours import ERROR_FULL_SCALE, css_gradient

_WORTH_ENLARGING = 0.8
"""Crops wider than this share of the picture show nothing new."""
_FRAMES_OPEN = 4
"""Test frames shown at once, evenly spread; the others are folded."""
_MOST_PIXELS = 24_000_000
"""Pixels of all pictures of test frames on a page; of a longer recording fewer frames are shown."""
_INPUT, _RENDER = "blurry input", "our render"

Pictures = dict[str, UInt8[np.ndarray, "H W 3"]]
"""By title; without truth there is neither truth nor error."""


def test_frames(source: Source) -> str:
    """The section with all test frames."""
    why = no_test_figures(source.metrics)
    if why is not None:
        return section("Test frames", "", f'<p class="note">{why[0].upper()}{why[1:]}</p>')
    entries = source.metrics["per_frame"]
    # Per frame four pictures and crops of about a third of their area.
    camera = source.capture.camera(entries[0]["frame"])
    pixels_each = camera.width * camera.height * 16 // 3
    most = max(2 * _FRAMES_OPEN, _MOST_PIXELS // pixels_each)
    shots = [Shot.of(source, entry) for entry in _worth_showing(entries, most)]
    embed = Embedder.for_pixels(pixels_each * len(shots))
    shown = shots[:_FRAMES_OPEN]
    others = sorted(shots[_FRAMES_OPEN:], key=lambda shot: shot.frame.mid_us)
    folds = "".join(_test_frame(shot, embed) for shot in others)
    scale = legend(
        css_gradient(signed=False), "0", f"{ERROR_FULL_SCALE} levels of 255 and more", "error"
    )
    return section(
        "Test frames",
        _shown_to_training(policy_of(source.metrics)),
        (scale if any("error" in shot.pictures for shot in shots) else "")
        + "".join(_test_frame(shot, embed) for shot in shown)
        + folded(more(len(others), len(entries) - len(shown), "test frames"), folds),
    )


def _shown_to_training(policy: Policy | None) -> str:
    """What training could know of the intervals in which the test frames lie."""
    if policy is None:
        return "Held out; the run does not tell what training saw of these times."
    events = (
        "but the events of the intervals around them"
        if policy.held_out_events
        else "and no event of the intervals around them"
    )
    poses = {
        "given": "given",
        "interpolated": "interpolated from those of training frames",
    }[policy.held_out_poses]
    return (
        f"Held out: training saw neither picture nor mask of these times, {events}. The body’s "
        f"poses there were {poses}."
    )


def _worth_showing(entries: list[dict[str, Any]], most: int) -> list[dict[str, Any]]:
    """The most blurred frame, then some evenly spread ones, then others, evenly spread."""
    hardest = min(entries, key=lambda entry: _known_psnr(entry, 1e9))
    first = [hardest, *(e for e in spread(entries, _FRAMES_OPEN - 1) if e is not hardest)]
    rest = [entry for entry in entries if entry not in first]
    return [*first, *spread(rest, max(2, most - len(first)))]


def _known_psnr(entry: dict[str, Any], otherwise: float) -> float:
    """PSNR of the blurry input on the person, or on the full frame: how hard the frame is."""
    blurry = entry.get("others", {}).get("blurry_input", {})
    known = [blurry[region]["psnr"] for region in ("person_mask", "person_crop", "full") if blurry]
    return next((value for value in known if value is not None), otherwise)


@dataclass(frozen=True, eq=False)
class Shot:
    """One test frame with all its pictures."""

    frame: Frame
    figures: dict[str, dict[str, float | None]]
    """Of protocol standard, by region and metric."""
    pictures: Pictures
    person: Box | None

    @classmethod
    def of(cls, source: Source, entry: dict[str, Any]) -> "Shot":
        """Collect what the evaluation wrote and what the capture has."""
        frame = source.capture.frame(entry["frame"])
        pictures = {
            _INPUT: to_bytes(source.capture.image(frame)),
            _RENDER: source.picture(entry["pictures"]["render"]),
        }
        if frame.sharp is not None:
            pictures["sharp truth"] = to_bytes(source.capture.sharp(frame))
            pictures["error"] = source.picture(entry["pictures"]["error"])
        return cls(
            frame,
            entry["protocols"]["standard"],
            pictures,
            source.person(frame.name),
        )

    def crops(self, aspect: float) -> Pictures:
        """The pictures around the person, at least ``aspect`` times as wide as high.

        Empty where nobody is seen or where the person fills the picture anyway.
        """
        if self.person is None:
            return {}
        height, width = self.pictures[_RENDER].shape[:2]
        box = self.person.at_least(aspect, height, width)
        if box.right - box.left > _WORTH_ENLARGING * width:
            return {}
        return {
            title: np.ascontiguousarray(box.crop(picture))
            for title, picture in self.pictures.items()
        }


def _test_frame(shot: Shot, embed: Embedder) -> str:
    frame = shot.frame
    exposure_ms = (frame.exposure_us[1] - frame.exposure_us[0]) / 1000
    return (
        f'<article class="frame"><h3>Frame {escape(frame.name)} '
        f"<small>{frame.mid_us / 1e6:.3f} s · exposure {exposure_ms:g} ms"
        f"{frame_figures(shot.figures)}</small></h3>"
        + _row(shot.pictures, f"frame {frame.name}", embed)
        + _row(shot.crops(2 / 3), f"person in frame {frame.name}", embed)
        + "</article>"
    )


def _row(pictures: Pictures, place: str, embed: Embedder) -> str:
    """Input and render behind a slider, truth and error beside them."""
    if not pictures:
        return ""
    images = {title: embed.image(p, f"{title}, {place}") for title, p in pictures.items()}
    first = compare(images.pop(_INPUT), images.pop(_RENDER), "blurry input | our render")
    rest = "".join(figure(image, title) for title, image in images.items())
    return f'<div class="grid shots n{1 + len(images)}">{first}{rest}</div>'
