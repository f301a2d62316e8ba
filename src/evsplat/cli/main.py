"""Reading the command line, and turning what goes wrong into a message and an exit code."""

import functools
import logging
import os
import sys
from collections.abc import Callable, Sequence
from typing import Any

import tyro

import evsplat
from evsplat.cli.bench import bench
from evsplat.cli.convert import convert
from evsplat.cli.demo import demo
from evsplat.cli.doctor import doctor
from evsplat.cli.evaluate import evaluate
from evsplat.cli.export import export
from evsplat.cli.import_ import import_, import_with_kinds
from evsplat.cli.inspect import inspect
from evsplat.cli.masks import masks
from evsplat.cli.render import render
from evsplat.cli.report import report
from evsplat.cli.restore import restore
from evsplat.cli.settings import settings
from evsplat.cli.simulate import simulate
from evsplat.cli.stage import stage
from evsplat.cli.synthesize import synthesize
from evsplat.cli.train import train
from evsplat.cli.view import view
from evsplat.errors import EvsplatError

_VERBS: dict[str, Callable[..., Any]] = {
    verb.__name__.rstrip("_"): verb
    for verb in (
        *(demo, doctor, import_, convert, simulate, synthesize, stage, inspect),
        *(masks, restore, settings, train, evaluate, report, render, view, export, bench),
    )
}
_DESCRIPTION = (
    "A sharp 3D Gaussian person in a scene, from a blurry video and events.\n\n"
    "Start with 'evsplat demo'; 'evsplat VERB --help' tells more."
)
_CODE_BAD_INPUT = 2
_CODE_INTERRUPTED = 130
_CODE_NOBODY_READS = 141


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code.

    0: done; 2: the input, the machine or an option is at fault (one message on stderr);
    130: stopped by Ctrl-C; 141: the reader of a pipe went away.
    """
    arguments = _gathered(sys.argv[1:] if arguments is None else arguments)
    if arguments == ["--version"]:
        print(f"evsplat {evsplat.__version__}")
        return 0
    logging.basicConfig(format="%(message)s")
    logging.getLogger("evsplat").setLevel(logging.INFO)
    verbs = _VERBS
    if not arguments or arguments[0].startswith("-"):
        verbs = {name: _in_a_line(verb) for name, verb in _VERBS.items()}
    if arguments[:1] == ["import"]:
        verbs = {**_VERBS, "import": import_with_kinds()}
    try:
        try:
            tyro.extras.subcommand_cli_from_dict(
                verbs,
                prog="evsplat",
                description=_DESCRIPTION,
                args=arguments or ["--help"],
                config=(tyro.conf.DisallowNone, tyro.conf.FlagCreatePairsOff),
            )
        finally:
            # A reader that went away is noticed here, not at the interpreter's end.
            sys.stdout.flush()
    except EvsplatError as error:
        print(f"evsplat: {error}", file=sys.stderr)
        return _CODE_BAD_INPUT
    except KeyboardInterrupt as stop:
        print(f"\nevsplat: {str(stop) or 'Stopped.'}", file=sys.stderr)
        return _CODE_INTERRUPTED
    except BrokenPipeError:
        # Whoever reads, such as head, has enough. What is still buffered goes nowhere, quietly.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _CODE_NOBODY_READS
    return 0


def _gathered(arguments: Sequence[str]) -> list[str]:
    """``--set A=1 --set B=2`` as ``--set A=1 B=2``: the parser would keep the last one alone."""
    kept: list[str] = []
    settings: list[str] = []
    place: int | None = None
    follows = False
    for argument in arguments:
        if argument == "--set":
            place = len(kept) if place is None else place
            follows = True
        elif follows and not argument.startswith("-"):
            settings.append(argument)
        else:
            follows = False
            kept.append(argument)
    return kept if place is None else [*kept[:place], "--set", *settings, *kept[place:]]


def _in_a_line(verb: Callable[..., Any]) -> Callable[..., Any]:
    """The verb with the first line of its description alone, so that the list fits a screen."""

    @functools.wraps(verb)
    def brief(*arguments: Any, **options: Any) -> Any:
        return verb(*arguments, **options)

    brief.__doc__ = (verb.__doc__ or "").partition("\n")[0]
    return brief
