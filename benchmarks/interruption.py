"""Commands that are interrupted: each in a fork of a process that has imported everything."""

import atexit
import builtins
import errno
import io
import os
import random
import resource
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

HANG_S = 240.0
KINDS = ("kill", "term", "int", "twice", "full", "limit", "fault")
"""SIGKILL, SIGTERM, Ctrl-C, Ctrl-C twice, a disk that fills up, files that may not grow, calls of
the system that fail."""
_ERRORS = (errno.EIO, errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EROFS)
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT


@dataclass(frozen=True)
class Interruption:
    """What happens to a command."""

    kind: str
    share: float = 0.0
    """Of the time, of the largest file or of the calls, 0..1, at which it happens."""
    errno: int = errno.EIO
    lasting: bool = False
    """Whether calls go on failing."""

    @classmethod
    def random(cls, kind: str, rng: random.Random) -> "Interruption":
        """One of a kind."""
        return cls(kind, rng.random(), rng.choice(_ERRORS), rng.random() < 0.5)

    def __str__(self) -> str:
        more = f" {errno.errorcode[self.errno]}{'...' * self.lasting}" * (self.kind == "fault")
        return f"{self.kind} at {self.share:.3f}{more}"


@dataclass(frozen=True)
class Usual:
    """How a command goes when nothing happens to it."""

    seconds: float
    calls: int
    """Calls of the system that write."""
    largest_bytes: int
    """Of its files."""


@dataclass(frozen=True)
class Outcome:
    """How a command ended."""

    code: int
    """Exit code, negative for a signal."""
    seconds: float
    calls: int
    said: str
    """What it wrote to the terminal."""


def run(
    command: list[str],
    disk: "Disk",
    *,
    prepare: Callable[[], None] = lambda: None,
    interruption: Interruption | None = None,
    usual: Usual | None = None,
) -> Outcome:
    """Run ``evsplat`` with ``command`` in ``disk.path``; see what an interruption makes of it."""
    counted, counting = os.pipe()
    heard, saying = os.pipe()
    started = time.monotonic()
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        os.close(counted)
        _be_command(command, saying, disk.path, counting, prepare, interruption, usual)
    os.close(counting)
    os.close(saying)
    said = _Listener(heard)
    os.read(counted, 1)
    if interruption is not None and usual is not None:
        _interrupt(child, interruption, usual, disk)
    code = _end_of(child)
    calls = os.read(counted, 64)
    os.close(counted)
    disk.empty()
    return Outcome(code, time.monotonic() - started, int(calls or b"0"), said.text())


class _Listener(threading.Thread):
    """Reads what a command says, which a limit on the size of files does not reach."""

    def __init__(self, pipe: int) -> None:
        super().__init__(daemon=True)
        self._pipe, self._parts = pipe, list[bytes]()
        self.start()

    def run(self) -> None:
        """Read until nobody holds the other end."""
        while part := os.read(self._pipe, 1 << 16):
            self._parts.append(part)
        os.close(self._pipe)

    def text(self) -> str:
        """All of it; processes of a killed command end soon after it."""
        self.join(30)
        return b"".join(self._parts).decode(errors="replace")


def _interrupt(child: int, what: Interruption, usual: Usual, disk: "Disk") -> None:
    numbers = {"kill": signal.SIGKILL, "term": signal.SIGTERM}
    if what.kind not in ("kill", "term", "int", "twice", "full"):
        return
    time.sleep(0.02 + what.share * usual.seconds)
    if what.kind == "full":
        disk.fill()
        return
    with suppress(ProcessLookupError):
        os.kill(child, numbers.get(what.kind, signal.SIGINT))
        if what.kind == "twice":
            time.sleep(0.05)
            os.kill(child, signal.SIGINT)


def _end_of(child: int) -> int:
    """The exit code of a child; one that hangs is killed, which is -100."""
    deadline = time.monotonic() + HANG_S
    while time.monotonic() < deadline:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.005)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return -100


