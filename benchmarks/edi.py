"""What the event double integral gains on the train frames of captures with sharp truth.

    python benchmarks/edi.py CAPTURE [CAPTURE ...] [--every N] [--pictures FOLDER]

PSNR in dB (8 bit, mean over frames) of the blurry frame and of its EDI at mid-exposure against the
sharp truth, over the full frame, the person crop and the person mask: with the capture's contrast
thresholds, with thresholds estimated from its frames and events, and with ones that are 25 % off.
The last line is one JSON object.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from evsplat.capture import Capture, Frame, Policy, estimate_sensor, load_capture
from evsplat.evaluation.regions import CROP_MARGIN
from evsplat.events import deblur
from evsplat.pictures import to_bytes
from evsplat.pictures.box import mask_box

REGIONS = ("full", "person_crop", "person_mask")


def rounded(value: float) -> float:
    """To hundredths of a dB."""
    return round(float(value), 2)


def psnr(picture: torch.Tensor, capture: Capture, frame: Frame) -> list[float]:
    """Full frame, person crop, person mask."""
    error = (torch.from_numpy(to_bytes(picture)) / 255 - capture.sharp(frame)) ** 2
    soft = capture.mask(frame)
    assert soft is not None
    mask = soft > 0.5
    box = mask_box(mask)
    assert box is not None
    crop = box.enlarged(CROP_MARGIN, *mask.shape).crop(error)
    return [float(-10 * torch.log10(part.mean())) for part in (error, crop, error[mask])]


def measure(path: Path, every: int, pictures: Path | None) -> dict:
    """Mean PSNR of each row over the train frames."""
    capture = load_capture(path)
    assert capture.events is not None and capture.contrast_threshold is not None
    estimate = estimate_sensor(capture.for_training(Policy()))
    assert estimate is not None and estimate.thresholds is not None
    given = capture.contrast_threshold
    thresholds = {
        "edi": given,
        "edi_estimated_C": (estimate.thresholds.plus, estimate.thresholds.minus),
        "edi_C_25_percent_high": (1.25 * given[0], 1.25 * given[1]),
        "edi_C_25_percent_low": (0.75 * given[0], 0.75 * given[1]),
    }
    rows: dict[str, list[list[float]]] = {"blurry": [], **{name: [] for name in thresholds}}
    milliseconds = []
    for frame in capture.train_frames[::every]:
        blurry = capture.image(frame)
        rows["blurry"].append(psnr(blurry, capture, frame))
        sharp = {}
        for name, pair in thresholds.items():
            events = capture.events.between(*frame.exposure_us)
            start = time.perf_counter()
            sharp[name] = deblur(blurry, events, frame.exposure_us, [frame.mid_us], pair)[0]
            milliseconds.append(1e3 * (time.perf_counter() - start))
            rows[name].append(psnr(sharp[name], capture, frame))
        if pictures is not None:
            beside = [blurry, sharp["edi"], capture.sharp(frame)]
            pictures.mkdir(parents=True, exist_ok=True)
            picture = Image.fromarray(np.concatenate([to_bytes(part) for part in beside], axis=1))
            picture.save(pictures / f"{capture.name}_{frame.name}.png")
    means = {
        name: dict(zip(REGIONS, map(rounded, np.mean(values, axis=0)), strict=True))
        for name, values in rows.items()
    }
    return {
        "psnr_db": means,
        "contrast_threshold": list(given),
        "contrast_threshold_estimated": [
            round(value, 3) for value in thresholds["edi_estimated_C"]
        ],
        "ms_per_frame_best": round(min(milliseconds), 1),
    }


def main() -> None:
    """Print a table and one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--every", type=int, default=1, help="measure every N-th frame only")
    parser.add_argument("--pictures", type=Path, help="blurry, EDI and truth side by side")
    options = parser.parse_args()
    result = {}
    for path in options.captures:
        result[path.name] = measure(path, options.every, options.pictures)
        for row, figures in result[path.name]["psnr_db"].items():
            text = " / ".join(f"{figures[region]:.2f}" for region in REGIONS)
            print(f"{path.name:22} {row:22} {text}")
    print(json.dumps({"edi": result}))


if __name__ == "__main__":
    main()
