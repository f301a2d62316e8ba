"""Options of the verbs, each written once: what the command line and Python take as one value.

A field's annotation gives type, range and placeholder, its docstring the help text. Nothing here
loads torch, so that ``--help`` is quick.
"""

from evsplat.options.captures import (
    PoseOptions,
    PoseSearch,
    ReadOptions,
    StageSettings,
    SynthesisSettings,
)
from evsplat.options.runs import BenchOptions, ExportOptions, Film, TrainOptions

__all__ = [
    "BenchOptions",
    "ExportOptions",
    "Film",
    "PoseOptions",
    "PoseSearch",
    "ReadOptions",
    "StageSettings",
    "SynthesisSettings",
    "TrainOptions",
]
