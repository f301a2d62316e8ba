"""A trained run measured, and its report page: what ``evsplat evaluate`` and ``report`` do."""

import time
from pathlib import Path
from typing import Any

from evsplat.config import to_dict
from evsplat.evaluation.evaluator import evaluate
from evsplat.evaluation.report.page import page
from evsplat.evaluation.report.source import Source
from evsplat.evaluation.tables import write_tables
from evsplat.files import write_json, write_text
from evsplat.render import choose_device
from evsplat.training.run import load_run


def evaluate_run(
    run_dir: Path | str, *, lpips_weights: Path | str | None = None, device: str = "auto"
) -> dict[str, Any]:
    """Measure a trained run and write metrics.json, metrics.md, metrics.tex and pictures/.

    ``device`` is where it is drawn and compared, not where it was trained.
    """
    start = time.monotonic()
    device = choose_device(device)
    run = load_run(Path(run_dir), device=device)
    measured = evaluate(
        run.capture,
        run.reconstruction,
        out_dir=run.path,
        lpips_weights=lpips_weights,
        device=device,
        human_only=run.human_only,
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
        **measured,
    }
    write_json(Path(run.path) / "metrics.json", metrics)
    write_tables(Path(run.path), metrics)
    return metrics


def write_report(run_dir: Path | str) -> Path:
    """Write report.html of an evaluated run and return its path.

    Figures and rendered pictures come from what `evaluate_run` wrote; the clip is drawn anew.
    """
    run = load_run(Path(run_dir))
    path = Path(run_dir) / "report.html"
    write_text(path, page(Source.read(Path(run_dir), run.capture, run.reconstruction)))
    return path