def _be_command(
    command: list[str],
    saying: int,
    place: Path,
    counting: int,
    prepare: Callable[[], None],
    interruption: Interruption | None,
    usual: Usual | None,
) -> None:
    """The child: never returns."""
    code = 1
    try:
        from evsplat.cli import main

        os.setsid()
        for number in (1, 2):
            os.dup2(saying, number)
        # Those of before take what they write to for a file of theirs.
        sys.stdout, sys.stderr = (os.fdopen(number, "w", buffering=1) for number in (1, 2))
        os.chdir(place)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        prepare()
        calls = _Calls(interruption, usual)
        if interruption is not None and usual is not None and interruption.kind == "limit":
            limit = round(interruption.share * usual.largest_bytes)
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
        os.write(counting, b".")
        try:
            code = main(command)
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
        with suppress(KeyboardInterrupt):  # a second one, when all was over
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, signal.SIG_IGN)
        calls.give_back()
        os.write(counting, str(calls.count).encode())
    except BaseException:
        traceback.print_exc()
    finally:
        with suppress(BaseException):
            atexit._run_exitfuncs()
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


class _Calls:
    """Counts the calls that write, and lets one of them, or all from it on, fail."""

    def __init__(self, interruption: Interruption | None, usual: Usual | None) -> None:
        self.count = 0
        self._fails_at = None
        if interruption is not None and usual is not None and interruption.kind == "fault":
            self._fails_at = 1 + int(interruption.share * usual.calls)
            self._errno, self._lasting = interruption.errno, interruption.lasting
        self._original: list[tuple[Any, str, Any]] = []
        for name in ("replace", "rename", "fsync", "mkdir", "fchmod", "link"):
            self._wrap(os, name, lambda args, rest: True)
        self._wrap(os, "open", lambda args, rest: bool(args[1] & _WRITING))
        for module in (io, builtins):
            self._wrap(module, "open", self._opens_to_write)

    def give_back(self) -> None:
        """Put the functions back."""
        for module, name, function in self._original:
            setattr(module, name, function)

    @staticmethod
    def _opens_to_write(args: tuple[Any, ...], rest: dict[str, Any]) -> bool:
        mode = rest.get("mode", args[1] if len(args) > 1 else "r")
        return any(letter in mode for letter in "wax+")

    def _wrap(self, module: Any, name: str, writes: Callable[..., bool]) -> None:
        function = getattr(module, name)

        def counted(*args: Any, **rest: Any) -> Any:
            if writes(args, rest):
                self.count += 1
                at = self._fails_at
                if at is not None and (self.count == at or (self._lasting and self.count > at)):
                    raise OSError(self._errno, os.strerror(self._errno), str(args[0]))
            return function(*args, **rest)

        self._original.append((module, name, function))
        setattr(module, name, counted)


class Disk:
    """A folder for a command to work in: a file system of its own where one may be mounted."""

    def __init__(self, path: Path, megabytes: int = 64) -> None:
        path.mkdir(parents=True)
        self.path = path
        mounting = ["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "none", str(path)]
        done = subprocess.run(mounting, capture_output=True) if os.geteuid() == 0 else None
        self.mounted = done is not None and done.returncode == 0

    def fill(self) -> None:
        """Let no byte be free."""
        if not self.mounted:
            return
        with suppress(OSError), open(self.path / "balloon", "wb", buffering=0) as balloon:
            for size in (1 << 20, 1 << 12):
                with suppress(OSError):
                    while balloon.write(bytes(size)) == size:
                        pass

    def empty(self) -> None:
        """Give the room back that `fill` took."""
        (self.path / "balloon").unlink(missing_ok=True)

    def close(self) -> None:
        """Let the file system go, where there is one."""
        if self.mounted:
            # A process of a killed command may be in it for another moment.
            subprocess.run(["umount", "--lazy", str(self.path)], check=True)
