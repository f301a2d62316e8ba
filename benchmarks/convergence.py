"""How far each method comes with more steps: person-crop PSNR until a doubling brings little.

    python benchmarks/convergence.py CAPTURE [CAPTURE ...] [--methods NAME ...] [--out FOLDER]
        [--points FOLDER] [--first 500] [--most 16000] [--gain 0.2] [--hours 2] [--threads 1]

Every method is trained for 500, 1,000, 2,000 ... steps, each time with its whole schedule, until a
doubling brings less than `--gain` dB of the person's crop on test frames. A baseline is trained
twice at the two first lengths, with its released rates and with these times the square root of
15,000 / steps; the better of both is the one whose pictures come closer to the recorded training
frames, and from the third length on, where both grow alike, the one that was better last is run.
What was made weaker for quick tables is undone: 50,000 points of a person at the start, HUGS's own
limit of growth. A length that would take longer than `--hours` of the processor, by the one before
it, is not begun. Every point is kept as a small file in `--points` (the repository's
docs/results/convergence) and not made again, so the command can be stopped and gone on with; two
of them with different `--methods` may share the folders. tools/results.py draws what is kept.
Printed: a line per cell, then the knees; the curves are drawn to OUT/convergence.png. The last
line is one JSON object.
"""

import argparse
import json
import math
from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from typing import Any

import evsplat as ev
from evsplat.benching.cpu_time import cpu_time
from evsplat.benching.origin import code, machine
from evsplat.capture import load_capture
from evsplat.config import to_dict
from evsplat.evaluation import evaluate
from evsplat.files import make_folder, write_json
from evsplat.methods import NOMINAL_ITERATIONS
from evsplat.methods.avatar_parts import RELEASED_RATES
from evsplat.methods.trivial import OnMedianBackground
from evsplat.training import load_run

ROOT = Path(__file__).resolve().parents[1]
_NO_LPIPS = ("terms.perceptual=none",)
METHODS: dict[str, tuple[str, ...]] = {
    "avatar3dgs": (*_NO_LPIPS, "human.count=50000"),
    "avatar3dgs_semantic": (*_NO_LPIPS, "human.count=50000"),
    "hugs": ("scene.kind=median_backdrop", "human.count=110210", "densify.max_human=524288"),
    "paper": (),
    "evsplat": (),
}
"""Methods, and the settings that differ from their defaults. Not undone: no perceptual term (its
network may not be downloaded), HUGS's triplane of at most 256 texels and its shorter fit. What
shows the person alone is measured before the median of the training frames."""
_SCHEDULE = ("final", "gaussians_final", "constant")


def scaled_rates(method: str, steps: int) -> tuple[str, ...]:
    """Settings of rates scaled to the length of the run; none for methods with rates of our own.

    Adam moves a parameter by about its rate at each step; a walk of noisy steps goes as far as
    the square root of their number.
    """
    factor = math.sqrt(NOMINAL_ITERATIONS / steps)
    if method == "hugs":
        return (f"rate_scale={factor:.4g}",)
    if method.startswith("avatar3dgs"):
        named = [field.name for field in fields(RELEASED_RATES) if field.name not in _SCHEDULE]
        return tuple(f"rates.{n}={getattr(RELEASED_RATES, n) * factor:.4g}" for n in named)
    return ()


