"""The compiled module, where it is built, and the tensors that it takes.

Rendering needs it and says so; networks and similarity have an equal in plain torch.
"""

import shlex
import sys
from pathlib import Path
from typing import Any, NoReturn

import torch
from torch import Tensor

from evsplat.errors import BackendError


class MissingFunctionError(BackendError, AttributeError):
    """The compiled module lacks a function; also what `hasattr` takes for a no."""


native: Any = None
import_error: ImportError | None = None
try:
    from evsplat import _native as native
except ImportError as error:
    import_error = error

_CHECKOUT = Path(__file__).resolve().parents[2]
"""Where the sources lie, in ``src/evsplat`` and ``native``; elsewhere if they were installed."""
_OTHER_ARGUMENTS = "incompatible function arguments"
"""How nanobind refuses a call."""


def native_for(user: str) -> Any:
    """The compiled module, which ``user`` needs; a `BackendError` says so where it is missing."""
    if native is None:
        raise BackendError(
            f"{user} needs evsplat's compiled module, which cannot be loaded ({import_error}); "
            "install evsplat again."
        )
    return native


def runs_native(tensor: Tensor) -> bool:
    """Whether the compiled module is there and takes this tensor: float32 on the CPU."""
    return native is not None and tensor.dtype == torch.float32 and tensor.device.type == "cpu"


def keep_freed_memory() -> None:
    """Let this process keep memory that tensors free, up to 512 MB, for those that come next.

    Each step asks for the sizes of the one before it. glibc, whose allocator PyTorch uses on the
    CPU, gives them back to the system meanwhile, which then hands over, and clears, page after
    page. Where there is another C library nothing is done.
    """
    if native is not None:
        native.keep_freed_memory()


def older_module(error: BaseException) -> BackendError | None:
    """What to say of an error that a compiled module makes which is older than its sources.

    A checkout that was pulled and not installed again calls what the module has not, or with other
    arguments; the latter may be a fault of the sources as well, if it was built after them.
    """
    if isinstance(error, AttributeError):
        owner = error.obj if isinstance(error.obj, type) else type(error.obj)
        found = owner.__module__ == "evsplat._native"
    else:
        found = isinstance(error, TypeError) and _OTHER_ARGUMENTS in str(error) and _built_before()
    return BackendError(_older(str(error).partition("\n")[0])) if found else None


def _missing(name: str) -> NoReturn:
    """The module's ``__getattr__``, which Python asks only for what is not there."""
    if name.startswith("_"):  # asked for by import, inspect and the like
        raise AttributeError(f"module 'evsplat._native' has no attribute {name!r}", name=name)
    raise MissingFunctionError(_older(f"it has no {name}"))


if native is not None:
    native.__getattr__ = _missing


def _older(found: str) -> str:
    again = "install evsplat again."
    if (_CHECKOUT / "native").is_dir():
        install = [sys.executable, "-m", "pip", "install", "-e", str(_CHECKOUT)]
        again = f"build it anew: {shlex.join(install)}"
    return (
        f"{native.__file__}: evsplat's compiled module is older than the sources that call it "
        f"({found}); {again}"
    )


def _built_before() -> bool:
    """Whether a source of the module, where they are at hand, was written after it."""
    built = Path(native.__file__).stat().st_mtime
    return any(path.stat().st_mtime > built for path in (_CHECKOUT / "native").glob("*"))
