"""What long exposures cost in colour: the same captures staged with sharp frames beside them.

    python benchmarks/colours.py [--seed 0] [--captures 10] [--width 128] [--iterations 400]
        [--sharp-ms 2] [--threads 1] [--out FOLDER]

Character, motion, direction, exposure (50 to 80 ms) and noisy sensor are drawn by the seed; poses
are exact. Each draw is staged twice, in its long exposure and in one of 2 ms, so that the middles
of both exposures show the same instants, and `evsplat` is trained on both. Printed, of held-out
frames in dB, sharp pictures being the truth: Cb and Cr on the person's pixels, RGB there (mask),
and Cb and Cr apart on the outline (the outer two pixels of the person) and inside of it; then
shares of the squared error of Cb and Cr: on the outline, and of what varies slowly (a Gaussian of
2 px), as tints do. The person of the two captures may stand up to a pixel apart, since `stage` puts
the middle of the filmed way at the origin. FOLDER/NAME.png shows held-out frames of both and the
truth, and below them the colour differences alone, 2.5 times as large. What exists is not made
again. The last line is one JSON object, with what the long exposures change.
"""

import argparse
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import binary_erosion, gaussian_filter
from torch import Tensor
from turned import drawn

import evsplat as ev
from evsplat.body.motion import load_motion
from evsplat.capture import Frame
from evsplat.evaluation.chroma import chroma_psnr
from evsplat.files import write_json
from evsplat.pictures import chroma, to_bytes
from evsplat.pictures.files import save_png
from evsplat.similarity import psnr
from evsplat.staging.assets import characters, find_motion, motions
from evsplat.training.run import Run, load_run

SENSORS = ("davis346", "dvxplorer", "evk4")
EXPOSURES_MS = (50.0, 80.0)
RATES_HZ = (15.0, 12.5)
"""The highest at which the exposure ends before the next begins."""
LEAST_S, MOST_FRAMES = 1.2, 30
"""Shorter motions are not drawn; longer ones are cut."""
OUTLINE_PX = 2
"""Width of the outline, and standard deviation of what varies slowly."""
SHOWN = 5
"""Held-out frames in a picture."""

Figures = dict[str, float]


def draws(seed: int, count: int, width: int) -> dict[str, dict[str, Any]]:
    """Settings of `evsplat stage` of all captures, by their names."""
    rng = np.random.default_rng(seed)
    lasting = {name: float(np.ptp(load_motion(find_motion(name)).times_us)) for name in motions()}
    lasting = {name: span * 1e-6 for name, span in lasting.items() if span > LEAST_S * 1e6}
    found: dict[str, dict[str, Any]] = {}
    for number in range(count):
        character, motion = str(rng.choice(list(characters()))), str(rng.choice(list(lasting)))
        exposure_ms = float(rng.uniform(*EXPOSURES_MS))
        fps = next(rate for rate in RATES_HZ if exposure_ms < 1000 / rate)
        found[f"{seed}-{number:02d}-{character}-{motion}"] = {
            "character": character,
            "motion": motion,
            "fps": fps,
            "exposure_ms": exposure_ms,
            # The sharp pictures begin later by up to half of the longest exposure.
            "frames": min(MOST_FRAMES, int((lasting[motion] - EXPOSURES_MS[1] / 2000) * fps)),
            "yaw_deg": float(rng.uniform(0, 360)),
            "events": SENSORS[rng.integers(len(SENSORS))],
            "seed": int(rng.integers(1 << 30)),
            "width": width,
            "novel_views": "none",
        }
    return found


def staged(path: Path, settings: dict[str, Any], exposure_ms: float, threads: int) -> Path:
    """A draw in another exposure around the same instants."""
    if not path.exists():
        start_s = (settings["exposure_ms"] - exposure_ms) / 2000
        changes = settings | {"exposure_ms": exposure_ms, "start_s": start_s}
        ev.stage(path, threads=threads, progress=False, **changes)
    return path


def measured(path: Path, capture: Path, options: argparse.Namespace) -> Figures:
    """Figures of a run, which is trained if it was not."""
    kept = path / "colours.json"
    if not kept.exists():
        ev.train(
            capture,
            out=path,
            iterations=options.iterations,
            threads=options.threads,
            resume=path.exists(),
        )
        write_json(kept, figures(load_run(path)))
    found: Figures = json.loads(kept.read_text("utf-8"))
    return found


