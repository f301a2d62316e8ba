"""The loop of a training: step after step, with checkpoints, log, progress and Ctrl-C."""

import json
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from tqdm import tqdm

from evsplat.commands import command
from evsplat.errors import DataError
from evsplat.files import open_output
from evsplat.training.checkpoint import save_checkpoint
from evsplat.training.run import RunFolder
from evsplat.training.sound import check_learned
from evsplat.training.trainer import StepReport, Trainer
from evsplat.training.watching import Showcase

CHECKPOINT_SECONDS = 30.0
"""Time between checkpoints; writing one changes nothing in the training."""
LOG_EVERY = 10
"""Steps between lines of the log."""


class Stopped(KeyboardInterrupt):
    """Training was interrupted by the user after the step was finished and saved."""

    def __init__(self, run: Path) -> None:
        again = command("train", "...", "--out", run, "--resume")
        super().__init__(f"Stopped and saved. Go on with: {again}")
        self.run = run


def run_steps(trainer: Trainer, folder: RunFolder) -> None:
    """Step until the schedule or the time is over, saving and logging on the way.

    Raises:
        Stopped: Ctrl-C or SIGTERM; the step is finished and saved.
        DataError: No step was made in the time given, or none of those made gave a finite loss.
    """
    clock = trainer.clock

    def save(ending: bool = False) -> None:
        tensors, state = trainer.state()
        if ending:
            tensors |= trainer.ending()
        save_checkpoint(folder.checkpoints, clock.iteration, tensors, state)

    saved_at, first = time.perf_counter(), clock.iteration
    with (
        _interrupt_flag() as interrupted,
        open_output(folder.log, "ab", buffered=False) as log,
        _progress_bar() as bar,
        Showcase(folder.path).open() as showcase,
    ):
        while not clock.done and not clock.out_of_time:
            started = time.perf_counter()
            report = trainer.step()
            logged = (clock.iteration + 1) % LOG_EVERY == 0
            if report is not None and logged:
                trainer.bad.settle()  # what a GPU has still to do belongs to this step's time
            trainer.advance(report, time.perf_counter() - started)
            if report is not None and (logged or clock.done):
                log.write(json.dumps(_log_line(trainer, report)).encode() + b"\n")
                _show(bar, trainer, report)
            if interrupted:
                save()
                raise Stopped(folder.path)
            if time.perf_counter() - saved_at > CHECKPOINT_SECONDS:
                save()
                saved_at = time.perf_counter()
            showcase.show(trainer.snapshot)
        check_learned(trainer, clock.iteration - first)
        save()
        if clock.iteration > 0 and not interrupted:
            save(ending=True)  # once more: what was learned is safe whatever this takes
        if interrupted:
            raise Stopped(folder.path)
    if clock.iteration == 0:
        raise DataError(
            f"{folder.path}: no step was made in the time given; give more by --max-minutes."
        )


def _log_line(trainer: Trainer, report: StepReport) -> dict[str, object]:
    clock = trainer.clock
    return {
        "iteration": clock.iteration,
        "nominal": round(clock.nominal, 3),
        "ends_at": clock.expected_iterations,
        "seconds": round(clock.seconds, 3),
        "loss": report.loss,
        "terms": report.terms,
        "psnr": report.psnr,
        **trainer.counts(),
        "skipped": trainer.bad.settle(),
        "lr": trainer.optimiser.learning_rates(),
    }


def _progress_bar() -> "tqdm[Any]":
    """A bar that moves on a terminal, and a line now and then in a file."""
    return tqdm(
        total=100.0,
        bar_format="{percentage:3.0f}%|{bar:24}| {postfix}",
        mininterval=0.2 if sys.stderr.isatty() else 30.0,
        miniters=0,
    )


def _show(bar: "tqdm[Any]", trainer: Trainer, report: StepReport) -> None:
    clock, counts = trainer.clock, trainer.counts()
    minutes, seconds = divmod(round(clock.seconds_left), 60)
    bar.set_postfix_str(
        f"step {clock.iteration}/{clock.expected_iterations}  loss {report.loss:.4f}  "
        f"psnr {report.psnr:.2f}  person {counts['human']}  scene {counts['scene']}  "
        f"left {minutes}:{seconds:02d}",
        refresh=False,
    )
    bar.update(100 * clock.fraction - bar.n)


@contextmanager
def _interrupt_flag() -> Iterator[list[bool]]:
    """A list that becomes non-empty on Ctrl-C or SIGTERM; a second one interrupts at once."""
    pressed: list[bool] = []

    def handle(number: int, frame: FrameType | None) -> None:
        if pressed:
            raise KeyboardInterrupt
        pressed.append(True)

    numbers = (signal.SIGINT, signal.SIGTERM)
    try:
        previous = [signal.signal(number, handle) for number in numbers]
    except ValueError:  # not in the main thread: Ctrl-C goes elsewhere
        yield pressed
        return
    try:
        yield pressed
    finally:
        for number, handler in zip(numbers, previous, strict=True):
            signal.signal(number, handler)
