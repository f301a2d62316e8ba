"""What writing is made of: locks, temporary files and folders, flushing, names exchanged.

Locks end with the process that holds them, however it ends.
"""

import atexit
import ctypes
import errno
import fcntl
import functools
import os
import re
import secrets
import shutil
import signal
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_SUFFIX = ".part"
_TEMPORARY = re.compile(r"\.evsplat-\w{8}-\w{8}\.part(\..*)?", re.DOTALL)
"""Names of what is being written. The process that writes holds a lock on it: what nobody holds was
left behind by a process that was killed."""
_swept: set[str] = set()
"""Folders in which this process has looked for such left-overs."""
_TRIES, _GLANCE_S = 20, 0.05
"""Who asks whether a lock is held, holds it for an instant itself."""


def lock(handle: int, *, shared: bool = False, wait: bool = False) -> bool | None:
    """Hold an open file or folder until it is closed; whether that could be had.

    False: another process holds it. None: this file system has no locks.
    """
    kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    try:
        fcntl.flock(handle, kind if wait else kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Ctrl-C and SIGTERM wait for the end of the block.

    For libraries in C that call back into Python and crash where that raises, or tell of
    something else.
    """
    came: list[int] = []
    handlers = {}
    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            before = signal.getsignal(number)
            if callable(before):
                signal.signal(number, lambda number, frame: came.append(number))
                handlers[number] = before
    except ValueError:  # not the main thread, in which signals arrive
        pass
    try:
        yield
    finally:
        for number, before in handlers.items():
            signal.signal(number, before)
        if came:
            signal.raise_signal(came[0])


@contextmanager
def held(path: Path, *, wait: bool = False) -> Iterator[None]:
    """Hold the lock of a file, which is made where it is missing and tells the process's number.

    So is its folder, which whoever held it may have removed. Where the file system has no locks
    nothing is held. The file stays.

    Raises:
        BlockingIOError: Another process holds it; its number is the error's ``strerror``.
    """
    tries_left = _TRIES
    while True:
        try:
            handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        except FileNotFoundError:
            path.parent.mkdir(parents=True, exist_ok=True)
            continue
        try:
            if lock(handle, wait=wait) is False:
                if not tries_left:
                    raise BlockingIOError(errno.EWOULDBLOCK, os.pread(handle, 32, 0).decode())
                tries_left -= 1
                time.sleep(_GLANCE_S)
                continue
            if not is_at(handle, path):
                continue  # whoever held it has removed it
            os.truncate(handle, 0)
            with suppress(OSError):  # a disk may be full; it is the lock that counts
                os.pwrite(handle, str(os.getpid()).encode(), 0)
            yield
            return
        finally:
            os.close(handle)


def is_held(path: Path) -> bool:
    """Whether a process holds the lock of a file; where there are no locks, whether it is there."""
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError:
        return False
    try:
        return lock(handle, shared=True) is not True
    finally:
        os.close(handle)


def is_at(handle: int, path: Path) -> bool:
    """Whether an open file still has its name."""
    try:
        return os.path.samestat(os.fstat(handle), os.stat(path))
    except OSError:
        return False


@contextmanager
def temporary_file(target: Path) -> Iterator[tuple[int, Path]]:
    """A locked file beside ``target``, open as a handle; gone at the end if it still has its name.

    Room, permission and links of the folder are the system's to judge.
    """
    _sweep(target.parent)
    while True:
        handle, name = tempfile.mkstemp(
            _SUFFIX + target.suffix, _prefix(os.getpid()), target.parent
        )
        lock(handle, wait=True)
        if os.fstat(handle).st_nlink:
            break  # else it was swept away before it was locked
        os.close(handle)
    try:
        yield handle, Path(name)
    finally:
        Path(name).unlink(missing_ok=True)
        os.close(handle)


@contextmanager
def temporary_folder(parent: Path) -> Iterator[Path]:
    """A locked folder in ``parent``; gone at the end, with all in it, if it still has its name."""
    _sweep(parent)
    while True:
        folder = tempfile.mkdtemp(_SUFFIX, _prefix(os.getpid()), parent)
        try:
            handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        except FileNotFoundError:
            continue
        lock(handle, wait=True)
        if os.path.isdir(folder):
            break
        os.close(handle)
    try:
        yield Path(folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(handle)


def _sweep(folder: Path) -> None:
    """Remove, once per process and folder, what killed processes left half written in it."""
    place = os.path.realpath(folder)
    if place in _swept:
        return
    _swept.add(place)
    with suppress(OSError), os.scandir(place) as entries:
        for entry in [entry for entry in entries if _TEMPORARY.fullmatch(entry.name)]:
            with suppress(OSError):
                _remove_left_over(entry)


@functools.cache
def _prefix(process: int) -> str:
    """With what the temporary names of this process begin; a fork has its own."""
    return f".evsplat-{secrets.token_hex(4)}-"


@atexit.register
def _remove_own() -> None:
    """Remove what Ctrl-C in the midst of removing left."""
    prefix = _prefix(os.getpid())
    for place in _swept:
        with suppress(OSError), os.scandir(place) as entries:
            for entry in [entry for entry in entries if entry.name.startswith(prefix)]:
                with suppress(OSError):
                    _remove(entry)


def _remove(entry: "os.DirEntry[str]") -> None:
    is_folder = entry.is_dir(follow_symlinks=False)
    shutil.rmtree(entry.path) if is_folder else os.unlink(entry.path)


def _remove_left_over(entry: "os.DirEntry[str]") -> None:
    is_folder = entry.is_dir(follow_symlinks=False)
    if not is_folder and not entry.is_file(follow_symlinks=False):
        return
    access = os.O_RDONLY | os.O_DIRECTORY if is_folder else os.O_RDWR
    handle = os.open(entry.path, access | os.O_NOFOLLOW)
    try:
        if lock(handle):
            _remove(entry)
    finally:
        os.close(handle)


def exchange(new: Path, old: Path) -> None:
    """Give two folders each other's names; both names are there at any instant on Linux."""
    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except (AttributeError, OSError):
        rename = None
    here, swap = -100, 2  # AT_FDCWD, RENAME_EXCHANGE
    if rename is None or rename(here, os.fsencode(new), here, os.fsencode(old), swap):
        aside = new.with_name(f"{new.name}.old")
        old.rename(aside)
        new.rename(old)
        aside.rename(new)


def flush_below(folder: Path) -> None:
    """Have all files of a folder, and the folders in it, on the disk."""
    for place, _, names in os.walk(folder):
        for name in names:
            with suppress(PermissionError), open(os.path.join(place, name), "rb") as file:
                os.fsync(file.fileno())
        flush_folder(Path(place))


def flush_folder(folder: Path) -> None:
    """Have the names in a folder on the disk; not all file systems know how."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
