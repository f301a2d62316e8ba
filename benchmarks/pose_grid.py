"""The default treatment of given poses against forced settings, on captures drawn at random.

    python benchmarks/pose_grid.py [--captures 24] [--seed 0] [--iterations 400] [--out FOLDER]
        [--characters NAME ...] [--only ROW ...] [--table]

Each capture is staged (128 px) with a character, motion, frame rate, exposure, sensor and level of
pose errors drawn at random, and trained by each row: `default`; `unsaid`, the default where the
capture doesn't say how far its poses err; the default's forced settings; `paper`. A row that comes
to the same composition and start as another is not trained again: `same_as` of its figure names
that one. Printed: PSNR of the person's pixels in held-out frames, dB, and how far `default` and
`unsaid` stay behind the best of the forced settings and behind `paper`. What exists is not made
again, so a grid can be stopped and gone on with; several processes may make rows of their own.
``--table`` makes nothing: of what is there it prints the table of
docs/experiments/poses.md, and writes all to grid.json. The last line is one JSON object.
"""

import argparse
import json
import shutil
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

import evsplat as ev
from evsplat.benching.drawn import Draw, drawn_settings
from evsplat.capture import Policy, load_capture
from evsplat.methods.evsplat_settings import EvsplatConfig
from evsplat.methods.poses import prepare_poses
from evsplat.options import StageSettings
from evsplat.staging.assets import characters

FORCED = {
    "never": ("pose.smooth=never", "pose.refine=never"),
    "refine": ("pose.smooth=never", "pose.refine=always"),
    "both": ("pose.smooth=always", "pose.refine=always"),
}
ROWS: dict[str, tuple[str, tuple[str, ...]]] = {
    **{name: ("evsplat", settings) for name, settings in FORCED.items()},
    "paper": ("paper", ()),
    "default": ("evsplat", ()),
    "unsaid": ("evsplat", ()),
}
STATED = ("pose_std_rad", "transl_std_m")
LEAST_FORCED = {"never", "both"}
"""Without these nothing is said of the best of the forced settings."""
CLOSE_DB = 0.2
"""Behind the best of the forced settings by no more than this counts as close."""


def without_errors(capture: Path) -> Path:
    """The capture again, as one that doesn't say how far its poses err."""
    copy = capture.with_name(f"{capture.name}_unsaid")
    if not copy.exists():
        part = capture.with_name(f".{copy.name}")
        shutil.copytree(capture, part, dirs_exist_ok=True)
        stated = json.loads((part / "capture.json").read_text("utf-8"))
        del stated["body"]["source"]
        (part / "capture.json").write_text(json.dumps(stated), "utf-8")
        with np.load(part / "body.npz") as file:
            kept = {name: file[name] for name in file if name not in STATED}
        np.savez(part / "body.npz", **kept)
        part.rename(copy)
    return copy


def same_as(row: str, capture: Path, pose_noise: str, *, make: bool) -> str | None:
    """The row whose composition and start ``row`` comes to; None: that is yet to be found out."""
    if row == "default":
        return "never" if pose_noise == "none" else "both"
    if row == "unsaid":
        unsaid = without_errors(capture) if make else capture.with_name(f"{capture.name}_unsaid")
        exact = taken_as_exact(unsaid, make=make)
        return None if exact is None else "never" if exact else row
    return row


def taken_as_exact(capture: Path, *, make: bool) -> bool | None:
    """Whether training takes the poses of a capture as exact; kept in a file beside it."""
    kept = capture.with_suffix(".exact.json")
    if not kept.exists() and not make:
        return None
    if not kept.exists():
        shown = load_capture(capture).for_training(Policy())
        poses = prepare_poses(EvsplatConfig().pose, shown, fit=True)
        exact = poses.correction is None or bool(poses.correction.exact)
        kept.write_text(json.dumps(exact), "utf-8")
    return bool(json.loads(kept.read_text("utf-8")))


def trained(capture: Path, run: Path, row: str, iterations: int, *, make: bool) -> float | None:
    """PSNR of the person's pixels in held-out frames, dB, of a run; None where there is none."""
    method, settings = ROWS[row]
    if not (run / "metrics.json").exists():
        if not make:
            return None
        if row == "unsaid":
            capture = without_errors(capture)
        if run.exists():
            ev.train(capture, out=run, resume=True)
        else:
            ev.train(capture, method=method, out=run, iterations=iterations, overrides=settings)
        ev.evaluate(run)
    found = json.loads((run / "metrics.json").read_text("utf-8"))
    return float(found["protocols"]["standard"]["person_mask"]["psnr"])


