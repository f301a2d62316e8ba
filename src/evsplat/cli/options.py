"""Options that several verbs share, and how optional ones show in the help."""

from pathlib import Path
from typing import Annotated, Any, Literal

import tyro


def option(metavar: str, *, default: str, name: str | None = None) -> Any:
    """Describe an option in the help: its placeholder and, in words, what happens without it."""
    return tyro.conf.arg(name=name, metavar=metavar, help_behavior_hint=f"(default: {default})")


CaptureFolder = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CAPTURE")]
RunFolder = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
Device = Literal["auto", "cpu", "cuda"]
NewRunFolder = Annotated[Path | None, option("RUN", default="runs/CAPTURE/METHOD/TIME")]
Flag = Annotated[bool, tyro.conf.arg(help_behavior_hint="")]
Use = Annotated[
    Literal["training", "everything"],
    tyro.conf.arg(help_behavior_hint="(default: training)"),
]
Threads = Annotated[int | None, option("N", default="all cores")]
