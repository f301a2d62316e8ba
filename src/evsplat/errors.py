"""The exceptions that a user may meet; each message is one sentence that says what to do."""

import errno
import sys
from pathlib import Path


class EvsplatError(Exception):
    """The input's or the machine's fault; the command line prints it and exits with 2."""

    def __init__(self, message: str) -> None:
        """``message`` may quote what was read: half a surrogate pair can be written nowhere."""
        super().__init__(message.encode("utf-8", "backslashreplace").decode())


class DataError(EvsplatError):
    """A capture, event file or run folder is not what it should be."""


class HeldOutError(EvsplatError):
    """A training asked for what its policy hides from it."""


class ConfigError(EvsplatError):
    """A configuration value or option is unknown or out of range."""


class WeightsError(EvsplatError):
    """Weights of a pretrained network are missing or do not fit."""


class BackendError(EvsplatError):
    """A backend or device that was asked for cannot run here."""


class OutputError(EvsplatError):
    """A file or folder cannot be written: no room, no permission, something in the way."""

    def __init__(self, message: str, *, no_room: bool = False) -> None:
        """``no_room``: more room on the disk would help."""
        super().__init__(message)
        self.no_room = no_room


TRACEBACK = "evsplat-traceback-"
"""How names begin of files with what nobody expected of a machine."""


class MachineError(EvsplatError):
    """Memory, disk or system failed where nobody expected it; `__cause__` is what they said."""

    def __init__(self, message: str, folder: Path | None = None) -> None:
        """``folder`` is where to keep the traceback; None: with temporary files."""
        super().__init__(message)
        self.folder = folder


NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""What the system says where a disk, a share of it or the size of a file is used up."""
_WRITING = (*NO_ROOM, errno.EROFS)


def only_writing_says(error: OSError) -> bool:
    """Whether it was a write that failed: nothing that is read says so."""
    return error.errno in _WRITING


def why_not_written(error: OSError) -> str:
    """What keeps a file from being written and what to do, in words that follow its path."""
    match error.errno:
        case errno.ENOSPC | errno.EDQUOT:
            return "not written, the disk is full; make room there or write elsewhere"
        case errno.EFBIG:
            return "not written, files may not grow so large here; raise the limit (ulimit -f)"
        case errno.EACCES | errno.EPERM:
            return "may not be written; give yourself the permission or write elsewhere"
        case errno.EROFS:
            return "lies on a disk that is read-only; write elsewhere"
        case errno.ENAMETOOLONG:
            return "the name is too long for this disk; choose a shorter one"
        case errno.ENOTDIR | errno.EEXIST:
            return "a file is where a folder is needed; write elsewhere"
        case _:
            return f"cannot be written ({error.strerror or error}); write elsewhere"


def machine_error(
    error: BaseException, kept: str = "", folder: Path | None = None
) -> MachineError | None:
    """What a failure of memory, disk or system is to the user; None for any other exception.

    ``kept`` is a sentence about what is kept and how to go on.
    """
    said = _words(error)
    return None if said is None else MachineError(f"{said} {kept}".strip(), folder)


def _words(error: BaseException) -> str | None:
    detail = " ".join(str(error).split())[:300]
    if isinstance(error, OSError):
        path = f"{error.filename}: " if error.filename else ""
        if only_writing_says(error):
            return f"{path}{why_not_written(error)}."
        return f"{path}{error.strerror or detail or type(error).__name__}."
    if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and _is_memory(error)):
        return (
            f"Memory is full ({detail or 'no more to be had'}); close other programs, or ask for "
            "less: smaller pictures, fewer frames."
        )
    if isinstance(error, ImportError) and "failed to map segment" in str(error):
        return f"Memory is full ({detail}); close other programs, or raise the limit (ulimit -v)."
    # Named only where it has been imported, which takes time.
    tensors = sys.modules.get("safetensors")
    if tensors is not None and isinstance(error, tensors.SafetensorError):
        return f"A file of tensors cannot be read or written ({detail})."
    return None


def _is_memory(error: RuntimeError) -> bool:
    """Whether an allocator of torch gave up, which has no exception of its own on the CPU."""
    words = "not enough memory", "can't allocate memory", "out of memory", "alloc_cpu"
    return any(word in str(error) for word in words)
