"""Quality against time within a run: test PSNR at 1/8, 2/8 ... of its schedule.

    python benchmarks/curve.py CAPTURE --out RUN [--method evsplat] [--iterations N]
        [--max-minutes M] [--set KEY=VALUE ...] [--parts 8] [--seed 0] [--threads 1]
    python benchmarks/curve.py RUN

The first trains and keeps the model at each part of the schedule in RUN/curve; the second measures
what a run has kept there (or else its checkpoints) and trains nothing. Printed: steps, seconds of
training (the cheap fits before the first step among them), CPU seconds from the start of the
command where the first trained, up to the saved model at the end, and PSNR on the test frames, full
frame, person's crop and person's mask, protocol 'standard'; then where all three are within 0.1 dB
of the end. What follows the last step belongs to the last point alone. The last line is JSON.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import evsplat as ev

# isort: split
import torch
from safetensors.torch import save

from evsplat.devices import use_threads
from evsplat.evaluation.evaluator import evaluate
from evsplat.evaluation.protocols import STANDARD
from evsplat.files import write_bytes
from evsplat.training.checkpoint import checkpoints
from evsplat.training.run import RunFolder, load_run, reload_run
from evsplat.training.trainer import StepReport, Trainer

REGIONS = ("full", "person_crop", "person_mask")
NEAR_DB = 0.1
SPENT, END = "cpu_seconds.json", "end"
"""File beside the kept models, and the name in it of the run's last checkpoint."""


def main() -> None:
    """Print the curve and one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", type=Path, metavar="CAPTURE|RUN")
    parser.add_argument("--out", type=Path, help="folder of the new run")
    parser.add_argument("--method", default="evsplat")
    parser.add_argument("--iterations", type=int)
    parser.add_argument("--max-minutes", type=float)
    parser.add_argument("--set", nargs="*", default=[], dest="settings", metavar="KEY=VALUE")
    parser.add_argument("--parts", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    use_threads(options.threads)
    run = options.source
    if not RunFolder(run).config.exists():
        if options.out is None:
            parser.error("a capture is trained into a run: give it with --out")
        run = trained(options)
    points = curve(run)
    print(f"{'steps':>7} {'seconds':>8} {'CPU':>8}  {'full':>6} {'crop':>6} {'mask':>6} dB PSNR")
    for point in points:
        figures = " ".join(f"{point[f'{region}_psnr_db']:6.2f}" for region in REGIONS)
        spent = f"{point['cpu_s']:8.1f}" if "cpu_s" in point else " " * 8
        print(f"{point['steps']:7d} {point['train_s']:8.1f} {spent}  {figures}")
    near = next(point for point in points if is_near(point, points[-1]))
    print(f"within {NEAR_DB} dB of the end at step {near['steps']}, {near['train_s']:.1f} s")
    print(json.dumps({"run": run.name, "threads": torch.get_num_threads(), "points": points}))


def trained(options: argparse.Namespace) -> Path:
    """A new run whose models at each part of the schedule are kept in its folder ``curve``."""
    with keeping(options.out / "curve", options.parts) as spent:
        run = ev.train(
            options.source,
            method=options.method,
            out=options.out,
            iterations=options.iterations,
            max_minutes=options.max_minutes,
            overrides=tuple(options.settings),
            seed=options.seed,
            threads=options.threads,
        )
    spent[END] = time.process_time()
    write_bytes(options.out / "curve" / SPENT, json.dumps(spent).encode())
    return run


@contextmanager
def keeping(folder: Path, parts: int) -> Iterator[dict[str, float]]:
    """Trainings write their model to ``folder`` whenever 1 / ``parts`` of the schedule is over.

    Gives the CPU seconds of this process at those moments, by the number of the part.
    """
    step = Trainer.step
    spent: dict[str, float] = {}

    def kept(self: Trainer) -> StepReport | None:
        # the last part ends with the run, whose checkpoint it is
        reached = int(self.clock.fraction * parts + 1e-9)
        path = folder / f"{reached}.safetensors"
        if 0 < reached < parts and not path.exists():
            spent[path.stem] = time.process_time()
            folder.mkdir(exist_ok=True)
            tensors, state = self.snapshot()
            held = {name: value.contiguous() for name, value in tensors.items()}
            write_bytes(path, save(held, metadata={"state": json.dumps(state)}))
        return step(self)

    Trainer.step = kept  # type: ignore[method-assign]
    try:
        yield spent
    finally:
        Trainer.step = step  # type: ignore[method-assign]


def curve(folder: Path) -> list[dict[str, Any]]:
    """Steps, seconds and PSNR of each kept model, the run's last checkpoint at the end."""
    kept = sorted((folder / "curve").glob("*.safetensors"), key=lambda path: int(path.stem))
    *earlier, last = checkpoints(RunFolder(folder).checkpoints)
    run, points = load_run(folder, state=last), []
    file = folder / "curve" / SPENT
    spent = json.loads(file.read_bytes()) if file.exists() else {}
    for state in [*(kept or earlier), last]:
        run = reload_run(run, state)
        with tempfile.TemporaryDirectory() as scratch:
            measured = evaluate(
                run.capture,
                run.reconstruction,
                out_dir=scratch,
                protocols=(STANDARD,),
                test_frames_only=True,
            )
        regions = measured["protocols"]["standard"]
        point: dict[str, Any] = {"steps": run.iteration, "train_s": round(run.train_seconds, 2)}
        key = END if state == last else state.stem
        if key in spent:
            point["cpu_s"] = round(spent[key], 2)
        points.append(point | {f"{r}_psnr_db": round(regions[r]["psnr"], 3) for r in REGIONS})
    return points


def is_near(point: dict[str, Any], end: dict[str, Any]) -> bool:
    """Whether no figure is more than `NEAR_DB` below that of the end."""
    return all(point[f"{r}_psnr_db"] >= end[f"{r}_psnr_db"] - NEAR_DB for r in REGIONS)


if __name__ == "__main__":
    main()
