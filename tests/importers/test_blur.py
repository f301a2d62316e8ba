"""From a data set to the paper's blurry version of it by one command."""

import shlex
from pathlib import Path

import numpy as np
import pytest

from evsplat.body.smpl import ENVIRONMENT
from evsplat.capture import load_capture
from evsplat.cli import main
from evsplat.errors import ConfigError, WeightsError
from evsplat.importers import Blur, import_capture
from evsplat.pictures.files import read_image

from . import trees


@pytest.fixture(autouse=True)
def no_models(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(ENVIRONMENT, raising=False)


def check(sharp_path: Path, blurry_path: Path, recipe: str) -> None:
    """Frames are blurry around sharp ones, with their truth, poses and events."""
    sharp, blurry = load_capture(sharp_path), load_capture(blurry_path)
    assert blurry.provenance["synthesis"]["recipe"] == recipe
    assert blurry.events is not None and blurry.events_simulated and len(blurry.events) > 100
    assert blurry.contrast_threshold == (0.2, 0.2)
    names = [frame.name for frame in blurry.frames]
    # the first and the last exposure would reach beyond the recording
    assert names == [frame.name for frame in sharp.frames][1:-1]
    for frame in blurry.frames:
        source = sharp.frame(frame.name)
        assert frame.mid_us == source.mid_us and frame.sharp is not None
        assert np.array_equal(read_image(frame.sharp), read_image(source.image))
        assert not np.array_equal(read_image(frame.image), read_image(source.image))
        start, end = frame.exposure_us
        spacing = sharp.frames[1].mid_us - sharp.frames[0].mid_us
        assert abs(end - start - spacing) <= 2
    keys = [frame.mid_us for frame in blurry.frames]
    assert np.array_equal(blurry.body_file.times_us, keys)


def test_zju_mocap_blur_is_one_command(tmp_path: Path, capsys) -> None:
    source, out = trees.write_zju_raw(tmp_path / "CoreView_377"), tmp_path / "zju_377"
    command = ["import", "zju-mocap", str(source), "--out", str(out), "--blur"]
    options = ["--interpolation", "flow", "--novel-cameras", "2"]
    assert main([*command, *options]) == 0
    assert f"written: {out}\n" in capsys.readouterr().out
    check(tmp_path / "zju_377_sharp", out, "zju-mocap-blur")
    blurry = load_capture(out)
    views = {view.frame: view for view in blurry.novel_views}
    for frame in blurry.frames:
        assert frame.mask is not None and views[frame.name].time_us == frame.mid_us


def test_mmhpsd_blur_is_one_call(tmp_path: Path) -> None:
    trees.write_mmhpsd_a(tmp_path / "data")
    import_capture(
        "mmhpsd",
        tmp_path / "data",
        tmp_path / "s1g2t3",
        action=trees.ACTION,
        blur=Blur(interpolation="flow"),
    )
    check(tmp_path / "s1g2t3_sharp", tmp_path / "s1g2t3", "mmhpsd-blur")


def test_weights_that_are_missing_leave_the_sharp_capture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The recipe names Super SloMo: without its weights the error says so, the import stays."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "none"))
    source = trees.write_zju_raw(tmp_path / "CoreView_377")
    with caplog.at_level("INFO", "evsplat"), pytest.raises(WeightsError):
        import_capture("zju-mocap", source, tmp_path / "out", blur=True)
    assert not (tmp_path / "out").exists()
    assert len(load_capture(tmp_path / "out_sharp").frames) == trees.FRAMES
    # the command that is said goes on from there, with the choice that needs no weights
    said = caplog.text.rsplit("make it blurry with: evsplat ", 1)[1].splitlines()[0]
    assert main([*shlex.split(said), "--interpolation", "flow"]) == 0
    check(tmp_path / "out_sharp", tmp_path / "out", "zju-mocap-blur")


def test_only_data_sets_of_the_paper_have_a_recipe(tmp_path: Path) -> None:
    source = trees.write_neuman(tmp_path / "lab")
    with pytest.raises(ConfigError, match="use 'evsplat synthesize'"):
        import_capture("neuman", source, tmp_path / "out", blur=True)
    assert [path.name for path in tmp_path.iterdir()] == ["lab"]
