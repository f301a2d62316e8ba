"""How well each way of finding the person agrees with the true masks of captures.

    python benchmarks/masks.py CAPTURE [CAPTURE ...] [--every N] [--pictures FOLDER]

Intersection over union of masks above one half, mean and least over the frames; masks from the
capture's blurry frames and, for the background difference, from EDI-restored ones. The last line is
one JSON object.
"""

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from evsplat.capture import Capture, Policy, load_capture
from evsplat.inspection.drawing import draw_outline, fit, to_picture
from evsplat.masks import MASKERS
from evsplat.restore import restore_capture


def measure(
    source: Capture, truth: Capture, method: str, every: int, pictures: Path | None, **options
) -> dict[str, float]:
    """Overlap of one method's masks of ``source`` with the masks of ``truth``."""
    overlaps = []
    masker = MASKERS[method](source.for_training(Policy()), **options)
    everything = source.for_training(Policy(use="everything"))
    for frame, found in masker.masks(everything, everything.frames[::every]):
        true = truth.mask(frame.name)
        if true is None:
            continue
        one, other = found.numpy() > 0.5, true.numpy() > 0.5
        overlaps.append(float((one & other).sum() / max(1, (one | other).sum())))
        if pictures is not None and frame.index % (4 * every) == 0:
            draw(truth, frame.name, one, other, pictures / f"{frame.name}_{method}.png")
    return {"mean": round(float(np.mean(overlaps)), 3), "least": round(min(overlaps), 3)}


def draw(capture: Capture, name: str, found: np.ndarray, true: np.ndarray, path: Path) -> None:
    """The truth in yellow below what was found in green."""
    image = capture.image(name)
    size = fit(image.shape[1], image.shape[0], 512)
    picture = to_picture(image, size)
    for mask, colour, halo in ((true, (255, 225, 80), False), (found, (60, 255, 120), False)):
        large = Image.fromarray(mask).resize(size, Image.Resampling.NEAREST)
        draw_outline(picture, np.asarray(large), colour, halo=halo)
    path.parent.mkdir(parents=True, exist_ok=True)
    picture.save(path)


def main() -> None:
    """Print a table and one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--every", type=int, default=1, help="measure every N-th frame only")
    parser.add_argument("--pictures", type=Path, help="draw some of the masks into this folder")
    options = parser.parse_args()
    result: dict[str, dict[str, dict[str, float]]] = {}
    for path in options.captures:
        capture = load_capture(path)
        pictures = options.pictures and options.pictures / capture.name
        with tempfile.TemporaryDirectory() as folder:
            restored = load_capture(restore_capture(path, Path(folder) / "edi"))
            restored_pictures = pictures and pictures / "edi"
            rows = {
                "silhouette": (capture, "silhouette", {}, pictures),
                "silhouette_margin_1px": (capture, "silhouette", {"margin_px": 1.0}, None),
                "background": (capture, "background", {}, pictures),
                "background_edi": (restored, "background", {}, restored_pictures),
            }
            result[capture.name] = {
                row: measure(source, capture, method, options.every, where, **extra)
                for row, (source, method, extra, where) in rows.items()
            }
        for row, figures in result[capture.name].items():
            mean, least = figures["mean"], figures["least"]
            print(f"{capture.name:22} {row:22} mean {mean:.3f}, least {least:.3f}")
    print(json.dumps({"iou": result}))


if __name__ == "__main__":
    main()
