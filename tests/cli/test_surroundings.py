"""Odd homes, paths and recordings: work is done, or refused in one sentence with exit code 2."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from PIL import Image

from evsplat.cli import main
from evsplat.training import load_run

from ..conftest import write_tiny_capture
from ..small_model import small

SETTINGS = [word for pair in small("evsplat") for word in ("--set", pair)]
WAY = """
import sys
from evsplat.cli import main
capture, run, settings = sys.argv[1], sys.argv[2], sys.argv[3:]
codes = [
    main(["inspect", capture, "--out", run + " seen"]),
    main(["train", capture, "--out", run, "--iterations", "2", "--any-body", "--no-evaluate",
          *settings]),
    main(["render", run, "--what", "test"]),
]
sys.exit(max(codes))
"""


@pytest.mark.parametrize("surroundings", ["bare", "no home in a full path"])
def test_the_way_from_capture_to_pictures_without_a_home_and_in_odd_places(
    tmp_path: Path, surroundings: str
) -> None:
    """No HOME, no TMPDIR, the C locale; names with every letter, and a home that is not there."""
    odd = "a b ü\n'\"$x%41"
    place = tmp_path / ("plain" if surroundings == "bare" else odd)
    place.mkdir()
    capture = write_tiny_capture(place / "tïny cäpture")
    kept = {key: os.environ[key] for key in ("PATH", "OMP_NUM_THREADS") if key in os.environ}
    environment = (
        kept
        | {
            "bare": {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
            "no home in a full path": {
                "HOME": f"/proc/{odd}",
                "XDG_CACHE_HOME": f"/proc/{odd}/.cache",
            },
        }[surroundings]
    )
    done = subprocess.run(
        [sys.executable, "-c", WAY, str(capture), str(place / "run"), *SETTINGS],
        env=environment,
        capture_output=True,
        check=False,
    )
    said = done.stderr.decode("utf-8", "replace")
    assert done.returncode == 0 and "Traceback" not in said, said[-2_000:]
    assert len(list((place / "run" / "renders").rglob("*.png"))) == 3


def spoil(capture: Path, kind: str) -> None:
    """Turn a sound capture into an odd one."""
    document = json.loads((capture / "capture.json").read_text())
    if kind == "one frame":
        document["frames"], document["novel_views"] = document["frames"][:1], []
    elif kind == "black":
        for frame in document["frames"]:
            for name in (frame["image"], frame["sharp"]):
                Image.new("RGB", Image.open(capture / name).size).save(capture / name)
    elif "x" in kind:
        main_camera = document["cameras"]["main"]
        main_camera["width"], main_camera["height"] = map(int, kind.split("x"))
    elif kind == "no light":
        document["frames"][3]["exposure_us"][1] = document["frames"][3]["exposure_us"][0]
    with h5py.File(capture / "events.h5", "r+") as file:
        t = file["events/t"][:]
        if kind in ("brighter", "darker"):
            file["events/p"][:] = kind == "brighter"
        elif kind == "clock back":
            file["events/t"][len(t) // 2 :] = t[len(t) // 2 :] - 50_000
        elif kind == "clock on":
            t[len(t) // 2 :] += 3_600_000_000
            file["events/t"][:] = t
            del file["ms_to_idx"]
            file["ms_to_idx"] = np.searchsorted(t, np.arange(t[-1] // 1000 + 2) * 1000)
    (capture / "capture.json").write_text(json.dumps(document))


@pytest.mark.parametrize(
    ("size", "kind", "said"),
    [
        ((32, 24), "1x1", "at least 11, the side of SSIM's window"),
        ((32, 24), "2000x8", "at least 11, the side of SSIM's window"),
        ((400, 11), "", ""),
        ((32, 24), "one frame", ""),
        ((32, 24), "black", ""),
        ((32, 24), "brighter", ""),
        ((32, 24), "darker", ""),
        ((32, 24), "no light", "an empty exposure"),
        ((32, 24), "clock back", "ms_to_idx[|before the one before"),
        ((32, 24), "clock on", ""),
    ],
)
def test_odd_recordings_train_or_are_refused(
    tmp_path: Path, capsys, size: tuple[int, int], kind: str, said: str
) -> None:
    capture = write_tiny_capture(tmp_path / "tiny", width=size[0], height=size[1])
    spoil(capture, kind)
    run = tmp_path / "run"
    arguments = ["train", str(capture), "--out", str(run), "--iterations", "3", "--any-body"]
    code = main([*arguments, "--no-evaluate", *SETTINGS])
    errors = capsys.readouterr().err
    assert "Traceback" not in errors
    if said:
        assert code == 2 and any(part in errors for part in said.split("|")), errors
        assert not run.exists()
        return
    assert code == 0, errors
    drawn = load_run(run)
    frame = drawn.capture.frames[0]
    picture = drawn.reconstruction.render(drawn.capture.camera(frame), [frame.mid_us]).rgb
    assert bool(picture.isfinite().all())
    shutil.rmtree(run)
