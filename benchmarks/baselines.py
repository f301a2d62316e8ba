"""What the baselines reach where their descriptions promise most: sharp, masked, nothing moves.

    python benchmarks/baselines.py CAPTURE [--methods NAME ...] [--iterations N] [--out FOLDER]
        [--set KEY=VALUE ...]

A copy of the capture is made whose pictures are the sharp truth, black outside of the person's
mask, with exposures of a microsecond; each method is trained on its training frames and measured
on its held-out ones. 3DGS-Avatar must reach 28 dB in the person's crop: a baseline that does not
would be weak by our hand. The last line is one JSON object.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

from evsplat.capture import load_capture
from evsplat.capture.derive import derived_capture
from evsplat.evaluation.run import evaluate_run
from evsplat.training import train

PROMISED_DB = {"avatar3dgs": 28.0}
"""Least PSNR in the person's crop."""


def static_masked(source: Path, path: Path) -> Path:
    """Write the copy of a capture; every frame needs its sharp picture and its mask."""
    capture = load_capture(source)
    with derived_capture(capture, path, without=("image", "sharp")) as making:
        for frame in capture.frames:
            mask = capture.mask(frame)
            assert mask is not None, f"{source}: frame {frame.name} has no mask"
            picture = capture.sharp(frame) * (mask > 0.5)[..., None]
            for key in ("image", "sharp"):
                making.set_picture(frame, key, picture)
            making.entry(frame)["exposure_us"] = [frame.mid_us, frame.mid_us + 1]
        making.document["novel_views"] = []
    return path


def main() -> None:
    """Print a line per method and one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--methods", nargs="+", default=["avatar3dgs"])
    parser.add_argument("--iterations", type=int, default=3_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", nargs="*", default=[], dest="overrides", metavar="KEY=VALUE")
    parser.add_argument("--out", type=Path, help="keep the copy and the runs here")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.out or Path(temporary)
        copy = folder / f"{options.capture.name}-static"
        if not copy.exists():
            static_masked(options.capture, copy)
        result: dict[str, dict[str, Any]] = {}
        for method in options.methods:
            run = train(
                copy,
                method=method,
                out=folder / f"{method}-{time.strftime('%H%M%S')}",
                iterations=options.iterations,
                overrides=options.overrides,
                seed=options.seed,
            )
            metrics = evaluate_run(run)
            regions = metrics["protocols"]["standard"]
            result[method] = {
                "human_crop_psnr_db": round(regions["person_crop"]["psnr"], 2),
                "human_crop_ssim": round(regions["person_crop"]["ssim"], 4),
                "full_psnr_db": round(regions["full"]["psnr"], 2),
                "promised_db": PROMISED_DB.get(method),
                "train_s": round(metrics["train_seconds"], 1),
                "gaussians": metrics["gaussians"],
            }
            print(f"{method:22} {result[method]}  {run}")
    print(json.dumps({"capture": options.capture.name, "iterations": options.iterations, **result}))


if __name__ == "__main__":
    main()
