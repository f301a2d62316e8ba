"""Tensors on a device: sending them without waiting, keeping recorded data there; what it is."""

import functools
import os
import platform
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from evsplat.errors import BackendError, ConfigError


def send(tensor: Tensor, device: torch.device | str) -> Tensor:
    """``tensor`` on ``device``; the host does not wait for the copy.

    A plain ``.to`` of pageable memory makes the host wait until the device has done all its work so
    far. Pinned memory stays reserved until the copy is made, so the caller need not keep anything.
    """
    device = torch.device(device)
    if tensor.device.type != "cpu" or device.type == "cpu":
        return tensor.to(device)
    if device.type == "cuda" and not tensor.requires_grad:
        tensor = tensor.pin_memory()
    return tensor.to(device, non_blocking=True)


def constant(values: Sequence[Any], like: Tensor) -> Tensor:
    """Numbers, which may be nested, as a tensor of the kind and on the device of ``like``.

    Not to be written to: it is made once, and sent once.
    """
    return kept_constant(_frozen(values), like.device, like.dtype)


@functools.lru_cache(maxsize=64)
def kept_constant(values: tuple[Any, ...], device: torch.device, dtype: torch.dtype) -> Tensor:
    """`constant`, by device and kind."""
    return send(torch.tensor(values, dtype=torch.float64).to(dtype), device)


def _frozen(values: Any) -> Any:
    return tuple(map(_frozen, values)) if isinstance(values, Sequence) else values


def use_threads(count: int | None) -> None:
    """Let this process compute with ``count`` CPU threads; None: as many as it would by itself.

    Threads of Python that draw, as the viewer's, take the number that was set last.
    """
    if count is not None:
        torch.set_num_threads(count)


def network_device(asked: str) -> torch.device:
    """Where a network of plain PyTorch runs; unlike rendering it needs no kernels of others."""
    if asked not in ("auto", "cpu", "cuda"):
        raise ConfigError(f"--device {asked}: expected auto, cpu or cuda.")
    there = torch.cuda.is_available()
    if asked == "cuda" and not there:
        raise BackendError(
            f"--device cuda: torch {torch.__version__} finds no usable GPU (`evsplat doctor` says "
            "what it lacks); compute with --device cpu."
        )
    return torch.device("cpu" if asked == "cpu" or not there else "cuda")


def default_cache_bytes(device: torch.device) -> int:
    """A quarter of what is free on the device now."""
    return torch.cuda.mem_get_info(device)[0] // 4 if device.type == "cuda" else 0


class DeviceCache:
    """Recorded data on a device: the most recently used stay there, up to a bound in bytes.

    What is not there is made by one background thread, in pinned memory, and copied on a stream of
    its own: asked for a step ahead with `prefetch`, it is there when `get` wants it. On the CPU
    nothing is kept or copied, since whoever makes the data has a cache of its own.
    """

    def __init__(self, device: torch.device | str, limit_bytes: int) -> None:
        """The latest value always stays, however small the limit."""
        self.device, self.limit_bytes = torch.device(device), limit_bytes
        self.bytes = 0
        self._kept: OrderedDict[Hashable, Tensor] = OrderedDict()
        self._coming: dict[Hashable, Future[tuple[Tensor, torch.cuda.Event | None]]] = {}
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="device-cache")
        self._stream = torch.cuda.Stream(self.device) if self.device.type == "cuda" else None

    def prefetch(self, key: Hashable, make: Callable[[], Tensor]) -> None:
        """Start to bring ``make()`` to the device, unless it is there or on its way."""
        if self.device.type != "cpu" and key not in self._kept and key not in self._coming:
            self._coming[key] = self._worker.submit(self._load, make)

    def get(self, key: Hashable, make: Callable[[], Tensor]) -> Tensor:
        """``make()`` on the device; not to be written to."""
        if self.device.type == "cpu":
            return make()
        self.prefetch(key, make)
        if key in self._coming:
            tensor, copied = self._coming.pop(key).result()
            if copied is not None:
                torch.cuda.current_stream(self.device).wait_event(copied)
            self._keep(key, tensor)
        self._kept.move_to_end(key)
        tensor = self._kept[key]
        if self._stream is not None:
            # Else its memory could be used again on the copying stream while this one reads.
            tensor.record_stream(torch.cuda.current_stream(self.device))
        return tensor

    def _keep(self, key: Hashable, tensor: Tensor) -> None:
        self._kept[key] = tensor
        self.bytes += tensor.nbytes
        while self.bytes > self.limit_bytes and len(self._kept) > 1:
            self.bytes -= self._kept.popitem(last=False)[1].nbytes

    def _load(self, make: Callable[[], Tensor]) -> tuple[Tensor, torch.cuda.Event | None]:
        if self._stream is None:
            return send(make(), self.device), None
        with torch.cuda.stream(self._stream):
            tensor = send(make(), self.device)
            copied = torch.cuda.Event()
            copied.record(self._stream)
        return tensor, copied


def hardware() -> dict[str, str | int | float]:
    """What this machine computes with, for the record: CPU, cores, memory, GPU where there is one.

    What the system does not tell is left out.
    """
    found: dict[str, str | int | float] = {"cpu_cores": os.cpu_count() or 1}
    processor = platform.processor()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        processor = next(
            (line.split(":")[1].strip() for line in lines if line.startswith("model name")),
            processor,
        )
    except OSError:
        pass
    if processor:
        found["cpu"] = processor
    try:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        found["memory_gb"] = round(memory / 1e9, 1)
    except (ValueError, OSError):
        pass
    if torch.cuda.is_available():
        found["gpu"] = torch.cuda.get_device_name()
    return found