def cell(
    capture: Path, method: str, rates: str, steps: int, options: argparse.Namespace
) -> dict[str, Any]:
    """Figures of one training, made where they are not kept yet."""
    seed, threads = options.seed, options.threads
    name = f"{capture.name}-{method}-{rates}-{steps:05d}-{seed}"
    kept = options.points / f"{name}.json"
    if kept.exists():
        return dict(json.loads(kept.read_text("utf-8")))
    run = options.out / "runs" / name
    settings = METHODS[method] + (scaled_rates(method, steps) if rates == "scaled" else ())
    begun = (run / "config.yaml").exists()
    with cpu_time(run, resume=begun) as cpu_seconds:
        if begun:
            ev.train(capture, out=run, resume=True)
        else:
            ev.train(
                capture,
                method=method,
                out=run,
                iterations=steps,
                overrides=settings,
                seed=seed,
                threads=threads,
            )
    used = cpu_seconds()
    trained = load_run(run)
    seen = trained.capture.for_training(trained.config.policy)
    shown = (
        OnMedianBackground(trained.reconstruction, seen)
        if trained.human_only
        else trained.reconstruction
    )
    test, train = (
        evaluate(trained.capture, shown, out_dir=run, split=split) for split in ("test", "train")
    )
    regions = test["protocols"]["standard"]
    found = {
        "capture": capture.name,
        "method": method,
        "rates": rates,
        "steps": steps,
        "seed": seed,
        "full_psnr_db": regions["full"]["psnr"],
        "crop_psnr_db": regions["person_crop"]["psnr"],
        "mask_psnr_db": regions["person_mask"]["psnr"],
        "train_recorded_crop_psnr_db": train["blurry_ground_truth"]["person_crop"]["psnr"],
        "train_s": trained.train_seconds,
        "train_cpu_s": used,
        "gaussians": trained.gaussians,
        "threads": threads,
        "policy": to_dict(trained.policy),
        "code": code(),
        "machine": machine(),
    }
    make_folder(kept.parent)
    write_json(kept, found)
    return found


def curve(capture: Path, method: str, options: argparse.Namespace) -> list[dict[str, Any]]:
    """The better cell of each length, until a doubling brings little or would take too long."""
    points: list[dict[str, Any]] = []
    steps = options.first
    kinds = ("released", "scaled") if scaled_rates(method, steps) else ("released",)
    while steps <= options.most:
        if len(points) >= 2:
            kinds = (points[-1]["rates"],)
        cells = [cell(capture, method, kind, steps, options) for kind in kinds]
        for found in cells:
            print(
                f"{found['capture']:24} {method:20} {found['rates']:9} {steps:6} steps  "
                f"{found['full_psnr_db']:.2f} / {found['crop_psnr_db']:.2f} / "
                f"{found['mask_psnr_db']:.2f} dB  training frames "
                f"{found['train_recorded_crop_psnr_db']:.2f}  {found['train_s'] / 60:.1f} min",
                flush=True,
            )
        points.append(_better(cells))
        if len(points) > 1 and _gain(points) < options.gain:
            break
        if 2 * _hours(points[-1]) > options.hours:
            break
        steps *= 2
    return points


def _hours(point: dict[str, Any]) -> float:
    """Time a training took: the processor's where it is known; the clock counts waiting too."""
    cpu_s = point.get("train_cpu_s")
    return float(cpu_s / point["threads"] if cpu_s else point["train_s"]) / 3600


