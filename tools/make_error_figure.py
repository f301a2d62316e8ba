"""Draw where runs err: python tools/make_error_figure.py OUT.webp FRAME[,FRAME ...] RUN [RUN ...].

Per held-out frame two rows, cut to the person's box: the camera's own blurry picture, each run's
rendering at mid-exposure and the truth; below, the error maps of the first ones (black: none,
white: 64 of 255 levels, as in reports). Frames and truth are those of the first run's capture.
"""

import argparse
import sys
from pathlib import Path

from make_doc_figures import GAP_PX, beside
from PIL import Image

from evsplat.files import atomic_path
from evsplat.pictures import error_map, to_bytes
from evsplat.pictures.box import mask_box
from evsplat.training import load_run

MARGIN = 0.15


def main(out: Path, names: list[str], folders: list[Path]) -> None:
    """Render, compare, write."""
    runs = [load_run(folder) for folder in folders]
    capture = runs[0].capture
    rows = []
    for frame in (frame for frame in capture.frames if frame.name in names):
        truth, mask = capture.sharp(frame), capture.mask(frame)
        box = None if mask is None else mask_box(mask > 0.5)
        if truth is None or box is None:
            sys.exit(f"{capture.path}: frame {frame.name} has no sharp picture or no person.")
        box = box.enlarged(MARGIN, *truth.shape[:2])
        drawn = [
            run.reconstruction.render(capture.camera(frame), [frame.mid_us]).rgb[0] for run in runs
        ]
        shown = [box.crop(picture) for picture in (capture.image(frame), *drawn, truth)]
        errors = [error_map(picture, shown[-1]) for picture in shown[:-1]]
        rows += [[to_bytes(picture) for picture in shown], errors]
    strips = [beside([Image.fromarray(picture) for picture in row]) for row in rows]
    height = sum(strip.height + GAP_PX for strip in strips) - GAP_PX
    page = Image.new("RGB", (max(strip.width for strip in strips), height), (255, 255, 255))
    y = 0
    for strip in strips:
        page.paste(strip, (0, y))
        y += strip.height + GAP_PX
    with atomic_path(out) as temporary:
        page.save(temporary, format=out.suffix[1:], quality=90, method=6)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition(":")[0])
    parser.add_argument("out", type=Path, metavar="OUT.webp")
    parser.add_argument("frames", metavar="FRAME[,FRAME ...]")
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    options = parser.parse_args()
    main(options.out, options.frames.split(","), options.runs)
