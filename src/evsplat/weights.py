"""Weight files of pretrained networks: found, never downloaded; read, never unpickled."""

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from evsplat.errors import WeightsError
from evsplat.untrusted.faults import open_bytes, ordinary_file
from evsplat.untrusted.tensors import load_torch


class MissingWeights(WeightsError):
    """Nobody has put the weights where they are looked for; the message says where to get them."""


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    with open_bytes(path, error=WeightsError) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def read_state(path: Path) -> dict[str, Any]:
    """A state dict read without running anything that the file may contain."""
    ordinary_file(path, error=WeightsError)
    try:
        state = load_torch(path)
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


@dataclass(frozen=True)
class WeightFile:
    """A published weight file: what it is called, how large it is and where people get it."""

    network: str
    """What needs it, as the sentence about its absence begins."""
    name: str
    size: str
    source: str
    """Where to get it, to be read after "get it"."""
    variable: str
    """Environment variable with its place."""

    def find(self, given: Path | str | None = None) -> Path:
        """The file as given, from the environment variable or in torch's hub folder.

        Raises `MissingWeights`, with where to get it, where it is not there.
        """
        named = given or os.environ.get(self.variable)
        path = Path(named or hub_folder() / self.name).expanduser()
        if path.is_file():
            return path
        raise MissingWeights(
            f"{home_as_tilde(path)}: file not found. {self.network} needs {self.name} "
            f"({self.size}): get it {self.source} and put it there, or give its place with "
            f"{self.variable}, or --weights of the commands that have it."
        )


def state_under(path: Path, keys: tuple[str, ...]) -> dict[str, Tensor]:
    """The tensors of a checkpoint that keeps them under one of ``keys``, or bare.

    The prefix that training on several GPUs puts before every name is taken off.
    """
    state = read_state(path)
    for key in keys:
        if isinstance(state.get(key), Mapping):
            state = state[key]
            break
    return {name.removeprefix("module."): value for name, value in named_tensors(state).items()}


def named_tensors(state: Mapping[Any, Any]) -> dict[str, Tensor]:
    """The tensors that have a name, which is all that a network takes of a checkpoint."""
    return {
        name: value
        for name, value in state.items()
        if isinstance(name, str) and isinstance(value, Tensor)
    }


def fill(
    network: nn.Module, state: Mapping[str, Tensor], path: Path, *, what: str, part: str = ""
) -> nn.Module:
    """Put all of ``state`` into a network, ready for inference; no name or shape may differ.

    ``part`` is what the file puts before the names, ``what`` it should be in the message of the
    `WeightsError`.
    """
    expected = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    found = {name: tuple(value.shape) for name, value in state.items()}
    for name in sorted(expected.keys() | found.keys()):
        if expected.get(name) != found.get(name):
            raise WeightsError(
                f"{path}: {part}{name}: expected {expected.get(name, 'nothing')}, found "
                f"{found.get(name, 'nothing')}; this is not {what}."
            )
    network.load_state_dict(state)
    return network.eval().requires_grad_(False)
