"""The command ``evsplat``: one file per verb; the work is done by the packages they call."""

from evsplat.cli.main import main

__all__ = ["main"]
