"""The test frames: input, render, truth and error, whole and around the person."""

from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from jaxtyping import UInt8

from evsplat.capture import Frame
from evsplat.evaluation.pictures import ERROR_FULL_SCALE, css_gradient, to_bytes
from evsplat.evaluation.regions import Box
from evsplat.evaluation.report.embed import Embedder
from evsplat.evaluation.report.html import figure, folded, frame_figures, legend, section, spread
from evsplat.evaluation.report.source import Source

_WORTH_ENLARGING = 0.8
"""Crops wider than this share of the picture show nothing new."""
_FRAMES_OPEN = 4
"""Test frames shown at once, evenly spread; the others are folded."""


def test_frames(source: Source) -> str:
    """The section with all test frames."""
    entries = source.metrics["per_frame"]
    if not entries:
        return section("Test frames", "", '<p class="note">No frame has split “test”.</p>')
    shots = [Shot.of(source, entry) for entry in entries]
    # Per frame the pictures themselves and crops of about a third of the area.
    pixels = sum(picture.size // 3 for shot in shots for picture in shot.pictures.values())
    embed = Embedder.for_pixels(pixels * 4 // 3)
    shown = spread(shots, _FRAMES_OPEN)
    others = [shot for shot in shots if shot not in shown]
    more = "".join(_test_frame(shot, embed) for shot in others)
    scale = legend(
        css_gradient(signed=False), "0", f"{ERROR_FULL_SCALE} levels of 255 and more", "error"
    )
    return section(
        "Test frames",
        "Held out: the training saw the body's pose at these times, but neither picture nor mask.",
        _slider(shots, embed)
        + (scale if any("error" in shot.pictures for shot in shots) else "")
        + "".join(_test_frame(shot, embed) for shot in shown)
        + folded(f"{len(others)} more test frames", more),
    )


@dataclass(frozen=True, eq=False)
class Shot:
    """One test frame with all its pictures."""

    frame: Frame
    figures: dict[str, dict[str, float | None]]
    """Of protocol standard, by region and metric."""
    input_psnr: float | None
    """PSNR of the blurry input on the person (or the full frame): how hard the frame is."""
    pictures: dict[str, UInt8[np.ndarray, "H W 3"]]
    """By title; without truth there is neither truth nor error."""
    person: Box | None

    @classmethod
    def of(cls, source: Source, entry: dict[str, Any]) -> "Shot":
        """Collect what the evaluation wrote and what the capture has."""
        frame = source.capture.frame(entry["frame"])
        pictures = {
            "blurry input": to_bytes(source.capture.image(frame)),
            "our render": source.picture(entry["pictures"]["render"]),
        }
        if frame.sharp is not None:
            pictures["sharp truth"] = to_bytes(source.capture.sharp(frame))
            pictures["error"] = source.picture(entry["pictures"]["error"])
        blurry = entry["others"]["blurry_input"]
        known = [blurry[region]["psnr"] for region in ("person_mask", "person_crop", "full")]
        return cls(
            frame,
            entry["protocols"]["standard"],
            next((value for value in known if value is not None), None),
            pictures,
            source.person(frame.name),
        )

    def crops(self, aspect: float) -> dict[str, UInt8[np.ndarray, "h w 3"]]:
        """The pictures around the person, at least ``aspect`` times as wide as high.

        Empty where nobody is seen or where the person fills the picture anyway.
        """
        if self.person is None:
            return {}
        height, width = self.pictures["our render"].shape[:2]
        box = self.person.at_least(aspect, height, width)
        if box.right - box.left > _WORTH_ENLARGING * width:
            return {}
        return {
            title: np.ascontiguousarray(box.crop(picture))
            for title, picture in self.pictures.items()
        }


def _slider(shots: list[Shot], embed: Embedder) -> str:
    """The most blurred frame: input and render behind a slider, the truth beside them."""
    shot = min(shots, key=lambda shot: shot.input_psnr if shot.input_psnr is not None else 1e9)
    pictures = shot.crops(1.0) or shot.pictures
    name = shot.frame.name
    blurry = embed.image(pictures["blurry input"], f"blurry input, frame {name}")
    render = embed.image(pictures["our render"], f"our render, frame {name}")
    compare = (
        f'<figure><div class="compare">{blurry}<div class="over">{render}</div>'
        '<input type="range" min="0" max="100" value="50" step="any" '
        'aria-label="share of the blurry input" '
        "oninput=\"this.parentNode.style.setProperty('--x',this.value+'%')\"></div>"
        f"<figcaption>frame {escape(name)}, drag: blurry input | our render</figcaption></figure>"
    )
    truth = ""
    if "sharp truth" in pictures:
        truth = figure(embed.image(pictures["sharp truth"], f"truth, frame {name}"), "sharp truth")
    return f'<div class="grid n2 wide">{compare}{truth}</div>'


def _test_frame(shot: Shot, embed: Embedder) -> str:
    frame = shot.frame
    full = "".join(
        figure(embed.image(picture, f"{title}, frame {frame.name}"), title)
        for title, picture in shot.pictures.items()
    )
    crops = "".join(
        figure(embed.image(picture, f"{title}, person in frame {frame.name}"))
        for title, picture in shot.crops(2 / 3).items()
    )
    count = len(shot.pictures)
    exposure_ms = (frame.exposure_us[1] - frame.exposure_us[0]) / 1000
    return (
        f'<article class="frame"><h3>Frame {escape(frame.name)} '
        f"<small>{frame.mid_us / 1e6:.3f} s · exposure {exposure_ms:g} ms"
        f"{frame_figures(shot.figures)}</small></h3>"
        f'<div class="grid n{count}">{full}</div><div class="grid n{count} crops">{crops}</div>'
        "</article>"
    )