def _better(cells: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """Of runs of one length that which comes closer to its training frames: no test frame tells."""
    return max(cells, key=lambda found: found["train_recorded_crop_psnr_db"])


def read_points(folder: Path) -> list[dict[str, Any]]:
    """All points that are kept in a folder."""
    return [json.loads(path.read_text("utf-8")) for path in sorted(folder.glob("*.json"))]


def curves_of(points: Iterable[dict[str, Any]]) -> dict[str, dict[str, list[dict[str, Any]]]]:
    """The better point of each length, by capture and method."""
    curves: dict[str, dict[str, list[dict[str, Any]]]] = {}
    order = list(METHODS)
    for point in sorted(points, key=lambda p: (p["capture"], order.index(p["method"]), p["steps"])):
        found = curves.setdefault(point["capture"], {}).setdefault(point["method"], [])
        if found and found[-1]["steps"] == point["steps"]:
            found[-1] = _better((found[-1], point))
        else:
            found.append(point)
    return curves


def _gain(points: list[dict[str, Any]]) -> float:
    return float(points[-1]["crop_psnr_db"] - points[-2]["crop_psnr_db"])


def knee(points: list[dict[str, Any]], gain: float) -> dict[str, Any]:
    """Where doubling stops to pay, and whether it did within the limits."""
    reached = len(points) > 1 and _gain(points) < gain
    at = points[-2] if reached else points[-1]
    keys = ("steps", "rates", "full_psnr_db", "crop_psnr_db", "mask_psnr_db", "train_s")
    return {"converged": reached, **{key: at[key] for key in keys}}


def draw(curves: dict[str, dict[str, list[dict[str, Any]]]], path: Path) -> None:
    """Curves of all methods, a panel per capture."""
    from PIL import Image, ImageDraw, ImageFont

    panel, margin = (460, 340), 46
    page = Image.new("RGB", (panel[0] * len(curves), panel[1]), "white")
    pen, font = ImageDraw.Draw(page), ImageFont.load_default(12)
    colours = dict(
        zip(METHODS, ["#e08e0b", "#1b6ca8", "#7d3c98", "#c0392b", "#2e8b57"], strict=True)
    )
    values = [p["crop_psnr_db"] for c in curves.values() for ps in c.values() for p in ps]
    lengths = sorted({p["steps"] for c in curves.values() for ps in c.values() for p in ps})
    low, high = math.floor(min(values)), math.ceil(max(values))
    first, last = math.log2(lengths[0]), math.log2(max(lengths[-1], 2 * lengths[0]))
    for index, (capture, methods) in enumerate(curves.items()):
        left, right = index * panel[0] + margin, (index + 1) * panel[0] - margin
        top, bottom = margin // 2 + 8, panel[1] - margin
        pen.text((left, 6), f"{capture}: person crop, dB, over steps", "black", font)
        for value in range(low, high + 1, max(1, (high - low) // 6)):
            y = bottom - (value - low) / (high - low) * (bottom - top)
            pen.line([(left, y), (right, y)], "#dddddd")
            pen.text((left - 24, y - 7), str(value), "black", font)
        for steps in lengths:
            x = left + (math.log2(steps) - first) / (last - first) * (right - left)
            pen.text((x, bottom + 6), f"{steps:,}", "black", font, anchor="ma")
        at = float(left)
        for method, points in methods.items():
            colour = colours[method]
            places = [
                (
                    left + (math.log2(p["steps"]) - first) / (last - first) * (right - left),
                    bottom - (p["crop_psnr_db"] - low) / (high - low) * (bottom - top),
                )
                for p in points
            ]
            pen.line(places, colour, 2)
            for x, y in places:
                pen.ellipse([x - 3, y - 3, x + 3, y + 3], colour)
            pen.text((at, bottom + 24), method, colour, font)
            at += 24 + pen.textlength(method, font)
    page.save(path)


def main() -> None:
    """Train what is left, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--out", type=Path, default=Path("bench/convergence"))
    parser.add_argument("--points", type=Path, default=ROOT / "docs" / "results" / "convergence")
    parser.add_argument("--first", type=int, default=500)
    parser.add_argument("--most", type=int, default=16_000)
    parser.add_argument("--gain", type=float, default=0.2)
    parser.add_argument("--hours", type=float, default=2.0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    for capture in options.captures:
        load_capture(capture)
    curves = {
        capture.name: {method: curve(capture, method, options) for method in options.methods}
        for capture in options.captures
    }
    knees = {
        capture: {method: knee(points, options.gain) for method, points in methods.items()}
        for capture, methods in curves.items()
    }
    for capture, methods in knees.items():
        for method, found in methods.items():
            word = "knee" if found["converged"] else "not converged within the limits:"
            print(
                f"{capture:24} {method:20} {word} {found['steps']} steps, {found['rates']} rates: "
                f"{found['full_psnr_db']:.2f} / {found['crop_psnr_db']:.2f} / "
                f"{found['mask_psnr_db']:.2f} dB"
            )
    make_folder(options.out)
    draw(curves, options.out / "convergence.png")
    print(json.dumps({"gain_db": options.gain, "knees": knees}))


if __name__ == "__main__":
    main()
