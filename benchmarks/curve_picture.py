"""Curves of `curve.py` side by side as a picture: PSNR of held-out frames over seconds.

python benchmarks/curve_picture.py PICTURE.png LABEL=FILE [LABEL=FILE ...]

Each file ends with a line of JSON as `curve.py` prints it; seconds are those of the CPU from the
start of the command where it has them, otherwise those of the training. Drawn are full frame,
person's crop and person's mask in a panel each; the first curve's end is a line across, so that one
sees when the others reach it. The last line is JSON: for each label the seconds at which all three
come within 0.1 dB of it.
"""

import argparse
import json
from pathlib import Path
from typing import Any

from curve import is_near
from PIL import Image, ImageDraw

from evsplat.inspection.drawing import font, round_ticks

REGIONS = {"full": "full frame", "person_crop": "person's crop", "person_mask": "person's pixels"}
COLOURS = ((120, 120, 120), (200, 60, 40), (40, 90, 200), (30, 140, 70))
PANEL, LEFT, TOP, BOTTOM, GAP = (520, 420), 52, 48, 48, 28
Curve = list[dict[str, Any]]


def main() -> None:
    """Draw and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("picture", type=Path)
    parser.add_argument("curves", nargs="+", metavar="LABEL=FILE")
    options = parser.parse_args()
    curves: dict[str, Curve] = {}
    for given in options.curves:
        label, _, file = given.partition("=")
        curves[label] = json.loads(Path(file).read_text("utf-8").splitlines()[-1])["points"]
    panels = [panel(region, title, curves) for region, title in REGIONS.items()]
    whole = Image.new("RGB", (sum(each.width for each in panels), panels[0].height), "white")
    left = 0
    for each in panels:
        whole.paste(each, (left, 0))
        left += each.width
    whole.save(options.picture, optimize=True)
    goal = next(iter(curves.values()))[-1]
    print(json.dumps({label: reached(curve, goal) for label, curve in curves.items()}))


def reached(curve: Curve, goal: dict[str, Any]) -> float | None:
    """Seconds of the first point that is as good as ``goal``; None where none is."""
    return next((seconds(point) for point in curve if is_near(point, goal)), None)


def seconds(point: dict[str, Any]) -> float:
    """Place of a point."""
    return float(point.get("cpu_s", point["train_s"]))


def panel(region: str, title: str, curves: dict[str, Curve]) -> Image.Image:
    """One region's curves, with axes in seconds and dB."""
    width, height = PANEL
    picture = Image.new("RGB", (LEFT + width + GAP, TOP + height + BOTTOM), "white")
    draw, small = ImageDraw.Draw(picture), font(20)
    values = {
        label: [(seconds(point), point[f"{region}_psnr_db"]) for point in curve]
        for label, curve in curves.items()
    }
    every = [pair for points in values.values() for pair in points]
    last_s = max(at for at, _ in every)
    low, high = int(min(db for _, db in every)), int(max(db for _, db in every)) + 1

    def place(at: float, db: float) -> tuple[float, float]:
        return LEFT + width * at / last_s, TOP + height * (high - db) / (high - low)

    draw.text((LEFT, 8), f"{title}, PSNR in dB", fill="black", font=font(24))
    for db in range(low, high + 1, max(1, (high - low) // 6)):
        left, y = place(0, db)
        draw.line((left, y, left + width, y), fill=(228, 228, 228))
        draw.text((left - 8, y), str(db), fill="black", font=small, anchor="rm")
    for at in round_ticks(0, round(last_s)):
        x, y = place(at, low)
        draw.line((x, y, x, y + 4), fill="black")
        draw.text((x, y + 7), f"{at:g} s", fill="black", font=small, anchor="mt")
    goal = next(iter(values.values()))[-1][1]
    draw.line((*place(0, goal), *place(last_s, goal)), fill=COLOURS[0])
    for number, (label, points) in enumerate(values.items()):
        colour = COLOURS[number % len(COLOURS)]
        draw.line([place(*pair) for pair in points], fill=colour, width=4, joint="curve")
        for pair in points:
            x, y = place(*pair)
            draw.ellipse((x - 5, y - 5, x + 5, y + 5), fill=colour)
        legend = TOP + height - 28 * (len(values) - number)
        draw.text((LEFT + width - 8, legend), label, fill=colour, font=small, anchor="rm")
    return picture


if __name__ == "__main__":
    main()
