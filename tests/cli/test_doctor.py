"""What `evsplat doctor` reports."""

import importlib
import json
from importlib.metadata import PackageNotFoundError

import pytest
import torch

from evsplat import cuda_support
from evsplat.cli import main

doctor = importlib.import_module("evsplat.cli.doctor")
EXPECTED = {
    "evsplat",
    "python",
    "torch",
    "native rasteriser",
    "NVIDIA driver",
    "torch with CUDA",
    "gsplat",
    "CUDA compiler",
    "video (PyAV)",
    "demo capture",
    "viewer",
    "SMPL bodies",
    "optical flow",
    "Super SloMo",
    "NAFNet",
    "MPRNet",
    "EFNet",
    "D2Net",
    "E2VID",
    "PIE-Net",
    "event recordings",
    "ST-LPIPS",
    "LPIPS alex",
    "LPIPS vgg",
    "RVM masks",
}


def test_json_has_every_check_with_status_and_detail(capsys):
    assert main(["doctor", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert set(found) == EXPECTED
    for name, check in found.items():
        assert check["name"] == name
        assert check["status"] in ("ok", "missing", "optional")
        assert check["detail"]
        if check["status"] == "missing":
            assert check["remedy"] or "reinstall" in check["detail"]
    assert found["torch"]["detail"].startswith(torch.__version__)
    assert found["native rasteriser"]["status"] == "ok"


def test_one_line_per_check_under_what_it_found_and_the_verdict_last(capsys, monkeypatch):
    checks = [
        doctor.Check("a network", "optional", "no weights.", "Fetch them."),
        doctor.Check("python", "ok", "3.11"),
    ]
    monkeypatch.setattr(doctor, "run_checks", lambda: iter(checks))
    assert main(["doctor"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "there:",
        "  python     3.11",
        "optional, not there:",
        "  a network  no weights. Fetch them.",
        "ready: yes",
    ]
    checks.append(doctor.Check("torch", "missing", "No module.", "Get it."))
    assert main(["doctor"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == ["missing:", "  torch      No module. Get it."]
    assert lines[-1] == "ready: no, for want of torch"


def test_missing_native_module_and_video_name_their_remedy(capsys, monkeypatch):
    real = importlib.import_module

    def without(name, *rest):
        if name in ("evsplat._native", "av"):
            raise ImportError(f"No module named '{name}'")
        return real(name, *rest)

    monkeypatch.setattr(doctor, "import_module", without)
    assert main(["doctor", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["native rasteriser"]["status"] == "missing"
    assert "compiler" in found["native rasteriser"]["remedy"]
    assert found["video (PyAV)"]["status"] == "missing"
    assert "pip install av" in found["video (PyAV)"]["remedy"]


def test_each_thing_that_cuda_lacks_is_one_sentence_with_its_remedy(monkeypatch):
    def gone(*_):
        raise OSError

    def not_installed(name):
        raise PackageNotFoundError(name)

    monkeypatch.setattr(cuda_support.ctypes, "CDLL", gone)
    monkeypatch.setattr(cuda_support, "version", not_installed)
    monkeypatch.setattr(cuda_support, "find_spec", lambda name: None)
    monkeypatch.setattr(cuda_support, "_tools", lambda: {"nvcc": False, "ninja": False, "g++": 1})
    monkeypatch.setattr(torch.version, "cuda", None)
    needs = {need.name: need for need in cuda_support.needs()}
    expected = {
        "NVIDIA driver": ("libcuda", "driver"),
        "torch with CUDA": ("without CUDA", "pytorch.org"),
        "gsplat": ("not installed", "pip install 'evsplat[cuda]'"),
        "CUDA compiler": ("nvcc and ninja not found", "pip install ninja"),
    }
    assert set(needs) == set(expected)
    for name, (detail, remedy) in expected.items():
        need = needs[name]
        assert not need.there and detail in need.detail and remedy in need.remedy
        assert need.detail.endswith(".") and ". " not in need.detail
    assert cuda_support.what_is_missing().startswith("NVIDIA driver: no libcuda.so.1")


def test_an_old_gpu_and_an_old_gsplat_are_told(monkeypatch):
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "Quadro P1000")
    monkeypatch.setattr(cuda_support, "version", lambda name: "1.4.0+pt24cu124")
    for capability, there in (((6, 1), False), ((9, 0), True)):
        monkeypatch.setattr(torch.cuda, "get_device_capability", lambda c=capability: c)
        need = cuda_support._torch()
        assert need.there is there and f"{capability[0]}.{capability[1]}" in need.detail
    assert not cuda_support._gsplat().there
    monkeypatch.setattr(cuda_support, "version", lambda name: "1.5.3+pt26cu130")
    assert cuda_support._gsplat().there
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert "finds no usable GPU" in cuda_support._torch().detail


def test_smpl_files_are_not_said_to_be_where_nothing_is(monkeypatch, tmp_path):
    monkeypatch.setattr(doctor, "_version", lambda name: "0.26")
    monkeypatch.setenv("EVSPLAT_BODY_MODELS", str(tmp_path))
    assert doctor._body_models() == doctor.Check(
        "SMPL bodies", "ok", f"body-models 0.26, files in {tmp_path}"
    )
    monkeypatch.setenv("EVSPLAT_BODY_MODELS", str(tmp_path / "gone"))
    found = doctor._body_models()
    assert found.status == "optional" and f"{tmp_path / 'gone'}, which is not there" in found.detail


@pytest.mark.parametrize("gone", [(), ("viser",), ("msgspec", "websockets")])
def test_a_viewer_without_its_packages_is_told_with_those_that_are_absent(monkeypatch, gone):
    monkeypatch.setattr(doctor, "find_spec", lambda name: None if name in gone else name)
    (found,) = (check for check in doctor.run_checks() if check.name == "viewer")
    assert (found.status, bool(found.remedy)) == (("optional", True) if gone else ("ok", False))
    assert ", ".join(gone) in found.detail and "evsplat[view]" in found.remedy or not gone
