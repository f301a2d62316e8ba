"""Scripts beside the package, which no other test runs, fit the package as it is."""

import re
import runpy
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCRIPTS = [
    path.relative_to(ROOT)
    for folder in ("benchmarks", "tools")
    for path in sorted((ROOT / folder).glob("*.py"))
    if "__main__" in path.read_text("utf-8")
]


@pytest.mark.parametrize("script", SCRIPTS, ids=str)
def test_every_script_finds_what_it_imports_and_explains_itself(script, monkeypatch, capsys):
    if script.name == "convert_blazepose.py":
        pytest.importorskip("tflite")
    monkeypatch.syspath_prepend(str(ROOT / script.parent))
    monkeypatch.setattr(sys, "argv", [str(script), "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(ROOT / script), run_name="__main__")
    assert ended.value.code == 0
    assert capsys.readouterr().out.startswith("usage: ")


def test_architecture_tells_what_each_of_them_is_of():
    page = (ROOT / "ARCHITECTURE.md").read_text("utf-8").partition("## Beside the package")[2]
    named = {
        name
        for cell in re.findall(r"\| ([^|]*`[^|]*) \|$", page, re.M)
        for name in re.findall("`(.+?)`", cell)
    }
    there = {
        path.stem for folder in ("benchmarks", "tools") for path in (ROOT / folder).glob("*.py")
    }
    assert named - {"browser/", "make_venv.sh", "benchmarks/", "tools/"} == there
