"""Options of the verbs, each written once: what the command line and Python take as one value.

A field's annotation gives type, range and placeholder, its docstring the help text. Nothing here
loads torch, so that ``--help`` is quick.
"""

from evsplat.options.bench import BenchOptions
from evsplat.options.export import ExportOptions
from evsplat.options.film import Film
from evsplat.options.recording import ReadOptions
from evsplat.options.stage import StageSettings
from evsplat.options.synthesis import RECIPES, SynthesisSettings
from evsplat.options.train import TrainOptions

__all__ = [
    "RECIPES",
    "BenchOptions",
    "ExportOptions",
    "Film",
    "ReadOptions",
    "StageSettings",
    "SynthesisSettings",
    "TrainOptions",
]
