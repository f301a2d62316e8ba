"""``evsplat view``: a run in the browser."""

from pathlib import Path
from typing import Annotated

import tyro

from evsplat.cli.options import Device, RunFolder, option


def view(
    run: RunFolder,
    other: Annotated[
        tyro.conf.Positional[Path | None], option("RUN2", default="no comparison")
    ] = None,
    /,
    *,
    port: Annotated[int, option("PORT", default="8080, or the next free one")] = 8080,
    host: Annotated[str, option("ADDRESS", default="127.0.0.1, this machine alone")] = "127.0.0.1",
    device: Device = "auto",
) -> None:
    """Show a run in the browser: any time, any viewpoint, beside the input or another run.

    Args:
        run: Run folder written by 'evsplat train'.
        other: A second run of the same capture to compare with.
        port: Where to listen.
        host: Which network to listen at; 0.0.0.0 lets other machines in.
        device: Where to draw.
    """
    from evsplat.view import view_run

    view_run(run, other, port=port, host=host, device=device)
