"""Checkpoints on a full disk and after damage: what is there is kept, and said."""

import errno
import json
import logging
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from evsplat.errors import DataError, OutputError
from evsplat.training import checkpoint
from evsplat.training.checkpoint import checkpoints, load_latest, load_model, save_checkpoint

from ..small_model import SMALL, built

CLOCK = {"iteration": 1, "iterations": 9, "fraction": 0.1, "seconds": 1.0, "step_seconds": 1.0}
STATE = {"clock": CLOCK, "human_count": 4}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "run" / "checkpoints"
    for iteration in (10, 20):
        save(path, iteration)
    return path


def save(folder: Path, iteration: int) -> Path:
    return save_checkpoint(folder, iteration, {"a": torch.full((4,), iteration)}, STATE)


def steps(folder: Path) -> list[int]:
    return [int(path.stem) for path in checkpoints(folder)]


def full_unless(monkeypatch: pytest.MonkeyPatch, folder: Path, most: int) -> None:
    """Nothing can be written while the folder holds more than ``most`` checkpoints."""
    sound = checkpoint._pieces

    def on_a_full_disk(*content: Any) -> Iterator[bytes | memoryview]:
        if len(steps(folder)) > most:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        yield from sound(*content)

    monkeypatch.setattr(checkpoint, "_pieces", on_a_full_disk)


def test_on_a_full_disk_the_oldest_gives_way(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    full_unless(monkeypatch, folder, 1)
    with caplog.at_level(logging.WARNING):
        save(folder, 30)
    assert steps(folder) == [20, 30]
    assert "the disk is full" in caplog.text and "without 000010.safetensors" in caplog.text


def test_where_that_is_not_enough_the_newest_is_kept_and_named(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full_unless(monkeypatch, folder, 0)
    with pytest.raises(OutputError) as error:
        save(folder, 30)
    assert steps(folder) == [20]
    message = str(error.value)
    assert message.count("000030.safetensors: not written, the disk is full") == 1
    assert (
        "step 20 is kept: once that is mended, go on with: evsplat train CAPTURE --out " in message
    )
    assert "\n" not in message


def test_the_first_one_without_room_says_that_none_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full_unless(monkeypatch, tmp_path, -1)
    with pytest.raises(OutputError, match="No checkpoint is kept"):
        save(tmp_path, 10)


@pytest.mark.parametrize("content", [b"", b"\0" * 100, None], ids=["empty", "zeros", "cut"])
def test_one_that_cannot_be_read_gives_way_to_the_one_before(
    folder: Path, caplog: pytest.LogCaptureFixture, content: bytes | None
) -> None:
    newest = checkpoints(folder)[-1]
    newest.write_bytes(newest.read_bytes()[:-8] if content is None else content)
    with caplog.at_level(logging.WARNING):
        found = load_latest(folder)
    assert found is not None and found[0].stem == "000010" and found[1]["a"][0] == 10
    assert "000020.safetensors: not a readable checkpoint" in caplog.text
    assert "Taking the one before it." in caplog.text


def test_where_none_can_be_read_it_is_an_error(folder: Path) -> None:
    assert load_latest(folder.parent) is None
    for path in checkpoints(folder):
        path.write_bytes(b"")
    with pytest.raises(DataError, match="000010.safetensors: not a readable"):
        load_latest(folder)


def test_a_training_that_goes_on_from_before_drops_what_is_later(folder: Path) -> None:
    """Later ones were damaged; kept, they would pass for the newest again."""
    save(folder, 15)
    assert steps(folder) == [10, 15]


def test_behind_a_million_steps_the_newest_is_still_the_last(tmp_path: Path) -> None:
    for iteration in (999_990, 1_000_000, 1_000_010, 10_000_000):
        path = save(tmp_path, iteration)
        assert checkpoints(tmp_path)[-1] == path
        kept = load_latest(tmp_path)
        assert kept is not None and kept[0] == path
        assert len(checkpoints(tmp_path)) == (1 if iteration == 999_990 else checkpoint.KEEP)


def test_files_that_are_not_named_by_a_step_are_no_checkpoints(folder: Path) -> None:
    (folder / "000020.safetensors").rename(folder / "20 old.safetensors")
    assert steps(folder) == [10]


def test_a_checkpoint_is_a_file_of_safetensors(folder: Path) -> None:
    """As its own writer makes it: shapes, types, numbers and texts, read by its own reader."""
    generator = torch.Generator().manual_seed(0)
    tensors = {
        "numbers": torch.randn(3, 5, 2, generator=generator),
        "turned": torch.randn(4, 3, generator=generator).T,
        "exact": torch.randn(2, generator=generator, dtype=torch.float64),
        "rows": torch.arange(7),
        "state": torch.randint(256, (5,), generator=generator, dtype=torch.uint8),
        "flag": torch.tensor(True),
        "none": torch.zeros(0, 3),
        "one": torch.tensor(2.5),
    }
    path = save_checkpoint(folder, 30, tensors, STATE)
    kept = {name: tensor.contiguous() for name, tensor in tensors.items()}
    other = path.with_name("other.safetensors")
    save_file(kept, other, metadata={"state": json.dumps(STATE)})
    for found in (load_file(path), load_file(other)):
        assert found.keys() == tensors.keys()
        for name, tensor in tensors.items():
            assert found[name].dtype == tensor.dtype and torch.equal(found[name], tensor)
    assert path.stat().st_size == other.stat().st_size
    assert load_latest(folder)[2] == STATE


def test_the_disk_s_other_faults_keep_all(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> Iterator[bytes]:
        yield b"some of it"
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(checkpoint, "_pieces", broken)
    with pytest.raises(OSError, match=os.strerror(errno.EIO)):
        save(folder, 30)
    assert steps(folder) == [10, 20]


@pytest.mark.parametrize("method", SMALL)
def test_a_model_with_another_s_rows_is_drawn_as_that_one(method: str, tiny_capture) -> None:
    path = tiny_capture()
    first, second = (built(method, path, seed=seed).model for seed in (0, 1))
    times, centre = [15_000, 55_000], torch.tensor([0.0, -3.0, 1.0])

    def drawn(model):
        with torch.no_grad():
            human = model.at(times, centre, hard_semantics=True).human
        return torch.cat([human.means, human.channels], -1)

    drawn(first)  # what is kept per Gaussian is found now
    counts = [sum(rows.human_count for rows in model.sets.values()) for model in (first, second)]
    assert counts[0] == counts[1]
    tensors = {f"model.{name}": value.clone() for name, value in second.state_dict().items()}
    load_model(first, tensors, counts[1])
    assert torch.equal(drawn(first), drawn(second))
