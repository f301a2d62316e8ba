"""Writing files whole or not at all."""

import errno
import json
import logging
import os
import shutil
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, Literal, cast

from evsplat.disk import (
    exchange,
    flush_below,
    flush_folder,
    held,
    is_at,
    temporary_file,
    temporary_folder,
)
from evsplat.errors import (
    NO_ROOM,
    ConfigError,
    DataError,
    OutputError,
    only_writing_says,
    why_not_written,
)

logger = logging.getLogger(__name__)

_READER_S, _AGAIN_S = 2.0, 0.02
"""Time that the reader of a pipe has to open it, and between two looks."""


@contextmanager
def atomic_path(path: Path | str) -> Iterator[Path]:
    """Give a temporary path beside ``path`` that takes its name when the block ends well.

    The suffix is kept, so that writers which choose the format by it work. What was written is on
    the disk before it takes the name. On an exception the temporary file is removed and ``path``
    stays as it was. Where ``path`` is a link, the file that it leads to is replaced and the link
    stays; a device or a pipe is itself written into.

    Raises:
        OutputError: No room, no permission, or something is in the way.
    """
    path = Path(path)
    with _output_errors(path) as errors:
        if path.is_dir():
            raise DataError(f"{path}: is a folder; give the name of a file.")
        if path.exists() and not path.is_file():
            # replaced, a device would be lost to all who use it
            with errors.of_writing(), _with_reader(path):
                yield path
            return
        target = Path(os.path.realpath(path)) if path.is_symlink() else path
        if target.is_symlink():
            raise DataError(f"{path}: is a link that leads to itself; remove it.")
        with _folder_of(target), temporary_file(target) as (handle, temporary):
            with errors.of_writing():
                yield temporary
            assert is_at(handle, temporary), "an encoder put a file of its own in its place"
            os.fchmod(handle, 0o666 & ~_umask())
            os.fsync(handle)
            os.replace(temporary, target)
            flush_folder(target.parent)


@contextmanager
def _with_reader(path: Path) -> Iterator[None]:
    """Hold a pipe open that somebody reads: opening one that nobody does would wait for ever."""
    if not path.is_fifo():
        yield
        return
    deadline = time.monotonic() + _READER_S
    while True:
        try:
            handle = os.open(path, os.O_WRONLY | os.O_NONBLOCK)
            break
        except OSError as error:
            if error.errno != errno.ENXIO:
                raise
            if time.monotonic() > deadline:
                raise OutputError(
                    f"{path}: is a pipe that nobody reads; start what reads it first, or remove it."
                ) from None
            time.sleep(_AGAIN_S)
    try:
        yield
    finally:
        os.close(handle)


@contextmanager
def new_folder(path: Path | str, *, replace: bool = False) -> Iterator[Path]:
    """Give an empty hidden folder beside ``path`` that takes its name when the block ends well.

    On an exception it is removed with all that is in it. Something that is already there is a
    `DataError`, at the start as at the end; with ``replace`` a folder that is there stays until the
    new one takes its place in one step.
    """
    path = Path(path)
    with _output_errors(path) as errors:
        if replace and path.is_symlink():
            path = Path(os.path.realpath(path))
        if not replace:
            refuse_existing(path)
        with _folder_of(path), temporary_folder(path.parent) as temporary:
            with errors.of_writing(), _named_by(path, temporary):
                yield temporary
            temporary.chmod(0o777 & ~_umask())
            flush_below(temporary)
            if replace and path.is_dir():
                exchange(temporary, path)
            else:
                refuse_existing(path)
                temporary.rename(path)
            flush_folder(path.parent)


@contextmanager
def _named_by(path: Path, temporary: Path) -> Iterator[None]:
    """What could not be written below a temporary folder is told by the name that was asked for."""
    try:
        yield
    except OutputError as error:
        told = str(error).replace(str(temporary), str(path))
        raise OutputError(told, no_room=error.no_room) from error


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """A folder among the system's temporary files for the time of the block."""
    place = Path(tempfile.gettempdir())
    with _output_errors(place) as errors, temporary_folder(place) as folder, errors.of_writing():
        yield folder


def refuse_existing(path: Path) -> None:
    """A `DataError` where something is there already: before long work, or just before writing."""
    if os.path.lexists(path):
        raise DataError(f"{path}: already exists; choose another name or remove it first.")


def try_target(path: Path | str, room: int = 0) -> None:
    """An `OutputError` where ``path``, a file or folder to be, could not be written after the work.

    A file is really made in the nearest folder that is there, and removed; ``room`` is how many
    bytes have to be free. What is at ``path`` stays untouched.
    """
    path = Path(os.path.realpath(path))
    with _output_errors(path):
        if path.exists() and not path.is_dir() and not path.is_file():
            return  # a device
        folder = path if path.is_dir() else path.parent
        while not folder.exists():
            folder = folder.parent
        with temporary_file(folder / "x"):
            pass
        free = shutil.disk_usage(folder).free
    if free < room:
        raise OutputError(
            f"{path}: {free / 1e6:.1f} MB are free on its disk, expected {room / 1e6:.1f} MB; make "
            "room there or write elsewhere.",
            no_room=True,
        )


