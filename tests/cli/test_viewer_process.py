"""The viewer of a training ends with it."""

import signal
import subprocess
import sys

import pytest

from evsplat.training_sign import training_in

pytest.importorskip("viser", reason="needs the extra view: pip install 'evsplat[view]'")

PARENT = """
import sys, time
from pathlib import Path
from evsplat.cli.viewer_process import ViewerProcess
viewer = ViewerProcess(18999)
viewer.start(Path(sys.argv[1]))
time.sleep(300)
"""


def test_it_ends_when_the_training_is_ended_from_outside(tmp_path):
    command = [sys.executable, "-c", PARENT, str(tmp_path)]
    with training_in(tmp_path):  # a training before its first checkpoint
        parent = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            assert parent.stdout is not None
            assert "being trained" in parent.stdout.readline()
            assert parent.poll() is None
            parent.terminate()
            # The viewer holds the same pipe: it is at its end only when both are gone.
            parent.communicate(timeout=60)
        finally:
            parent.kill()
    assert parent.returncode == -signal.SIGTERM
