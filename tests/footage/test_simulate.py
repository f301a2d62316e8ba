"""Footage to an event file, by function and by command."""

import os
import tracemalloc
from pathlib import Path

import av
import h5py
import numpy as np
import pytest
import torch
from PIL import Image

import evsplat as ev
from evsplat.cli import main
from evsplat.errors import ConfigError, DataError
from evsplat.events import (
    EventStore,
    EventStream,
    SensorSettings,
    SensorSimulator,
    sensor_settings,
)
from evsplat.pictures import Transfer, decode, luminance
from evsplat.pictures.files import write_image
from evsplat.pictures.video import write_video

from ..events.formats.helpers import same
from ..events.simulator.helpers import joined

FPS = 250.0
WIDTH, HEIGHT = 48, 36


def moving_disc(count: int, seed: int = 0) -> list[np.ndarray]:
    """RGB pictures in [0, 1] of a disc on its way over a gradient."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    background = 0.2 + 0.5 * np.stack([x / WIDTH, y / HEIGHT, 1 - x / WIDTH], axis=-1)
    colour, start = rng.random(3), rng.uniform(5, 15)
    pictures = []
    for k in range(count):
        inside = (x - start - 1.1 * k) ** 2 + (y - HEIGHT / 2) ** 2 < 64
        pictures.append(np.where(inside[..., None], colour, background))
    return pictures


def folder_of(path: Path, pictures: list[np.ndarray]) -> Path:
    """Pictures of any dtype as PNG, named so that only natural order is right."""
    path.mkdir()
    for k, picture in enumerate(pictures):
        write_image(path / f"picture{k}.png", picture)
    return path


def expected_events(
    light: list[np.ndarray], settings: SensorSettings, seed: int = 0
) -> EventStream:
    """What the sensor sends for these linear pictures at FPS."""
    sensor = SensorSimulator(WIDTH, HEIGHT, settings, seed)
    return joined([sensor.step(picture, round(k * 1e6 / FPS)) for k, picture in enumerate(light)])


def stored(path: Path) -> EventStream:
    store = EventStore(path, WIDTH, HEIGHT)
    return store.between(*store.time_range_us)


@pytest.mark.parametrize("kind", ["grey8", "grey16", "rgb8", "rgb16"])
@pytest.mark.parametrize("transfer", ["power", "srgb", "linear"])
def test_pictures_of_any_depth_give_the_sensors_events(
    tmp_path: Path, kind: str, transfer: Transfer
) -> None:
    levels = 65_535 if kind.endswith("16") else 255
    pictures = [(p * levels).round() for p in moving_disc(12)]
    if kind.startswith("grey"):
        pictures = [p[..., 1] for p in pictures]
    source = folder_of(
        tmp_path / "in", [p.astype(np.uint16 if levels > 255 else np.uint8) for p in pictures]
    )
    settings = sensor_settings("dvxplorer", shot_hz=20.0)
    count = ev.simulate(
        source, tmp_path / "events.h5", settings=settings, source_fps=FPS, transfer=transfer, seed=4
    )
    light = [decode(torch.tensor(p / levels, dtype=torch.float32), transfer) for p in pictures]
    if kind.startswith("rgb"):
        light = [luminance(p) for p in light]
    expected = expected_events([p.numpy() for p in light], settings, seed=4)
    assert count == len(expected) > 300
    assert same(stored(tmp_path / "events.h5"), expected)


def test_video_has_its_own_times_and_another_rate_stretches_them(tmp_path: Path) -> None:
    pictures = [(255 * p).round().astype(np.uint8) for p in moving_disc(20)]
    write_video(tmp_path / "clip.mp4", pictures, fps=FPS, crf=4)
    own = ev.simulate(tmp_path / "clip.mp4", tmp_path / "own.h5")
    slow = ev.simulate(tmp_path / "clip.mp4", tmp_path / "slow.h5", source_fps=FPS / 4)
    first, second = stored(tmp_path / "own.h5"), stored(tmp_path / "slow.h5")
    assert own == slow == len(first)
    assert first.t[-1] <= 19e6 / FPS and np.abs(second.t - 4 * first.t).max() <= 4
    with av.open(str(tmp_path / "clip.mp4")) as container:
        pictures = [f.to_ndarray(format="rgb24") for f in container.decode(video=0)]
    light = [luminance(decode(torch.from_numpy(p / 255).float())).numpy() for p in pictures]
    assert same(first, expected_events(light, SensorSettings()))


def test_file_tells_how_it_was_made(tmp_path: Path) -> None:
    source = folder_of(tmp_path / "clip", moving_disc(3))
    settings = sensor_settings("evk4", contrast_on=0.3)
    ev.simulate(
        source, tmp_path / "e.h5", settings=settings, source_fps=FPS, transfer="srgb", seed=9
    )
    with h5py.File(tmp_path / "e.h5") as file:
        attributes = dict(file.attrs)
    prefix = "sensor_"
    told = {k.removeprefix(prefix): v for k, v in attributes.items() if k.startswith(prefix)}
    assert SensorSettings(**told) == settings
    assert (attributes["width"], attributes["height"]) == (WIDTH, HEIGHT)
    assert (attributes["seed"], attributes["transfer"]) == (9, "srgb")
    assert attributes["simulated"] and attributes["source"] == "clip"


def test_file_tells_its_source_whatever_bytes_that_is_named_by(tmp_path: Path) -> None:
    source = folder_of(tmp_path / os.fsdecode(b"clip\xff"), moving_disc(2))
    ev.simulate(source, tmp_path / "e.h5", source_fps=FPS)
    with h5py.File(tmp_path / "e.h5") as file:
        assert file.attrs["source"] == "clip\\udcff"


def test_memory_does_not_grow_with_the_events(tmp_path: Path) -> None:
    source = tmp_path / "flicker"
    source.mkdir()
    for k in range(30):
        Image.new("L", (WIDTH, HEIGHT), 40 if k % 2 else 220).save(source / f"{k}.png")
    peaks, counts = [], []
    for contrast in (0.2, 0.03):
        settings = SensorSettings(contrast_on=contrast, contrast_off=contrast)
        tracemalloc.start()
        counts.append(ev.simulate(source, tmp_path / "e.h5", settings=settings, source_fps=200.0))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    # 13 bytes each, were all of them kept
    assert peaks[1] - peaks[0] < 0.3 * 13 * (counts[1] - counts[0])


def test_interruption_leaves_no_file_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    source = folder_of(tmp_path / "in", moving_disc(6))
    out = tmp_path / "out" / "events.h5"
    steps = []

    def step(self: SensorSimulator, luma: object, time_us: int) -> EventStream:
        steps.append(time_us)
        if len(steps) == 4:
            raise KeyboardInterrupt
        return original(self, luma, time_us)

    original = SensorSimulator.step
    monkeypatch.setattr(SensorSimulator, "step", step)
    code = main(["simulate", str(source), "--out", str(out), "--source-fps", "100"])
    assert code == 130 and f"{out} was not written" in capsys.readouterr().err
    assert not out.parent.exists()


def test_command_takes_preset_and_single_settings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, out = folder_of(tmp_path / "in", moving_disc(8)), tmp_path / "events.h5"
    options = ["--preset", "davis346", "--contrast", "0.15", "--set", "leak_hz=3", "--seed", "2"]
    code = main(["simulate", str(source), "--out", str(out), "--source-fps", str(FPS), *options])
    settings = sensor_settings("davis346", contrast_on=0.15, contrast_off=0.15, leak_hz=3.0)
    pictures = [(255 * p + 0.5).astype(np.uint8) for p in moving_disc(8)]
    light = [luminance(decode(torch.from_numpy(p / 255).float())).numpy() for p in pictures]
    assert code == 0 and same(stored(out), expected_events(light, settings, seed=2))
    assert f"written: {out} ({len(stored(out)):,} events)" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "parts"),
    [
        ([], ["--source-fps"]),
        (["--source-fps", "100", "--contrast", "0"], ["contrast_on is 0.0", "at least 0.01"]),
        (["--source-fps", "100", "--set", "shot=3"], ["Did you mean shot_hz?"]),
        (["--source-fps", "100", "--set", "shot_hz=much"], ["shot_hz", "'much'"]),
        (["--source-fps", "100", "--seed", "-1"], ["--seed -1: expected", "0 or more"]),
        (["--source-fps", "100", "--preset", "davis"], ["davis346"]),
    ],
)
def test_bad_options_say_what_is_wrong(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], parts: list[str]
) -> None:
    source = folder_of(tmp_path / "in", moving_disc(2))
    out = tmp_path / "out" / "events.h5"
    try:
        code = main(["simulate", str(source), "--out", str(out), *options])
    except SystemExit as stop:
        code = stop.code
    printed = "".join(capsys.readouterr())
    assert code == 2 and all(part in printed for part in parts) and "Traceback" not in printed
    assert not out.parent.exists()


def test_one_picture_is_no_footage(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="holds one picture; events need at least two"):
        ev.simulate(folder_of(tmp_path / "in", moving_disc(1)), tmp_path / "e.h5", source_fps=FPS)
    with pytest.raises(DataError, match="no such video file or folder"):
        ev.simulate(tmp_path / "nothing.mp4", tmp_path / "e.h5")
    with pytest.raises(ConfigError, match="nan"):
        ev.simulate(tmp_path / "in", tmp_path / "e.h5", source_fps=float("nan"))
    assert not (tmp_path / "e.h5").exists()


def test_pictures_far_apart_are_warned_about(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    source = folder_of(tmp_path / "in", moving_disc(3))
    ev.simulate(source, tmp_path / "e.h5", source_fps=FPS)
    assert not caplog.records
    ev.simulate(source, tmp_path / "e.h5", source_fps=30.0)
    assert "33.3 ms apart" in caplog.text
