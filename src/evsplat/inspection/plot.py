"""One curve on a page, in the style of the timeline."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw

from evsplat.inspection.drawing import (
    CURVE,
    FAINT,
    INK,
    OVERSAMPLING,
    PAPER,
    TEST,
    font,
    header,
    line,
    round_ticks,
    short_number,
)

_WIDTH, _HEIGHT = 1000, 360
_LEFT, _RIGHT, _TOP, _BOTTOM = 70, 24, 76, 290


def draw_curve(
    title: str,
    subtitle: str,
    x: Float[np.ndarray, "N"],
    y: Float[np.ndarray, "N"],
    *,
    x_label: str,
    x_unit: float = 1.0,
    marks: Sequence[float] = (),
) -> Image.Image:
    """A curve over whole-number ``x``, with ticks at round multiples, shown divided by ``x_unit``.

    ``marks`` are places on the x axis that get a vertical line. Values that are NaN are left out.
    """
    x, y = x[np.isfinite(y)], y[np.isfinite(y)]
    start, end = float(x.min()), float(max(x.max(), x.min() + 1))
    low, high = min(0.0, float(y.min())), max(float(y.max()), 1e-9)
    page = Image.new("RGB", (_WIDTH * OVERSAMPLING, _HEIGHT * OVERSAMPLING), PAPER)
    shapes = ImageDraw.Draw(page)

    def place(at: float, value: float) -> tuple[float, float]:
        return (
            _LEFT + (at - start) / (end - start) * (_WIDTH - _LEFT - _RIGHT),
            _BOTTOM - (value - low) / (high - low) * (_BOTTOM - _TOP),
        )

    ticks = round_ticks(round(start), round(end))
    for tick in ticks:
        line(shapes, [place(tick, low), place(tick, high)], (232, 235, 239), 1)
    line(shapes, [place(start, 0), place(end, 0)], FAINT, 1)
    for mark in marks:
        line(shapes, [place(mark, low), place(mark, high)], TEST, 1.5)
    line(shapes, [place(*point) for point in zip(x, y, strict=True)], CURVE, 1.5)
    page = page.resize((_WIDTH, _HEIGHT), Image.Resampling.LANCZOS)
    draw = ImageDraw.Draw(page)
    header(draw, title, subtitle, _WIDTH, set())
    for value in (low, high):
        beside = (_LEFT - 6, place(start, value)[1])
        text = f"-{short_number(-value)}" if value < 0 else short_number(value)
        draw.text(beside, text, fill=FAINT, font=font(12), anchor="rm")
    for tick in ticks:
        below = (place(tick, low)[0], _BOTTOM + 8)
        draw.text(below, f"{tick / x_unit:g}", fill=FAINT, font=font(13), anchor="mt")
    centre = ((_LEFT + _WIDTH - _RIGHT) / 2, _HEIGHT - 26)
    draw.text(centre, x_label, fill=INK, font=font(14), anchor="mt")
    return page
