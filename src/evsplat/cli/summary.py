"""The table that is printed when a run has been evaluated."""

import shlex
import sys
from pathlib import Path
from typing import Any

_REGIONS = ("full", "person_crop", "person_mask")


def print_summary(metrics: dict[str, Any], *, run: Path, report: Path) -> None:
    """Print the run's figures above the trivial rows, where the report is and how to view it."""
    print(summary_table(metrics))
    print(f"run:    {run}\nreport: {report}\nview:   {_command()} view {shlex.quote(str(run))}")


def summary_table(metrics: dict[str, Any]) -> str:
    """Format PSNR (dB) / SSIM of protocol 'standard' per region: the run and the trivial rows.

    The last row is what the camera itself took at those times, which no method sees.
    """
    from evsplat.evaluation.tables import composited, terms

    if metrics["frames"]["test"] == 0:
        return f"No test figures. {terms(metrics)}"
    rows = {
        metrics["method"]: metrics["protocols"]["standard"],
        **composited(metrics),
        **metrics["trivial"],
        "own blurry picture": metrics["blurry_input"],
    }
    width = max(map(len, rows))
    head = "".join(f"{region.replace('_', ' '):>18}" for region in _REGIONS)
    lines = [f"PSNR dB / SSIM on the test frames, protocol 'standard'\n{'':{width}}{head}"]
    for name, regions in rows.items():
        cells = "".join(f"{_cell(regions[region]):>18}" for region in _REGIONS)
        lines.append(f"{name:{width}}{cells}")
    return "\n".join([*lines, terms(metrics)])


def _cell(values: dict[str, float | None] | None) -> str:
    """Format one region; a figure that could not be measured is a dash."""
    values = values or {}
    psnr, ssim = values.get("psnr"), values.get("ssim")
    return f"{'-' if psnr is None else f'{psnr:.2f}'} / {'-' if ssim is None else f'{ssim:.3f}'}"


def _command() -> str:
    """What the user types to call evsplat: as it was called, where that is a path to it."""
    called = Path(sys.argv[0])
    return str(called) if called.name == "evsplat" and not called.is_absolute() else "evsplat"
