"""The compiled module, where it is built, and the tensors that it takes.

Rendering needs it and says so; networks and similarity have an equal in plain torch.
"""

from typing import Any

import torch
from torch import Tensor

from evsplat.errors import BackendError

native: Any = None
import_error: ImportError | None = None
try:
    from evsplat import _native as native
except ImportError as error:
    import_error = error


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
