"""``evsplat report``: write report.html of an evaluated run again."""

from evsplat.cli.options import RunFolder


def report(run: RunFolder, /) -> None:
    """Write report.html of an evaluated run again.

    Args:
        run: Run folder with metrics.json (made by 'evsplat evaluate').
    """
    from evsplat.evaluation.report import write_report

    print(f"report: {write_report(run)}")