def figures(run: Run) -> Figures:
    """Of held-out frames: means of the PSNRs, dB, and shares of the squared error of Cb and Cr."""
    values: dict[str, list[float]] = {}
    squares = dict.fromkeys(("all", "outline", "slow"), 0.0)
    for frame, mask in _held_out(run):
        picture, truth = drawn(run, frame), run.capture.sharp(frame)
        inside = torch.from_numpy(binary_erosion(mask.numpy(), iterations=OUTLINE_PX))
        found = chroma_psnr(picture, truth, mask)
        found["mask"] = float(psnr(picture, truth, mask=mask))
        for name, region in (("outline", mask & ~inside), ("inside", inside)):
            apart = chroma_psnr(picture, truth, region) if bool(region.any()) else {}
            found |= {f"{key}_{name}": value for key, value in apart.items()}
        for name, value in found.items():
            values.setdefault(name, []).append(value)
        error = chroma(picture - truth)
        squares["all"] += float(error[mask].square().sum())
        squares["outline"] += float(error[mask & ~inside].square().sum())
        squares["slow"] += float(_slow(error, mask)[mask].square().sum())
    means = {name: sum(each) / len(each) for name, each in values.items()}
    return means | {f"share_{name}": squares[name] / squares["all"] for name in ("outline", "slow")}


def _held_out(run: Run) -> Iterator[tuple[Frame, Bool[Tensor, "H W"]]]:
    """Frames that show the person, and their pixels."""
    for frame in run.capture.test_frames:
        mask = run.capture.mask(frame)
        assert mask is not None
        if bool((mask > 0.5).any()):
            yield frame, mask > 0.5


def _slow(error: Float[Tensor, "H W 2"], mask: Bool[Tensor, "H W"]) -> Float[Tensor, "H W 2"]:
    """What of it varies slowly over the person's pixels."""
    weight = mask.double().numpy()
    around = np.maximum(gaussian_filter(weight, OUTLINE_PX), 1e-3)
    planes = [gaussian_filter(plane.numpy() * weight, OUTLINE_PX) for plane in error.unbind(-1)]
    return torch.from_numpy(np.stack([plane / around for plane in planes], -1))


def _hues(picture: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """The colour differences alone, 2.5 times as large, at one luma."""
    cb, cr = (2.5 * chroma(picture)).unbind(-1)
    return 0.5 + torch.stack((1.402 * cr, -0.344 * cb - 0.714 * cr, 1.772 * cb), -1)


def shown(path: Path, runs: Sequence[Run]) -> None:
    """A picture of held-out frames by each run, and of the truth, with their hues below."""
    held = [[frame for frame, _ in _held_out(run)] for run in runs]
    rows = []
    for frames in list(zip(*held, strict=True))[:: -(-len(held[0]) // SHOWN)]:
        pictures = [drawn(run, frame) for run, frame in zip(runs, frames, strict=True)]
        pictures.append(runs[0].capture.sharp(frames[0]))
        rows.append(torch.cat(pictures + [_hues(picture) for picture in pictures]))
    save_png(path, to_bytes(torch.cat(rows, 1).clamp(0, 1)))


def main() -> None:
    """Stage, train, measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--captures", type=int, default=10)
    parser.add_argument("--width", type=int, default=128)
    parser.add_argument("--iterations", type=int, default=400)
    parser.add_argument("--sharp-ms", type=float, default=2.0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("bench/colours"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rows: dict[str, dict[str, Figures]] = {}
    for name, settings in draws(options.seed, options.captures, options.width).items():
        long_ms = float(str(settings["exposure_ms"]))
        paths = {}
        rows[name] = {}
        for kind, exposure_ms in (("long", long_ms), ("sharp", options.sharp_ms)):
            folder = options.out / f"{name}-{kind}"
            capture = staged(folder, settings, exposure_ms, options.threads)
            paths[kind] = options.out / f"run-{folder.name}"
            rows[name][kind] = measured(paths[kind], capture, options)
        rows[name]["change"] = {
            key: value - rows[name]["sharp"][key] for key, value in rows[name]["long"].items()
        }
        picture = options.out / f"{name}.png"
        if not picture.exists():
            shown(picture, [load_run(path) for path in paths.values()])
        print(f"{name}: {settings['events']}, {long_ms:.0f} ms, {settings['frames']} frames")
        for kind, values in rows[name].items():
            print(f"  {kind:6}", *(f"{key} {value:.2f}" for key, value in values.items()))
    means = {
        kind: {
            key: round(sum(row[kind][key] for row in rows.values()) / len(rows), 3)
            for key in next(iter(rows.values()))[kind]
        }
        for kind in ("long", "sharp", "change")
    }
    print(json.dumps({"seed": options.seed, "means": means, "captures": rows}))


if __name__ == "__main__":
    main()
