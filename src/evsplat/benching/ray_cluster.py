"""Cells on a Ray cluster, each in a worker process of its own."""

import os
import socket
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evsplat.benching.cell import Cell, run_cell
from evsplat.benching.folder import BenchFolder
from evsplat.errors import BackendError, DataError

RETRIES = 3
"""Restarts of a cell whose worker or machine died, from its checkpoint."""
_STOP_SECONDS = 120.0
_ANSWER_SECONDS = 10.0


@dataclass
class RayCluster:
    """Runs as many cells at a time as the cluster has room for."""

    folder: Path
    """Absolute, on a file system that every machine of the cluster sees there."""
    address: str
    """Address of the cluster; ``local`` starts one on this machine."""
    cpus: int
    """Processor cores of each cell, also its threads."""
    gpus: float
    device: str

    def run(self, cells: Sequence[Cell]) -> Generator[tuple[Cell, str | None]]:
        """Each cell as it ends, with the reason where its worker died for good.

        Closing the iterator, and Ctrl-C, stop what runs: training is saved first.
        """
        ray = _import_ray()
        started = not ray.is_initialized()
        if started:
            self._connect(ray)
        # A worker that has run a cell ends, so that no cell inherits memory or threads of another.
        task = ray.remote(num_cpus=self.cpus, num_gpus=self.gpus, max_calls=1, max_retries=RETRIES)(
            _cell_on_node
        )
        running = {
            task.options(name=cell.id).remote(self.folder, cell, self.cpus, self.device): cell
            for cell in cells
        }
        try:
            while running:
                ended, _ = ray.wait(list(running), num_returns=1)
                yield running.pop(ended[0]), _reason(ray, ended[0])
        finally:
            for reference in running:
                ray.cancel(reference)
            if running:
                ray.wait(list(running), num_returns=len(running), timeout=_STOP_SECONDS)
            if started:
                ray.shutdown()

    def _connect(self, ray: Any) -> None:
        if self.address == "local":
            os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
            ray.init(
                address="local", include_dashboard=False, log_to_driver=False, logging_level="error"
            )
            return
        try:
            _check_listening(self.address)
            ray.init(address=self.address, log_to_driver=False, logging_level="error")
        except (OSError, ValueError) as error:
            raise BackendError(
                f"--ray {self.address}: no Ray cluster answers ({error}); start one with "
                "`ray start --head`, or pass --ray local."
            ) from None


def _check_listening(address: str) -> None:
    """Fail at once where nobody listens at HOST:PORT; Ray itself would try for minutes."""
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if colon and port.isdecimal():
        socket.create_connection((host, int(port)), timeout=_ANSWER_SECONDS).close()


def _cell_on_node(folder: Path, cell: Cell, threads: int, device: str) -> None:
    """Run a cell in a Ray worker."""
    bench = BenchFolder(folder)
    if not bench.lock_of("bench").exists():
        raise DataError(
            f"{folder} is not to be seen on {socket.gethostname()}; put --out on a file system "
            "that all machines of the cluster share, under the same path."
        )
    if bench.record_of(cell.id).exists():
        return  # the worker died between writing the record and saying so
    run_cell(folder, cell, threads=threads, device=device)


def _reason(ray: Any, reference: Any) -> str | None:
    try:
        ray.get(reference)
    except (ray.exceptions.RayError, DataError) as error:
        return " ".join(str(getattr(error, "cause", None) or error).split())
    return None


def _import_ray() -> Any:
    try:
        import ray
    except ImportError:
        raise BackendError(
            "--ray needs Ray, which is not installed: pip install 'evsplat[ray]'."
        ) from None
    return ray
