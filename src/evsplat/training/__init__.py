"""The loop, schedules, checkpoints and the run folder."""

from evsplat.training.loop import Stopped
from evsplat.training.run import Run, load_run
from evsplat.training.train import train

__all__ = ["Run", "Stopped", "load_run", "train"]
