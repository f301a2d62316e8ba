"""Turning other people's data sets, and your own recording, into captures."""

from evsplat.importers.base import Importer
from evsplat.importers.kinds import KINDS, Blur, import_capture, run_importer

__all__ = ["KINDS", "Blur", "Importer", "import_capture", "run_importer"]
