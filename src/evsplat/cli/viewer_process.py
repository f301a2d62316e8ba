"""The viewer beside a training: a process of its own, which cannot hold the training up."""

import subprocess
import sys
from pathlib import Path

from evsplat.view import check_viewer


class ViewerProcess:
    """Shows a run from its first step until it is closed, or until `wait` is interrupted."""

    def __init__(self, port: int) -> None:
        """Raise a `ConfigError` at once where the viewer is not installed."""
        check_viewer()
        self.port = port
        self._process: subprocess.Popen | None = None

    def start(self, run: Path) -> None:
        """Begin to show a run."""
        command = [sys.executable, "-m", "evsplat", "view", str(run), "--port", str(self.port)]
        # In a session of its own, so that Ctrl-C stops the training and not what shows its end.
        self._process = subprocess.Popen(command, start_new_session=True)

    def wait(self) -> None:
        """Leave the result in the browser until Ctrl-C."""
        if self._process is not None and self._process.poll() is None:
            print("The view stays open; Ctrl-C closes it.", flush=True)
            self._process.wait()

    def close(self) -> None:
        """Stop showing."""
        if self._process is not None:
            self._process.terminate()
            self._process.wait()
