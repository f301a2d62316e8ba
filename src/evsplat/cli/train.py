"""``evsplat train``: fit a method to a capture, then evaluate it and write the report."""

import shlex
from pathlib import Path
from typing import Annotated

from evsplat.cli.evaluate import evaluate_and_report
from evsplat.cli.options import CaptureFolder, Device, Flag, NewRunFolder, Threads, Use, option


def train(
    capture: CaptureFolder,
    /,
    *,
    method: Annotated[str | None, option("NAME", default="that of --config, or evsplat")] = None,
    out: NewRunFolder = None,
    device: Device = "auto",
    iterations: Annotated[int | None, option("N", default="the method's")] = None,
    max_minutes: Annotated[float | None, option("M", default="no limit")] = None,
    resume: Flag = False,
    config: Annotated[Path | None, option("FILE", default="the method's")] = None,
    overrides: Annotated[
        tuple[str, ...], option("[KEY=VALUE ...]", default="none", name="set")
    ] = (),
    threads: Threads = None,
    device_memory_gb: Annotated[float | None, option("GB", default="a quarter of the free")] = None,
    seed: Annotated[int | None, option("S", default="the method's")] = None,
    use: Annotated[Use | None, option("{training,everything}", default="training")] = None,
    evaluate: Flag = True,
    view: Flag = False,
    port: Annotated[int, option("PORT", default="8080, or the next free one")] = 8080,
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
        overrides: Settings to change, such as event.weight=0.2; see docs/settings.md.
        threads: CPU threads.
        device_memory_gb: GPU memory for recorded pictures and event maps.
        seed: Seed of every random number.
        use: everything trains on all frames and events, for the best result of one's own
            recording; nothing is held out, so there are no test figures.
        evaluate: Skip the evaluation and the report at the end.
        view: Show the run in the browser while it is trained, and afterwards until Ctrl-C.
        port: Where --view listens.
    """
    from evsplat.cli.viewer_process import ViewerProcess
    from evsplat.training import train as train_run
    from evsplat.training.train import Stopped

    viewer = ViewerProcess(port) if view else None
    try:
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
            use=use,
            device_memory_gb=device_memory_gb,
            on_start=viewer.start if viewer else None,
        )
        if evaluate:
            _evaluate(run, device)
        else:
            print(f"run: {run}")
        if viewer:
            viewer.wait()
    except Stopped as stop:
        command = shlex.join(["evsplat", "train", str(capture), "--out", str(stop.run), "--resume"])
        raise KeyboardInterrupt(f"Stopped and saved. Go on with: {command}") from None
    finally:
        if viewer:
            viewer.close()


def _evaluate(run: Path, device: Device) -> None:
    try:
        evaluate_and_report(run, device=device)
    except KeyboardInterrupt:
        command = shlex.join(["evsplat", "evaluate", str(run)])
        raise KeyboardInterrupt(
            f"Stopped; the training is finished and saved. Go on with: {command}"
        ) from None
