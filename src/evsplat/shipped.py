"""The capture that ships with the package."""

from importlib.resources import files
from pathlib import Path

from evsplat.errors import DataError


def demo_capture() -> Path:
    """Its folder: a synthetic dancer, 72 ms of blur per frame, with events and ground truth."""
    path = Path(str(files("evsplat") / "data" / "demo_capture"))
    if not (path / "capture.json").is_file():
        raise DataError(f"{path}: the demo capture is missing from this installation; reinstall.")
    return path
