"""The loop, schedules, checkpoints and the run folder."""

from evsplat.training.run import Run, load_run
from evsplat.training.train import Stopped, train

__all__ = ["Run", "Stopped", "load_run", "train"]
