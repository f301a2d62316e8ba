"""``evsplat demo``: the whole way from a packaged capture to a report, in minutes."""

from typing import Annotated

from evsplat.cli.options import Device, NewRunFolder, Threads, option
from evsplat.cli.train import train
from evsplat.shipped import demo_capture


def demo(
    *,
    out: NewRunFolder = None,
    max_minutes: Annotated[float, option("M", default="6")] = 6.0,
    device: Device = "auto",
    threads: Threads = None,
) -> None:
    """Train on the packaged capture, evaluate it and write a report.

    A synthetic dancer, 72 ms of blur per frame, with events and ground truth.

    Args:
        out: Folder of the run.
        max_minutes: Minutes of training; evaluation and report come on top.
        device: Where to compute; auto takes what the installed rasterisers can use.
        threads: CPU threads.
    """
    train(demo_capture(), out=out, max_minutes=max_minutes, device=device, threads=threads)
