"""Draw where runs err: python tools/make_error_figure.py OUT.webp FRAME[,FRAME ...] RUN [RUN ...].

Per held-out frame two rows, cut to the person's box: the camera's own blurry picture, each run's
rendering at mid-exposure and the truth; below, the error maps of the first ones (black: none,
white: 64 of 255 levels, as in reports). Frames and truth are those of the first run's capture.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from evsplat.evaluation.pictures import error_map, to_bytes
from evsplat.evaluation.regions import mask_box
from evsplat.files import atomic_path
from evsplat.training import load_run

MARGIN = 0.15
GAP_PX = 4


def beside(pictures: list[np.ndarray]) -> np.ndarray:
    """In a row, with a gap."""
    gap = np.full((pictures[0].shape[0], GAP_PX, 3), 255, np.uint8)
    parts = [part for picture in pictures for part in (picture, gap)]
    return np.concatenate(parts[:-1], axis=1)


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
        errors.append(np.full_like(errors[0], 255))
        rows += [beside([to_bytes(picture) for picture in shown]), beside(errors)]
    width = max(row.shape[1] for row in rows)
    rows = [
        np.pad(row, ((0, GAP_PX), (0, width - row.shape[1]), (0, 0)), constant_values=255)
        for row in rows
    ]
    page = Image.fromarray(np.concatenate(rows)[:-GAP_PX])
    with atomic_path(out) as temporary:
        page.save(temporary, format=out.suffix[1:], quality=90, method=6)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2].split(","), [Path(run) for run in sys.argv[3:]])
