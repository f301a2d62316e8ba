"""From what goes wrong to a message and an exit code."""

import errno
import logging
import os
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from pathlib import Path
from typing import Any, TextIO, cast

from evsplat.errors import (
    TRACEBACK,
    BackendError,
    EvsplatError,
    MachineError,
    OutputError,
    machine_error,
    why_not_written,
)
from evsplat.files import write_text

_BAD_INPUT = 2
_INTERRUPTED = 130
_NOBODY_READS = 141
_AGAIN_S = 0.02


def exit_code(work: Callable[[], object]) -> int:
    """Do what the command line asks for, with its messages; gives the exit code.

    0: done; 2: the input, the machine or an option is at fault (one message on stderr), or what is
    printed cannot be written;
    130: stopped by Ctrl-C or SIGTERM; 141: the reader of a pipe went away. Where memory, disk or
    system fail unforeseen, the message names a file with the traceback.
    """
    logging.basicConfig(format="%(message)s")
    logging.getLogger("evsplat").setLevel(logging.INFO)
    stops = _Stops()
    with stops, _dropped_interrupts_again(), _output_named():
        return _code(work, stops)


def _code(work: Callable[[], object], stops: "_Stops") -> int:
    """`exit_code`, while stops are taken."""
    try:
        try:
            work()
        finally:
            # A reader that went away is noticed here, not at the interpreter's end.
            if sys.stdout is not None:  # closed by whoever started this
                sys.stdout.flush()
    except KeyboardInterrupt as stop:
        stops.are_over()
        return _stopped(str(stop))
    except BrokenPipeError:
        # Whoever reads, such as head, has enough. What is still buffered goes nowhere, quietly.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _NOBODY_READS
    except Exception as error:
        if stops.became(error):
            stops.are_over()
            return _stopped()
        if isinstance(error, EvsplatError):
            return _said(error)
        if isinstance(error, OSError) and error.errno == errno.ENAMETOOLONG:
            return _said(OutputError(f"{error.filename}: {why_not_written(error)}."))
        older = _older_module(error)
        if older is not None:
            return _said(older)
        fault = machine_error(error)
        if fault is None:
            raise
        fault.__cause__ = error
        return _said(fault)
    return 0


class _Output:
    """Standard output, whose failures name it, as an `OSError` of a stream does not."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        with self._named():
            return self._stream.write(text)

    def flush(self) -> None:
        with self._named():
            self._stream.flush()

    @contextmanager
    def _named(self) -> Iterator[None]:
        try:
            yield
        except BrokenPipeError:
            raise
        except OSError as error:
            raise OutputError(f"standard output: {why_not_written(error)}.") from None


def end_quietly() -> None:
    """From here on, when nothing is left to be saved, Ctrl-C has no words."""
    with suppress(ValueError, KeyboardInterrupt):
        signal.signal(signal.SIGINT, signal.SIG_DFL)


def _stopped(words: str = "") -> int:
    _tell(f"\nevsplat: {words or 'Stopped.'}")
    return _INTERRUPTED


def _said(error: EvsplatError) -> int:
    _tell(f"evsplat: {error}{_kept_traceback(error)}")
    return _BAD_INPUT


def _tell(text: str) -> None:
    """Say it where somebody may read it: messages may go to the disk that is full."""
    with suppress(OSError):
        print(text, file=sys.stderr, flush=True)


def _older_module(error: Exception) -> BackendError | None:
    """`evsplat.compiled.older_module`, of a module that has been imported, which takes time."""
    compiled = sys.modules.get("evsplat.compiled")
    return None if compiled is None else compiled.older_module(error)


def _kept_traceback(error: EvsplatError) -> str:
    """Write what nobody expected to a file and give the words that name it; else nothing."""
    if not isinstance(error, MachineError) or error.__cause__ is None:
        return ""
    text = "".join(traceback.format_exception(error.__cause__))
    name = f"{TRACEBACK}{os.getpid()}.txt"
    for folder in (error.folder, Path(tempfile.gettempdir())):
        with suppress(EvsplatError, OSError, MemoryError):
            if folder is not None and folder.is_dir():
                write_text(folder / name, text)
                return f" The traceback is in {folder / name}."
    return ""


@contextmanager
def _output_named() -> Iterator[None]:
    """What fails of standard output is said with its name."""
    if sys.stdout is None:
        yield
        return
    with redirect_stdout(cast(TextIO, _Output(sys.stdout))):
        yield


class _Stops:
    """Ctrl-C, and SIGTERM for the same: it is how docker stop or a batch system asks for an end."""

    def __init__(self) -> None:
        self._came = False
        self._over = False
        self._before: dict[int, Any] = {}

    def __call__(self, number: int, frame: object) -> None:
        """Take a signal."""
        if self._over:
            return
        self._came = True
        raise KeyboardInterrupt

    def are_over(self) -> None:
        """The work has stopped: another would only fall among last words and what is given back."""
        self._over = True

    def became(self, error: BaseException | None) -> bool:
        """Whether a library in C made this error of a stop, which did not lead to it otherwise."""
        while error is not None and not isinstance(error, KeyboardInterrupt):
            error = error.__context__
        return self._came and error is None

    def __enter__(self) -> "_Stops":
        with suppress(ValueError):  # not in the main thread
            self._before[signal.SIGTERM] = signal.signal(signal.SIGTERM, self)
            if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
                self._before[signal.SIGINT] = signal.signal(signal.SIGINT, self)
        return self

    def __exit__(self, *of: object) -> None:
        for number, before in self._before.items():
            signal.signal(number, before)


@contextmanager
def _dropped_interrupts_again() -> Iterator[None]:
    """Ctrl-C that comes while an object is given back, which Python then drops, comes once more."""
    before = sys.unraisablehook

    def hook(dropped: "sys.UnraisableHookArgs") -> None:
        if not issubclass(dropped.exc_type, KeyboardInterrupt):
            before(dropped)
            return
        again = threading.Timer(_AGAIN_S, os.kill, (os.getpid(), signal.SIGINT))
        again.daemon = True
        again.start()

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = before
