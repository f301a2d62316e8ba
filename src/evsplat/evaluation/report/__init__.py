"""The report page: one HTML file that needs nothing else."""

from pathlib import Path

from evsplat.evaluation.report.page import page
from evsplat.evaluation.report.source import Source
from evsplat.files import write_text

__all__ = ["write_report"]


def write_report(run_dir: Path | str) -> Path:
    """Write report.html of an evaluated run and return its path.

    Figures and rendered pictures come from what `evaluate_run` wrote; the clip is drawn anew.
    """
    from evsplat.training.run import load_run

    run = load_run(Path(run_dir))
    path = Path(run_dir) / "report.html"
    write_text(path, page(Source.read(Path(run_dir), run.capture, run.reconstruction)))
    return path
