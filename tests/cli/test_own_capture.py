"""The commands of docs/own-capture.md work as they stand there, on tiny recordings.

A comment over a block, ``<!-- tests: WHAT ... -->``, says what is shortened here and why.
"""

import json
import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from evsplat import posing
from evsplat.capture import load_capture
from evsplat.cli import main
from evsplat.events import EventStream
from evsplat.importers import attach_poses
from evsplat.pictures.video import write_video

from ..conftest import EXPOSURE_US, PERIOD_US
from ..events.formats.encoders import aedat4, evt3
from ..events.formats.mutations import bag
from ..small_model import few_descent_steps, small

PAGE = Path(__file__).parents[2] / "docs" / "own-capture.md"
WIDTH, HEIGHT, FRAMES = 48, 32, 10
pytestmark = pytest.mark.skipif(not PAGE.exists(), reason="not a source checkout")


def blocks() -> list[tuple[set[str], list[list[str]]]]:
    """What is shortened in each block of the page, by its first word or words, and its commands."""
    text = PAGE.read_text(encoding="utf-8") if PAGE.exists() else ""
    found = re.findall(r"((?:<!-- tests: .*? -->\n)*)```(\w+)\n(.*?)```", text, re.DOTALL)
    assert {language for _, language, _ in found} <= {"sh"}, "only commands are run here"
    return [
        (
            set(re.findall(r"tests: ((?:import )?\S+) ", marks)),
            [
                shlex.split(line, comments=True)
                for line in commands.replace("\\\n", " ").splitlines()
            ],
        )
        for marks, _, commands in found
    ]


def write_recordings(folder: Path, tiny: Path) -> None:
    """Every file that the page's commands read, made of the tiny capture at ``tiny``."""
    capture = load_capture(tiny)
    assert capture.events is not None
    stream = capture.events.between(0, 1 << 40)
    pictures = [
        (capture.image(frame).numpy() * 255).round().astype(np.uint8) for frame in capture.frames
    ]
    write_video(folder / "clip.mp4", pictures, fps=25)
    starts = [frame.exposure_us[0] for frame in capture.frames]
    exposed = [
        (np.ascontiguousarray(picture), start, start + EXPOSURE_US)
        for picture, start in zip(pictures, starts, strict=True)
    ]
    (folder / "dance.aedat4").write_bytes(aedat4(stream, WIDTH, HEIGHT, exposed))
    (folder / "dance.bag").write_bytes(bag(stream, WIDTH, HEIGHT))
    document = json.loads((tiny / "capture.json").read_text())
    (folder / "camera.json").write_text(json.dumps(document["cameras"]["main"]))
    for parts in ("rec", "bag"):
        images = folder / parts / "images"
        images.mkdir(parents=True)
        for index, picture in enumerate(pictures):
            Image.fromarray(picture).save(images / f"{index:04d}.png")
    lines = "".join(f"{start} {start + EXPOSURE_US}\n" for start in starts)
    (folder / "bag" / "exposures.txt").write_text(lines)
    header = f"% evt 3.0\n% format EVT3;height={HEIGHT};width={WIDTH}\n"
    mirrored = replace(stream, x=(WIDTH - 1 - stream.x).astype(np.uint16))
    (folder / "rec" / "events.raw").write_bytes(evt3(mirrored, header))
    np.savetxt(folder / "homography.txt", [[-1, 0, WIDTH - 1], [0, 1, 0], [0, 0, 1]])
    write_tables(folder, stream, (stream.p > 0).astype(np.uint8))


def write_tables(folder: Path, stream: EventStream, on: np.ndarray) -> None:
    """CeleX's events as text: five columns of MMHPSD, and t, x, y, p."""
    v, u = 1279 - stream.x.astype(int), 799 - stream.y.astype(int)
    none = np.zeros_like(stream.t)
    rows = {
        "events.csv": (v, u, stream.t, none, none),
        "other.csv": (stream.t, stream.x, stream.y, on),
    }
    for name, columns in rows.items():
        np.savetxt(folder / name, np.stack(columns, axis=1).astype(np.int64), "%d", ",")


@pytest.fixture
def stand_ins(tiny_capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The page's files in the folder where commands run; gives what stood in for the long parts."""
    tiny = tiny_capture("made", width=WIDTH, height=HEIGHT, frames=FRAMES)
    place = tmp_path / "place"
    place.mkdir()
    write_recordings(place, tiny)
    used: list[str] = []

    def found(path, out, search, overwrite, **_):
        used.append("--find-poses")
        attach_poses(path, tiny / "body.npz", out, overwrite=overwrite)
        document = json.loads((out / "capture.json").read_text())
        (camera,) = document["cameras"]
        document["cameras"][camera] = json.loads(Path("camera.json").read_text())
        (out / "capture.json").write_text(json.dumps(document))

    def shown(run, other, **_):
        used.append("view")
        assert other is None and (run / "config.yaml").exists()

    def attached(capture, file, out, **_):
        used.append("import poses")
        assert load_capture(capture).frames and file == Path("gvhmr.pt")
        return out

    few_descent_steps(monkeypatch)
    monkeypatch.setattr(posing, "find_poses", found)
    monkeypatch.setattr("evsplat.view.view_run", shown)
    monkeypatch.setattr("evsplat.importers.attach_poses", attached)
    monkeypatch.chdir(place)
    return used


@pytest.mark.parametrize("number", range(len(blocks())))
def test_the_pages_commands_run_as_they_stand_there(
    number: int, stand_ins: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shortened, commands = blocks()[number]
    assert commands and all(command[0] == "evsplat" for command in commands)
    if commands[0][2] == "my_capture":
        shutil.copytree(tmp_path / "made", "my_capture")
    for _, *arguments in commands:
        if arguments[0] == "train":
            stand_ins.append("train")
            # too small, as a video of these pixels, to tell whether the body belongs to it
            arguments += [
                "--iterations",
                "2",
                "--any-body",
                "--no-evaluate",
                "--set",
                *small("evsplat"),
            ]
        code = main(arguments)
        assert code == 0, capsys.readouterr().err
    assert set(stand_ins) == shortened, "what is shortened, and nothing else, says so on the page"


def test_what_the_page_imports_is_what_was_recorded(stand_ins: list[str], tmp_path: Path) -> None:
    made = load_capture(tmp_path / "made")
    for command in (["davis", "dance.aedat4", "--camera", "camera.json"], ["folder", "rec"]):
        more = ["--homography", "homography.txt", "--fps", "25", "--exposure-us", "30000"]
        more += ["--start-us", str(EXPOSURE_US // 2)]
        assert main(["import", *command, *(more if "rec" in command else []), "--out", "c"]) == 0
        capture = load_capture("c")
        assert [f.exposure_us for f in capture.frames] == [f.exposure_us for f in made.frames]
        assert capture.frames[1].exposure_us[0] == PERIOD_US
        assert capture.events is not None and made.events is not None
        ours, theirs = (c.events.between(0, 1 << 40) for c in (capture, made))
        assert np.array_equal(ours.t, theirs.t) and np.array_equal(ours.p, theirs.p)
        assert np.array_equal(ours.x, theirs.x) and np.array_equal(ours.y, theirs.y)
        shutil.rmtree("c")
