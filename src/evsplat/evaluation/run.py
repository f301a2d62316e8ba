"""A trained run measured, and its report page: what ``evsplat evaluate`` and ``report`` do."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from evsplat.config import to_dict
from evsplat.errors import DataError
from evsplat.evaluation.evaluator import evaluate
from evsplat.evaluation.report.page import page
from evsplat.evaluation.report.source import Source
from evsplat.evaluation.splits import check_split, name_of
from evsplat.evaluation.tables import write_tables
from evsplat.files import held_folder, try_target, write_json, write_text
from evsplat.options.inputs import check_run_folder
from evsplat.options.runs import Split
from evsplat.render import choose_device
from evsplat.training.run import Run, load_run, opened
from evsplat.untrusted.faults import MISFITS, brief, broken_as

_SIGN = ".evaluating"
"""File in a run folder that is there while it is evaluated, and whose lock the evaluation holds."""


def evaluate_run(
    run_dir: Path | str,
    *,
    lpips_weights: Path | str | None = None,
    device: str = "auto",
    split: Split = "test",
) -> dict[str, Any]:
    """Measure a trained run and write metrics.json, metrics.md, metrics.tex and pictures/.

    ``device`` is where it is drawn and compared, not where it was trained. ``split="train"``
    measures the training frames against their sharp truth; its files are metrics_train.json and so
    on, beside those of the test frames. Where another process evaluates the run this one waits.
    """
    device = choose_device(device)
    with _in_turn(Path(run_dir)):
        return _measured(load_run(Path(run_dir), device=device), device, lpips_weights, split)


def write_report(run_dir: Path | str, *, split: Split = "test") -> Path:
    """Write report.html (report_train.html) of an evaluated run and return its path.

    Figures and rendered pictures come from what `evaluate_run` wrote; the clip is drawn anew.
    """
    check_split(split)
    with _in_turn(Path(run_dir)):
        return _reported(load_run(Path(run_dir)), Path(run_dir), split)


def evaluate_and_report(
    run: Run | Path | str,
    *,
    lpips_weights: Path | str | None = None,
    device: str = "auto",
    split: Split = "test",
) -> tuple[dict[str, Any], Path]:
    """`evaluate_run` and `write_report` of a run that is read once, here or before."""
    device = choose_device(device)
    with _in_turn(run.path if isinstance(run, Run) else Path(run)):
        loaded = opened(run, device=device)
        metrics = _measured(loaded, device, lpips_weights, split)
        return metrics, _reported(loaded, loaded.path, split)


@contextmanager
def _in_turn(run: Path) -> Iterator[None]:
    """Be the only process that writes figures, pictures and reports of a run; others come after.

    A run is read in the block, so that the last one measures the newest checkpoint.
    """
    check_run_folder(run)
    busy = "is evaluating this run or writing its report; this one goes on when it is done."
    with held_folder(run, _SIGN, busy, wait=True):
        yield


def _measured(
    run: Run, device: str, lpips_weights: Path | str | None, split: Split
) -> dict[str, Any]:
    start = time.monotonic()
    try_target(run.path)
    measured = evaluate(
        run.capture,
        run.reconstruction,
        out_dir=run.path,
        lpips_weights=lpips_weights,
        device=device,
        human_only=run.human_only,
        split=split,
        beside=run.beside() if run.capture.novel_views else None,
    )
    metrics = {
        "capture": measured.pop("capture"),
        "method": measured.pop("method"),
        "iteration": run.iteration,
        "train_seconds": run.train_seconds,
        "device": run.device,
        "gaussians": run.gaussians,
        "evaluate_seconds": round(time.monotonic() - start, 1),
        "policy": to_dict(run.policy),
        "poses": run.capture.poses_found,
        "seen": run.what_was_seen(),
        **measured,
    }
    write_json(run.path / name_of("metrics", split, ".json"), metrics)
    write_tables(run.path, metrics)
    return metrics


def _reported(run: Run, folder: Path, split: Split) -> Path:
    path = folder / name_of("report", split, ".html")
    source = Source.read(folder, run.capture, run.reconstruction, split)
    measured = source.metrics.get("iteration")
    if measured != run.iteration:
        raise DataError(
            f"{folder / name_of('metrics', split, '.json')}: iteration is {brief(measured)}, and "
            f"the run's last checkpoint is of step {run.iteration}; evaluate the run again."
        )
    with broken_as(
        folder,
        "its figures are not as evsplat evaluate writes them",
        "evaluate the run again",
        kinds=MISFITS,
    ):
        html = page(source)
    write_text(path, html)
    return path
