"""What README and docs tell users to type works as written."""

import json
import re
import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest

import evsplat
from evsplat.cli import main
from evsplat.events import EventStore, EventStream, read_events, write_events

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
FORMAT = ROOT / "docs" / "capture-format.md"
pytestmark = pytest.mark.skipif(not README.exists(), reason="not a source checkout")


def _blocks(path: Path, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", path.read_text(encoding="utf-8"), re.DOTALL)


def _commands() -> list[list[str]]:
    lines = "\n".join(_blocks(README, "sh")).splitlines()
    return [shlex.split(line, comments=True)[1:] for line in lines if line.startswith("evsplat ")]


@pytest.mark.parametrize("arguments", _commands() if README.exists() else [], ids=" ".join)
def test_readme_commands_have_only_known_options(arguments, capsys, tmp_path, monkeypatch):
    # Paths do not exist here: the command must be understood and then miss its input.
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    stdout, stderr = capsys.readouterr()
    assert any(path in stdout + stderr for path in ("runs/mine", "my_capture", "clip.mp4"))
    assert "Unrecognized" not in stderr


def test_events_of_another_sensor_are_moved_as_the_guide_says(rng, tmp_path, monkeypatch):
    seed = int(rng.integers(10_000))
    rng = np.random.default_rng(seed)
    x, y = rng.integers(0, 1280, 3_000), rng.integers(0, 720, 3_000)
    stream = EventStream(
        np.arange(3_000), x.astype(np.uint16), y.astype(np.uint16), np.ones(3_000, np.int8)
    )
    H = np.array([[0.6, 0.01, -8.0], [-0.02, 0.62, 15.0], [1e-5, -2e-5, 1.0]])
    H[:2] += rng.normal(0, 0.005, (2, 3))
    (tmp_path / "rec").mkdir()
    write_events(tmp_path / "rec/events.raw", [stream], width=1280, height=720)
    monkeypatch.chdir(tmp_path)
    guide = (FORMAT.parent / "event-formats.md").read_text(encoding="utf-8")
    guide = guide.split("## Events into the pixels of the pictures")[1].split("\n## ")[0]
    finding, moving = re.findall(r"```python\n(.*?)```", guide, re.DOTALL)
    corners = rng.uniform(0, 700, (40, 2))
    seen_corners = cv2.perspectiveTransform(corners[None], H)[0]
    exec(finding, {"in_events": corners, "in_pictures": seen_corners})
    H = np.loadtxt("homography.txt")
    command = re.search("    evsplat (convert rec/events.raw .*)", guide)
    assert command and main(shlex.split(command[1])) == 0
    there = cv2.perspectiveTransform(np.stack([x, y], -1)[None].astype(float), H)[0]
    seen = ((there > -0.5) & (there < (719.5, 539.5))).all(-1)
    by_command = read_events("moved.h5")
    exec(moving, {})
    for written in (by_command, read_events("moved.h5")):
        assert np.array_equal(written.t, stream.t[seen])
        assert np.abs(np.stack([written.x, written.y], -1) - there[seen]).max() < 0.5001


def test_every_picture_of_the_docs_is_on_a_page():
    pages = [README, *FORMAT.parent.rglob("*.md")]
    shown = "".join(page.read_text(encoding="utf-8") for page in pages)
    pictures = [path.name for path in (FORMAT.parent / "images").iterdir()]
    assert pictures
    assert [name for name in pictures if f"images/{name}" not in shown] == []


def test_readme_python_uses_what_the_package_has():
    used = set(re.findall(r"\bev\.(\w+)", "\n".join(_blocks(README, "python"))))
    assert used and used <= set(evsplat.__all__)


def test_event_file_written_as_documented_is_read_back(tmp_path, monkeypatch):
    rng = np.random.default_rng(3)
    count = 5000
    t = rng.integers(0, 30_000, count)
    x, y, p = (rng.integers(0, high, count) for high in (64, 48, 2))
    monkeypatch.chdir(tmp_path)
    code = next(block for block in _blocks(FORMAT, "python") if "events.h5" in block)
    exec(code, {"t": t, "x": x, "y": y, "p": p})
    store = EventStore(tmp_path / "events.h5", 64, 48, 0)
    assert len(store) == count
    inside = store.between(7_300, 11_900)
    chosen = (t >= 7_300) & (t < 11_900)
    assert len(inside) == chosen.sum()
    assert np.array_equal(inside.t, np.sort(t[chosen]))
    assert int(inside.p.sum()) == int((2 * p[chosen] - 1).sum())


def test_documented_capture_json_names_every_key_of_the_format():
    document = json.loads(_blocks(FORMAT, "json")[0])
    assert document["format"] == "evsplat-capture"
    assert document["version"] == 1
    assert {"name", "cameras", "frames", "novel_views", "body", "events", "provenance"} <= set(
        document
    )
