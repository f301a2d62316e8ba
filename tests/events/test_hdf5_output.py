"""A disk that takes no more is an error that is said, never a crash in HDF5."""

import errno
import io
import signal
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from evsplat.errors import OutputError
from evsplat.events import EventStream, hdf5_output, write_events
from evsplat.events.hdf5_output import Hdf5Output


class SmallDisk:
    """A file that takes so many bytes and no more, some writes in part."""

    def __init__(self, file: Any, room: int) -> None:
        self.file, self.room = file, room

    def write(self, content: memoryview) -> int:
        room = self.room - self.file.tell()
        if room <= 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return self.file.write(content[:room])

    def __getattr__(self, name: str) -> Any:
        return getattr(self.file, name)


def on_a_disk_of(room: int, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = hdf5_output.open_output
    monkeypatch.setattr(
        hdf5_output, "open_output", lambda *args, **rest: SmallDisk(opened(*args, **rest), room)
    )


def events(count: int) -> EventStream:
    rng = np.random.default_rng(0)
    t = np.sort(rng.integers(0, 10**9, count))
    x, y = rng.integers(0, 640, count), rng.integers(0, 480, count)
    return EventStream(t, x.astype(np.uint16), y.astype(np.uint16), np.ones(count, np.int8))


@pytest.mark.parametrize("room", [0, 100, 2_000, 10_000, 100_000, 500_000])
def test_a_full_disk_is_one_sentence_and_nothing_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: int
) -> None:
    on_a_disk_of(room, monkeypatch)
    pieces = [events(150_000)]
    with pytest.raises(OutputError, match=r"a\.h5: not written, the disk is full; make room"):
        write_events(tmp_path / "a.h5", pieces)
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_at_any_call_of_hdf5_waits_for_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An exception in the midst of one crashes the process when the file is closed."""
    calls = 0
    seek = Hdf5Output.seek

    def pressed(output: Hdf5Output, *place: int) -> int:
        nonlocal calls
        calls += 1
        if calls == at:
            signal.raise_signal(signal.SIGINT)
        return seek(output, *place)

    monkeypatch.setattr(Hdf5Output, "seek", pressed)
    heard = at = 0
    while at < 60:
        calls, at = 0, at + 4
        try:
            write_events(tmp_path / "a.h5", [events(70_000)])
        except KeyboardInterrupt:
            heard += 1
        assert list(tmp_path.glob(".*")) == []
    assert heard > 5


def test_what_the_disk_did_not_take_is_still_read_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_a_disk_of(3_000, monkeypatch)
    values = np.random.default_rng(0).integers(0, 1 << 40, 20_000)
    with Hdf5Output(tmp_path / "a.h5") as output:
        with h5py.File(output, "w") as file:
            file["first"] = values
        assert isinstance(output.error, OSError) and output.error.errno == errno.ENOSPC
        output.seek(0)
        with h5py.File(io.BytesIO(output.read()), "r") as file:
            assert np.array_equal(file["first"], values)