def remove_folder(path: Path) -> None:
    """Remove a folder at once as others see it, with all in it; one that is a link is refused."""
    if path.is_symlink():
        raise DataError(f"{path}: is a link to another folder, so it stays; remove it yourself.")
    with _output_errors(path), temporary_folder(path.parent) as temporary:
        path.rename(temporary / "old")


@contextmanager
def held_folder(path: Path, sign: str, busy: str, *, wait: bool = False) -> Iterator[None]:
    """Hold a folder, made where it is missing, by the lock of the file ``sign`` in it.

    The file goes at the end, and so does a folder that was made and has nothing else in it. Where
    another process holds it there is a `ConfigError` that ends in ``busy``; to ``wait`` for its end
    instead, that is logged.
    """
    with _output_errors(path) as errors, _folder_of(path / sign, keep=False), ExitStack() as stack:
        try:
            stack.enter_context(held(path / sign))
        except BlockingIOError as error:
            holder = f"process {error.strerror}" if error.strerror else "another process"
            said = f"{path}: {holder} {busy}"
            if not wait:
                raise ConfigError(said) from None
            logger.info("%s", said)
            stack.enter_context(held(path / sign, wait=True))
        try:
            with errors.of_writing():
                yield
        finally:
            remove_file(path / sign)


def make_folder(path: Path) -> None:
    """Make a folder and those above it, where they are not there."""
    with _output_errors(path):
        path.mkdir(parents=True, exist_ok=True)


def remove_file(path: Path) -> None:
    """Remove a file or a link, where it is there."""
    path.unlink(missing_ok=True)


def unnamed_file(folder: Path) -> BinaryIO:
    """A file to write and read without a name in ``folder``; it ends when it is closed."""
    with _output_errors(folder):
        return cast(BinaryIO, tempfile.TemporaryFile(dir=folder))


def copy_file(source: Path, target: Path, *, link: bool = False) -> None:
    """Copy a file to a place in a folder that `new_folder` gave; as a hard link where that goes."""
    make_folder(target.parent)
    if link:
        with suppress(OSError):
            os.link(source, target)
            return
    with _output_errors(target):
        shutil.copyfile(source, target)


def open_output(
    path: Path, mode: Literal["wb", "w+b", "ab"] = "wb", *, buffered: bool = True
) -> BinaryIO:
    """Open a temporary path that this module gave, or a log to be added to."""
    with _output_errors(path):
        return path.open(mode, buffering=-1 if buffered else 0)


def write_bytes(path: Path | str, content: bytes) -> None:
    """Write ``content``, whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def write_pieces(path: Path | str, pieces: Iterable[bytes | memoryview]) -> None:
    """Write what would be too large in one piece, whole or not at all."""
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.writelines(pieces)


def write_text(path: Path | str, text: str) -> None:
    """Write ``text`` as UTF-8, whole or not at all.

    What UTF-8 cannot hold, such as other bytes of a file's name, is escaped as on standard output.
    """
    write_bytes(path, text.encode(errors="backslashreplace"))


def write_json(path: Path | str, value: Any) -> None:
    """Write ``value`` as indented JSON, whole or not at all; NaN is refused."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


class _OutputErrors:
    """Which errors of the system are the output's: all, or in a block those of writing alone."""

    def __init__(self) -> None:
        self.all = True

    @contextmanager
    def of_writing(self) -> Iterator[None]:
        """A block that may read other files as well, whose errors are their own."""
        self.all = False
        yield
        self.all = True


@contextmanager
def _output_errors(path: Path) -> Iterator[_OutputErrors]:
    """Errors of the system become an `OutputError` about ``path``."""
    errors = _OutputErrors()
    try:
        yield errors
    except OSError as error:
        if isinstance(error, BrokenPipeError) or not (errors.all or only_writing_says(error)):
            raise
        sentence = f"{path}: {why_not_written(error)}."
        raise OutputError(sentence, no_room=error.errno in NO_ROOM) from error


@contextmanager
def _folder_of(target: Path, *, keep: bool = True) -> Iterator[None]:
    """The folder of a path and those above it are there; what was made for nothing goes again.

    ``keep`` what was made for something; else what is empty at the end goes in any case.
    """
    parent = Path(os.path.realpath(target.parent))  # a link may lead to what is not there yet
    made = [folder for folder in (parent, *parent.parents) if not folder.exists()]
    parent.mkdir(parents=True, exist_ok=True)
    try:
        yield
        made = [] if keep else made
    finally:
        for folder in made:
            with suppress(OSError):
                folder.rmdir()


def _umask() -> int:
    umask = os.umask(0)
    os.umask(umask)
    return umask
