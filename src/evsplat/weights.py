"""Weight files of pretrained networks: found, never downloaded; read, never unpickled."""

import hashlib
import zipfile
from pathlib import Path
from typing import Any

import torch

from evsplat.errors import WeightsError


class MissingWeights(WeightsError):
    """Nobody has put the weights where they are looked for; the message says where to get them."""


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def read_state(path: Path) -> dict[str, Any]:
    """A state dict read without running anything that the file may contain."""
    try:
        state = torch.load(
            path, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(path)
        )
    except Exception as error:  # torch raises many kinds for files that are not its own
        raise WeightsError(f"{path}: not a readable PyTorch weight file ({error}).") from error
    if not isinstance(state, dict):
        raise WeightsError(f"{path}: holds a {type(state).__name__}, expected a state dict.")
    return state


def hub_folder() -> Path:
    """Where torch keeps downloaded weights, and where evsplat looks for those of others."""
    return Path(torch.hub.get_dir()) / "checkpoints"


def home_as_tilde(path: Path) -> str:
    """The path as people write it."""
    home = Path.home()
    return f"~/{path.relative_to(home)}" if path.is_relative_to(home) else str(path)
