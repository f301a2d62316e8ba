"""Files of torch (.pt, .pth) and of safetensors."""

import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from evsplat.disk import uninterrupted
from evsplat.untrusted.faults import BROKEN, ordinary_file
from evsplat.untrusted.sizes import open_zip


def load_torch(source: Path | IO[bytes]) -> Any:
    """What torch.save wrote, nothing of it run; an `Exception` of nearly any kind where it is not.

    Large archives are mapped, not copied.
    """
    if isinstance(source, Path):
        ordinary_file(source)
    packed = isinstance(source, Path) and zipfile.is_zipfile(source)
    if packed:
        open_zip(str(source)).close()
    return torch.load(source, map_location="cpu", weights_only=True, mmap=packed)


def read_safetensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and texts of a file of safetensors; a `ValueError` where it is none."""
    ordinary_file(path)
    try:
        # torch calls its storage's Python and says of any error there that the shape is unknown.
        with (
            _in_utf8(path) as name,
            uninterrupted(),
            safe_open(name, framework="pt") as file,
        ):
            tensors = {name: file.get_tensor(name) for name in file.keys()}
            return tensors, file.metadata() or {}
    except (*BROKEN, SafetensorError) as error:
        raise ValueError(str(error)) from None


@contextmanager
def _in_utf8(path: Path) -> Iterator[Path]:
    """A name of the file that is UTF-8: safetensors opens no other, a disk may have any."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        with path.open("rb") as file:
            yield Path(f"/dev/fd/{file.fileno()}")
    else:
        yield path
