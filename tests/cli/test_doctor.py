"""What `evsplat doctor` reports."""

import importlib
import json

import torch

from evsplat.cli import main

doctor = importlib.import_module("evsplat.cli.doctor")
EXPECTED = {
    "evsplat",
    "python",
    "torch",
    "native rasteriser",
    "CUDA",
    "gsplat",
    "video (PyAV)",
    "demo capture",
    "SMPL bodies",
    "ST-LPIPS",
    "LPIPS alex",
    "LPIPS vgg",
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


def test_one_line_per_check(capsys):
    assert main(["doctor"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(EXPECTED)
    for line, name in zip(lines, [check.name for check in doctor.run_checks()], strict=True):
        assert line.startswith(name)


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
