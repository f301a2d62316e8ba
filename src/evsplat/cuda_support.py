"""What computing on an NVIDIA GPU needs, and what of it is missing, in one sentence each.

Nothing is built and no package is imported but torch, so that `evsplat doctor` can always look.
"""

import ctypes
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

GSPLAT = "1.5.3"
"""The oldest version whose kernels follow the rules of `evsplat.render`."""
CAPABILITY = (7, 0)
"""Oldest compute capability that gsplat's kernels compile for."""


@dataclass(frozen=True)
class Need:
    """One thing that the GPU backend needs."""

    name: str
    there: bool
    detail: str
    """What was found, in words, or what is missing, in one sentence."""
    remedy: str = ""


def needs() -> Iterator[Need]:
    """Driver, PyTorch with CUDA, gsplat and the means to build its kernels, in that order."""
    yield _driver()
    yield _torch()
    yield _gsplat()
    yield _compiler()


def what_is_missing() -> str | None:
    """The first thing that keeps this machine from computing on a GPU, with its remedy."""
    for need in needs():
        if not need.there:
            return f"{need.name}: {need.detail} {need.remedy}".rstrip()
    return None


def _driver() -> Need:
    name = "NVIDIA driver"
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return Need(name, False, "no libcuda.so.1 on this machine.", "Install NVIDIA's driver.")
    return Need(name, True, "libcuda.so.1 loads")


def _torch() -> Need:
    name = "torch with CUDA"
    try:
        torch = import_module("torch")
    except ImportError as error:
        return Need(name, False, f"{error}.", "Get it with: pip install 'torch>=2.11'.")
    if torch.version.cuda is None:
        return Need(
            name,
            False,
            f"torch {torch.__version__} is a build without CUDA.",
            "Install the CUDA build that https://pytorch.org/get-started names for your driver.",
        )
    built = f"torch {torch.__version__} is built for CUDA {torch.version.cuda}"
    if not torch.cuda.is_available():
        remedy = "Check with nvidia-smi that the driver is at least as new as that CUDA."
        return Need(name, False, f"{built}, but finds no usable GPU.", remedy)
    gpu, capability = torch.cuda.get_device_name(), torch.cuda.get_device_capability()
    detail = f"{built}, {gpu} of compute capability {capability[0]}.{capability[1]}"
    if capability < CAPABILITY:
        remedy = f"gsplat needs {CAPABILITY[0]}.{CAPABILITY[1]} (Volta) or newer: use the CPU."
        return Need(name, False, f"{detail}.", remedy)
    return Need(name, True, detail)


def _gsplat() -> Need:
    remedy = "Get it with: pip install 'evsplat[cuda]'."
    try:
        found = version("gsplat")
    except PackageNotFoundError:
        return Need("gsplat", False, "not installed.", remedy)
    if _numbers(found) < _numbers(GSPLAT):
        return Need("gsplat", False, f"{found} is older than {GSPLAT}.", remedy)
    return Need("gsplat", True, found)


def _compiler() -> Need:
    """Wheels with kernels carry ``csrc``; all others build them at first use."""
    name = "CUDA compiler"
    spec = find_spec("gsplat")
    folder = Path(spec.origin).parent if spec is not None and spec.origin else None
    if folder is not None and any(folder.glob("csrc*.so")):
        return Need(name, True, "not needed, gsplat came with its kernels built")
    lacking = [tool for tool, there in _tools().items() if not there]
    if lacking:
        return Need(
            name,
            False,
            f"{' and '.join(lacking)} not found, with which gsplat builds its kernels once.",
            "Install the CUDA toolkit of torch's CUDA version (set CUDA_HOME if it lies elsewhere "
            "than /usr/local/cuda), g++ and: pip install ninja.",
        )
    return Need(name, True, "nvcc, ninja and g++ are there; gsplat builds its kernels once")


def _tools() -> dict[str, bool]:
    homes = [os.environ.get(key) for key in ("CUDA_HOME", "CUDA_PATH")] + ["/usr/local/cuda"]
    nvcc = any((Path(home) / "bin" / "nvcc").is_file() for home in homes if home)
    return {
        "nvcc": nvcc or shutil.which("nvcc") is not None,
        "ninja": shutil.which("ninja") is not None or find_spec("ninja") is not None,
        "g++": shutil.which(os.environ.get("CXX", "g++")) is not None,
    }


def _numbers(text: str) -> tuple[int, ...]:
    """The leading numbers of a version: '1.5.3+pt26cu124' -> (1, 5, 3)."""
    numbers = []
    for part in text.split("+")[0].split("."):
        if not part.isdecimal():
            break
        numbers.append(int(part))
    return tuple(numbers)
