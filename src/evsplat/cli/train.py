"""``evsplat train``: fit a method to a capture, then evaluate it and write the report."""

from pathlib import Path
from typing import Annotated

from evsplat.cli.options import CaptureFolder, Device, NewRunFolder, Threads, option
from evsplat.cli.summary import print_summary


def train(
    capture: CaptureFolder,
    /,
    *,
    method: str = "paper",
    out: NewRunFolder = None,
    device: Device = "auto",
    iterations: Annotated[int | None, option("N", default="the method's")] = None,
    max_minutes: Annotated[float | None, option("M", default="no limit")] = None,
    resume: bool = False,
    config: Annotated[Path | None, option("FILE", default="the method's")] = None,
    overrides: Annotated[
        tuple[str, ...], option("[KEY=VALUE ...]", default="none", name="set")
    ] = (),
    threads: Threads = None,
    seed: Annotated[int | None, option("S", default="the method's")] = None,
    evaluate: bool = True,
) -> None:
    """Train a method on a capture, then evaluate it and write report.html.

    Ctrl-C finishes the step, saves a checkpoint and says how to resume.

    Args:
        capture: Capture folder (docs/capture-format.md).
        method: Name of the method.
        out: Folder of the run.
        device: Where to compute; auto takes what the installed rasterisers can use.
        iterations: Training steps; every schedule is scaled to it.
        max_minutes: Minutes of training after which to stop gracefully, save and evaluate.
        resume: Go on from the last checkpoint in --out.
        config: A config.yaml of an earlier run to start from.
        overrides: Configuration values to change, such as event.weight=0.2.
        threads: CPU threads.
        seed: Seed of every random number.
        evaluate: Skip the evaluation and the report at the end.
    """
    from evsplat.training import train as train_run

    run = train_run(
        capture,
        method=method,
        out=out,
        device=device,
        iterations=iterations,
        max_minutes=max_minutes,
        resume=resume,
        config=config,
        overrides=overrides,
        threads=threads,
        seed=seed,
    )
    if not evaluate:
        print(f"run: {run}")
        return
    from evsplat.evaluation import evaluate_run
    from evsplat.evaluation.report import write_report

    metrics = evaluate_run(run)
    print_summary(metrics, run=run, report=write_report(run))
