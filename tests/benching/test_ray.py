"""Cells on a real Ray with two workers, one of which is killed in the middle of its work."""

import os
import signal
import threading
import time
from pathlib import Path

import pytest

import evsplat as ev
from evsplat.benching.cell import DONE, run_cell
from evsplat.benching.folder import BenchFolder
from evsplat.benching.plan import make_plan
from evsplat.benching.suite import read_suite
from evsplat.errors import BackendError

from .helpers import MEDIAN, PAPER, records, write_suite

ray = pytest.importorskip("ray", reason="needs Ray: pip install 'evsplat[ray]'")


@pytest.fixture
def two_workers(monkeypatch):
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    # Ray's default of 15 would have them starve where other work runs beside the tests.
    monkeypatch.setenv("RAY_worker_niceness", "0")
    ray.init(
        num_cpus=2,
        include_dashboard=False,
        log_to_driver=False,
        logging_level="error",
        object_store_memory=80 << 20,
    )
    yield
    ray.shutdown()


KILLED = "one/paper/seed0"


def kill_once_it_trains(folder: BenchFolder, cell: str, killed: list[int]) -> None:
    """SIGKILL to the worker that holds the cell's lock, as soon as its training has begun."""
    deadline = time.monotonic() + 300
    while time.monotonic() < deadline:
        if (folder.run_of(cell) / "versions.json").exists():
            killed.append(int(folder.lock_of(cell).read_text()))
            os.kill(killed[0], signal.SIGKILL)
            return
        time.sleep(0.01)


def test_a_killed_worker_loses_nothing(two_workers, tiny_capture, tmp_path: Path):
    suite = write_suite(tmp_path / "suite.yaml", {"one": tiny_capture("one")}, MEDIAN, PAPER)
    folder = BenchFolder(tmp_path / "ray")
    killed: list[int] = []
    killer = threading.Thread(target=kill_once_it_trains, args=(folder, KILLED, killed))
    killer.start()
    ev.bench(suite, out=folder.path, ray="auto")
    killer.join()
    assert killed and killed[0] != os.getpid()
    made = records(folder.path)
    assert [record["status"] for record in made.values()] == [DONE, DONE]
    cells = {cell.id: cell for cell in make_plan(read_suite(suite), folder).cells}
    run_cell(tmp_path / "here", cells[KILLED], threads=1, device="cpu")
    (undisturbed,) = records(tmp_path / "here").items()
    assert undisturbed in made.items()


def test_no_cluster_at_the_address_is_one_sentence(tiny_capture, tmp_path):
    suite = write_suite(tmp_path / "suite.yaml", {"one": tiny_capture("one")}, PAPER)
    with pytest.raises(BackendError, match="no Ray cluster answers"):
        ev.bench(suite, out=tmp_path / "out", ray="127.0.0.1:1")
