"""``evsplat evaluate``: measure a run against the capture's ground truth."""

from pathlib import Path
from typing import Annotated

from evsplat.cli.options import Device, RunFolder, option
from evsplat.cli.summary import print_summary


def evaluate(
    run: RunFolder,
    /,
    *,
    lpips_weights: Annotated[Path | None, option("FILE", default="torch hub cache")] = None,
    device: Device = "auto",
) -> None:
    """Measure a run on its test frames: metrics.json, tables, pictures, report.html.

    Args:
        run: Run folder written by 'evsplat train'.
        lpips_weights: Backbone weights for LPIPS; without any it stays empty, with the reason.
        device: Where to draw and compare.
    """
    evaluate_and_report(run, lpips_weights, device)


def evaluate_and_report(
    run: Path, lpips_weights: Path | None = None, device: Device = "auto"
) -> None:
    """Measure a run, write its report and print the table."""
    from evsplat.evaluation import evaluate_run
    from evsplat.evaluation.report import write_report

    metrics = evaluate_run(run, lpips_weights=lpips_weights, device=device)
    print_summary(metrics, run=run, report=write_report(run))
