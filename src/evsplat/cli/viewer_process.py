"""The viewer beside a training: a process of its own, which cannot hold the training up."""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

from evsplat.cli.exits import exit_code
from evsplat.view import check_viewer, view_run


class ViewerProcess:
    """Shows a run from its first step until it is closed, or until `wait` is interrupted.

    It ends with the process that started it, whatever ended that.
    """

    def __init__(self, port: int) -> None:
        """Raise a `ConfigError` at once where the viewer is not installed."""
        check_viewer()
        self.port = port
        self._process: subprocess.Popen | None = None

    def start(self, run: Path) -> None:
        """Begin to show a run."""
        command = [sys.executable, "-m", __name__, str(run), str(self.port)]
        # In a session of its own, so that Ctrl-C stops the training and not what shows its end. The
        # pipe is never written to: the system closes it when this process ends.
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True)

    def wait(self) -> None:
        """Leave the result in the browser until Ctrl-C."""
        if self._process is not None and self._process.poll() is None:
            print("The view stays open; Ctrl-C closes it.", flush=True)
            self._process.wait()

    def close(self) -> None:
        """End the viewer, where it runs."""
        if self._process is not None:
            self._process.terminate()
            self._process.wait()


def _end_with_parent() -> None:
    """Close this process when the other end of its standard input is closed."""
    sys.stdin.buffer.read()
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    threading.Thread(target=_end_with_parent, daemon=True).start()
    sys.exit(exit_code(lambda: view_run(sys.argv[1], port=int(sys.argv[2]))))