def measured(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Of each capture what was drawn, and the figure of each row that is there or is made."""
    make = not options.table
    characters = tuple(options.characters)
    draw = Draw(options.seed, options.captures, options.frames, characters=characters)
    for number, drawn in enumerate(drawn_settings(draw).values()):
        capture = options.out / f"capture_{options.seed}_{number:02d}"
        if make and not capture.exists():
            ev.stage(capture, drawn, progress=False)
        rows: dict[str, dict[str, Any]] = {}
        for row in options.only:
            same = same_as(row, capture, drawn.pose_noise, make=make)
            if same is None:
                continue
            run = options.out / "runs" / f"{capture.name}-{same}"
            value = trained(capture, run, same, options.iterations, make=make)
            if value is not None:
                rows[row] = {"psnr": value} | ({"same_as": same} if same != row else {})
        yield {"capture": capture.name, "drawn": drawn, "rows": rows}


def behind(captures: list[dict[str, Any]]) -> dict[str, float]:
    """How far `default` and `unsaid` stay behind, and on how many captures that was seen."""
    found: defaultdict[str, list[float]] = defaultdict(list)
    for capture in captures:
        psnr = {row: figure["psnr"] for row, figure in capture["rows"].items()}
        for row in ("default", "unsaid"):
            if row not in psnr:
                continue
            if FORCED.keys() & psnr.keys() >= LEAST_FORCED:
                best = max(psnr[name] for name in FORCED if name in psnr)
                found[f"{row}_best_forced"].append(best - psnr[row])
            if capture["drawn"].pose_noise == "none" and "never" in psnr:
                found[f"{row}_never_of_exact"].append(psnr["never"] - psnr[row])
            if "paper" in psnr:
                found[f"{row}_paper"].append(psnr["paper"] - psnr[row])
    figures: dict[str, float] = {"captures": len(captures)}
    for name, values in found.items():
        close = np.mean(np.array(values) <= CLOSE_DB)
        figures[f"{name}_captures"] = len(values)
        figures[f"{name}_behind_most_db"] = round(max(values), 3)
        figures[f"{name}_behind_mean_db"] = round(float(np.mean(values)), 3)
        figures[f"{name}_within_{CLOSE_DB}_db_ratio"] = round(float(close), 3)
    return figures


def table(captures: list[dict[str, Any]], rows: list[str]) -> str:
    """Markdown; a figure that another row has as well is not repeated."""
    shown = [row for row in rows if any(row in capture["rows"] for capture in captures)]
    lines = [
        f"| character, motion, rate, errors | {' | '.join(shown)} |",
        "|---" * (len(shown) + 1) + "|",
    ]
    for capture in captures:
        cells = []
        for row in shown:
            figure = capture["rows"].get(row, {})
            value = f"{figure['psnr']:.2f}" if figure else ""
            cells.append(f"= {figure['same_as']}" if "same_as" in figure else value)
        if any(cells):
            lines.append(f"| {said(capture['drawn'])} | {' | '.join(cells)} |")
    return "\n".join(lines)


def said(drawn: StageSettings) -> str:
    """A capture in four words."""
    return f"{drawn.character} {drawn.motion} {drawn.fps:g} {drawn.pose_noise}"


def main() -> None:
    """Stage and train what is left, and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--captures", type=int, default=24)
    parser.add_argument("--frames", type=int, default=32)
    parser.add_argument("--iterations", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--characters", nargs="*", default=list(characters()))
    parser.add_argument("--only", nargs="*", default=list(ROWS), choices=list(ROWS))
    parser.add_argument("--table", action="store_true", help="of what is there")
    parser.add_argument("--out", type=Path, default=Path("bench/pose_grid"))
    options = parser.parse_args()
    captures = []
    if not options.table:
        print(f"{'capture':44}" + "".join(f"{row:>9}" for row in options.only))
    for capture in measured(options):
        captures.append(capture)
        if not options.table:
            values = (figure["psnr"] for figure in capture["rows"].values())
            line = f"{said(capture['drawn']):44}" + "".join(f"{value:9.2f}" for value in values)
            print(line, flush=True)
    if options.table:
        print(table(captures, options.only))
    figures = behind(captures)
    if options.table:
        kept = {"iterations": options.iterations, "figures": figures}
        kept["captures"] = [{**capture, "drawn": asdict(capture["drawn"])} for capture in captures]
        (options.out / "grid.json").write_text(json.dumps(kept, indent=1) + "\n", "utf-8")
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
