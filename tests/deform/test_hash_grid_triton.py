"""The Triton kernels: interpreted on the CPU, compiled for GPUs that need not be there, and run."""

import importlib.util
import sys
from copy import deepcopy

import pytest
import torch

from evsplat.deform import HashGridEncoding, encodings

pytest.importorskip("triton", reason="Triton comes with PyTorch's CUDA builds for Linux")
NAME = "evsplat.deform.hash_grid_triton"


def kernels(monkeypatch, *, interpreted):
    """The module anew: Triton decides at its import whether kernels are compiled."""
    monkeypatch.setenv("TRITON_INTERPRET", "1" if interpreted else "0")
    spec = importlib.util.find_spec(NAME)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, NAME, module)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(params=["interpreted", "gpu"])
def device(request, monkeypatch):
    """Where the kernels run; `HashGridEncoding` takes them."""
    if request.param == "gpu":
        if not torch.cuda.is_available():
            pytest.skip("needs an NVIDIA GPU")
        return "cuda"
    kernels(monkeypatch, interpreted=True)
    monkeypatch.setattr(encodings, "_runs_triton", lambda tensor: tensor.dtype == torch.float32)
    return "cpu"


@pytest.mark.parametrize(("seed", "features", "points"), [(0, 2, 200), (1, 3, 16)])
def test_values_and_gradients_equal_those_in_float64(seed, features, points, device):
    torch.manual_seed(seed)
    grid = HashGridEncoding(levels=5, features=features, log2_table=9, finest=700)
    torch.nn.init.normal_(grid.table)
    # Few bits, so that float32 finds the same cell on every level; the slope jumps between cells.
    positions = (torch.randint(-200, 4300, (points, 3)) + 0.5) / 4096
    positions[0], positions[1] = 0.0, 1.0
    upstream = torch.randn(points, grid.dim)
    results = []
    for where, dtype in ((device, torch.float32), ("cpu", torch.float64)):
        copy = deepcopy(grid).to(where, dtype)
        here = positions.to(where, dtype).requires_grad_()
        encoded = copy(here)
        gradients = torch.autograd.grad(encoded, (here, copy.table), upstream.to(encoded))
        results.append([value.cpu().double() for value in (encoded, *gradients)])
    for name, value, expected in zip(("encoding", "positions", "table"), *results, strict=True):
        error = ((value - expected).norm() / expected.norm()).item()
        assert error < 1e-6, (name, error)


def test_gradients_of_one_input_do_not_need_the_other(device):
    grid = HashGridEncoding(levels=2, log2_table=6, base=2, finest=4).to(device)
    grid(torch.rand(4, 3, device=device)).sum().backward()
    assert grid.table.grad.abs().sum() > 0
    grid.table.requires_grad_(False)
    positions = torch.rand(4, 3, device=device, requires_grad=True)
    grid(positions).sum().backward()
    assert positions.grad is not None
    assert grid(torch.zeros(0, 3, device=device)).shape == (0, grid.dim)


def test_positions_that_are_no_number_stay_inside_the_table(device):
    grid = HashGridEncoding(levels=3, log2_table=9, finest=64).to(device)
    broken = torch.tensor([[float("nan"), 0.5, 0.5], [0.5, 0.5, 0.5]], device=device)
    encoded = grid(broken)
    assert encoded[0].isnan().all() and encoded[1].isfinite().all()


@pytest.mark.parametrize("capability", [70, 90])
def test_kernels_compile_for_gpus_that_are_not_here(capability, monkeypatch):
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource, compile

    module = kernels(monkeypatch, interpreted=False)
    pointers = {"layout": "*i32"}
    constants = {"FEATURES": 2, "POINTS": 128, "OF_TABLE": True, "OF_POSITIONS": True}
    for kernel in (module._encode, module._encode_backward):
        signature = {
            name: "constexpr"
            if name in constants
            else "i32"
            if name in ("count", "mask")
            else pointers.get(name, "*fp32")
            for name in kernel.arg_names
        }
        source = ASTSource(
            kernel,
            signature,
            {name: constants[name] for name in kernel.arg_names if name.isupper()},
        )
        built = compile(source, target=GPUTarget("cuda", capability, 32))
        assert "ptx" in built.asm and len(built.asm["cubin"]) > 0
