"""Reading the command line: which verb, with which options."""

import gc
import io
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import is_dataclass
from difflib import get_close_matches
from typing import Any

import tyro

import evsplat
from evsplat.cli import captures, runs
from evsplat.cli.doctor import doctor
from evsplat.cli.exits import end_quietly, exit_code
from evsplat.cli.import_ import check_kind, import_, import_with_kinds
from evsplat.errors import ConfigError
from evsplat.options.inputs import check_inputs
from evsplat.options.reading import IN_ORDER, lists_of

_VERBS: dict[str, Callable[..., Any]] = {
    "demo": runs.demo,
    "doctor": doctor,
    "import": import_,
    "convert": captures.Convert,
    "simulate": captures.Simulate,
    "synthesize": captures.Synthesize,
    "stage": captures.Stage,
    "inspect": captures.Inspect,
    "masks": captures.Masks,
    "poses": captures.Poses,
    "restore": captures.Restore,
    "settings": runs.Settings,
    "train": runs.Train,
    "evaluate": runs.Evaluate,
    "report": runs.Report,
    "render": runs.Render,
    "view": runs.View,
    "export": runs.Export,
    "bench": runs.Bench,
}
"""A function works as it is called; an object is called for its work."""
_DESCRIPTION = (
    "A sharp 3D Gaussian person in a scene, from a blurry video and events.\n\n"
    "Start with 'evsplat demo'; 'evsplat VERB --help' tells more."
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code, see `exit_code`."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # A terminal of the C locale cannot show every name that a capture may have.
            stream.reconfigure(errors="backslashreplace")
    is_process = arguments is None
    if is_process:
        # Imports make 230,000 objects that stay: to look at the young ones after every 700, as
        # Python 3.11 does, is a seventh of their time.
        gc.set_threshold(10_000)
    if is_process and not sys.stderr.isatty():
        # In a file each move of a progress bar is a line; tqdm, not imported yet, reads this.
        os.environ.setdefault("TQDM_MININTERVAL", "30")
    typed = sys.argv[1:] if arguments is None else arguments

    def work() -> None:
        arguments = _gathered(typed)
        if arguments == ["--version"]:
            print(f"evsplat {evsplat.__version__}")
            return
        if arguments and not arguments[0].startswith("-") and arguments[0] not in _VERBS:
            near = get_close_matches(arguments[0], _VERBS, 1, cutoff=0.0)[0]
            raise ConfigError(
                f"{arguments[0]}: no such verb; did you mean {near}? 'evsplat --help' lists all."
            )
        if arguments[:1] == ["import"]:
            check_kind(arguments[1:])
        verbs = _VERBS
        if not arguments or arguments[0].startswith("-"):
            verbs = {name: _in_a_line(verb) for name, verb in _VERBS.items()}
        if arguments[:1] == ["import"]:
            verbs = {**_VERBS, "import": import_with_kinds()}
        with IN_ORDER:
            asked = tyro.extras.subcommand_cli_from_dict(
                verbs,
                prog="evsplat",
                description=_DESCRIPTION,
                args=arguments or ["--help"],
                config=(tyro.conf.DisallowNone, tyro.conf.FlagCreatePairsOff),
            )
        if callable(asked):
            check_inputs(asked)
            asked()

    code = exit_code(work)
    if is_process:
        # The interpreter looks through all that is left for cycles before it ends: half a second of
        # a verb that imported PyTorch, for memory that goes with the process.
        gc.freeze()
        end_quietly()
    return code


def _gathered(arguments: Sequence[str]) -> list[str]:
    """``--set A=1 --set B=2`` as ``--set A=1 B=2``: the parser would keep the last one alone.

    So with all options of the verb that take several values, and with ``--set=A=1``.
    """
    lists = _lists(arguments)
    kept: list[list[str]] = []
    gathered: dict[str, list[str]] = {}
    last: list[str] | None = None
    for argument in arguments:
        name, equals, value = argument.partition("=")
        if name in lists:
            if name not in gathered:
                gathered[name] = [name]
                kept.append(gathered[name])
            last = gathered[name]
            last += [value] if equals else []
        elif last is not None and not argument.startswith("-"):
            last.append(argument)
        else:
            last = None
            kept.append([argument])
    return [word for words in kept for word in words]


def _lists(arguments: Sequence[str]) -> set[str]:
    verb: Any = _VERBS.get(arguments[0]) if arguments else None
    if arguments[:1] == ["import"]:
        from evsplat.importers import KINDS

        verb = KINDS.get("".join(arguments[1:2]))
    return lists_of(verb) if isinstance(verb, type) and is_dataclass(verb) else set()


def _in_a_line(verb: Callable[..., Any]) -> Callable[[], None]:
    """A verb as the list of all shows it: the first line of its description, no options."""

    def brief() -> None:
        pass

    brief.__doc__ = (verb.__doc__ or "").partition("\n")[0]
    return brief
