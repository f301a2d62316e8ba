"""benchmarks/convergence.py where nothing is left to train."""

import json
import sys
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))

import convergence  # noqa: E402


def write_point(folder: Path, steps: int, psnr_db: float) -> None:
    point = {"capture": "tiny", "method": "paper", "rates": "released", "steps": steps, "seed": 0}
    regions = ("full", "crop", "mask", "train_recorded_crop")
    point |= {f"{region}_psnr_db": psnr_db for region in regions}
    point |= {"train_s": 1.0, "train_cpu_s": 1.0, "threads": 1}
    folder.mkdir(exist_ok=True)
    (folder / f"tiny-paper-released-{steps:05d}-0.json").write_text(json.dumps(point))


def test_curves_are_drawn_where_all_was_trained_before(tiny_capture, tmp_path, monkeypatch, capsys):
    for steps, psnr_db in ((500, 20.0), (1000, 20.1)):
        write_point(tmp_path / "points", steps, psnr_db)
    out = tmp_path / "not" / "there"
    words = [tiny_capture(), "--methods", "paper", "--points", tmp_path / "points", "--out", out]
    monkeypatch.setattr(sys, "argv", ["convergence.py", *map(str, words)])
    convergence.main()
    knee = json.loads(capsys.readouterr().out.splitlines()[-1])["knees"]["tiny"]["paper"]
    assert knee["converged"] and knee["steps"] == 500
    assert Image.open(out / "convergence.png").size[0] > 0
