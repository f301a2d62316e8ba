"""One cell: a method on a capture with a seed, trained, measured and recorded, whatever happens."""

import hashlib
import logging
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

import evsplat
from evsplat.benching.cpu_time import cpu_time
from evsplat.benching.folder import BenchFolder, exclusive
from evsplat.benching.given_pictures import OWN_PICTURE, PICTURES, GivenPictures, OwnPicture
from evsplat.benching.origin import code, machine
from evsplat.capture import Capture, Policy, load_capture
from evsplat.capture.policy import Terms
from evsplat.config import override, to_dict
from evsplat.errors import ConfigError, DataError, EvsplatError
from evsplat.evaluation.evaluator import evaluate
from evsplat.files import remove_folder, write_json
from evsplat.methods import method_config
from evsplat.methods.reconstruction import Reconstruction
from evsplat.methods.trivial import TRIVIAL, OnMedianBackground
from evsplat.render import choose_device
from evsplat.restore import restore_capture
from evsplat.staging import StageSettings, stage
from evsplat.untrusted.faults import open_bytes
from evsplat.untrusted.records import Shape, misfit, read_record

if TYPE_CHECKING:
    from evsplat.training import Run

logger = logging.getLogger(__name__)

DONE, FAILED = "done", "failed"
UNTRAINED = (*TRIVIAL, OWN_PICTURE, PICTURES)
"""Methods of rows that need no training."""
_RECORD = {"status": str, "cell": {"seed": int}}
_OF_STATUS: dict[str, Shape] = {
    FAILED: {"reason": str},
    DONE: {
        "seconds": float,
        "peak_memory_mb": float,
        "protocols": {"standard": {str: {str: (float, type(None))}}},
        "per_frame": [dict],
        "frames": {str: int},
    },
}


def read_cell_record(path: Path) -> dict[str, Any]:
    """The record of a cell that is over, as `run_cell` wrote it."""
    remedy = "remove the file to run its cell again"
    record: dict[str, Any] = read_record(path, _RECORD, remedy)
    status = record["status"]
    wrong = misfit(record, _OF_STATUS[status]) if status in _OF_STATUS else f"status is {status!r}"
    if wrong:
        raise DataError(f"{path}: {wrong}; {remedy}.")
    return record


def fingerprint_of(content: bytes) -> str:
    """Sixteen hexadecimal digits that change when a capture's description does."""
    return hashlib.sha256(content).hexdigest()[:16]


def fingerprint_of_file(path: Path) -> str:
    """`fingerprint_of` what a file holds; a `DataError` where it is no ordinary one."""
    with open_bytes(path) as file:
        return fingerprint_of(file.read())


@dataclass(frozen=True)
class CaptureSource:
    """A capture of a bench: its folder, or the settings to stage it with."""

    name: str
    path: Path
    """Its folder, absolute; of a staged one, where it is made when it is first needed."""
    fingerprint: str
    """Changes when the capture does."""
    stage: StageSettings | None = None


@dataclass(frozen=True)
class Cell:
    """One request: nothing else decides its figures but the machine."""

    capture: CaptureSource
    row: str
    seed: int
    method: str
    restore: str | None
    settings: tuple[str, ...]
    iterations: int | None
    max_minutes: float | None
    backdrop: bool = False
    """Measure it before the median background."""
    pictures: str | None = None
    """Folder of the given pictures, for method ``pictures``."""
    pictures_digest: str | None = None
    """Changes when one of them does."""

    @property
    def id(self) -> str:
        """``capture/row/seed0``, also the path of its files."""
        return f"{self.capture.name}/{self.row}/seed{self.seed}"

    @property
    def trains(self) -> bool:
        """True for methods that are trained."""
        return self.method not in UNTRAINED

    @property
    def policy(self) -> Policy:
        """The policy: the held-out data that the method may see."""
        if not self.trains:
            return Policy()
        values = override({}, self.settings)
        return method_config(self.method, values, where=f"row {self.row}").policy

    def request(self) -> dict[str, Any]:
        """All that decides the figures, as JSON; a cell with another request is another cell."""
        try:
            policy = to_dict(self.policy)
        except ConfigError:
            policy = None  # such settings do not run, which the record will say
        asked = {key: value for key, value in asdict(self).items() if key != "capture"}
        return asked | {
            "policy": policy,
            "capture": self.capture.name,
            "fingerprint": self.capture.fingerprint,
            "settings": list(self.settings),
        }


def run_cell(folder: Path, cell: Cell, *, threads: int | None, device: str) -> None:
    """Do what is left of a cell and write its record, of the failure where it fails.

    Training goes on from the last checkpoint. Only what stops the process from outside (Ctrl-C, a
    signal) leaves no record.
    """
    bench = BenchFolder(folder)
    started = time.perf_counter()
    with exclusive(bench.lock_of(cell.id)):
        write_json(bench.request_of(cell.id), cell.request())
        try:
            record = {"status": DONE, **_measured(bench, cell, threads, device)}
        except EvsplatError as error:
            record = {"status": FAILED, "reason": _reason(error)}
        except Exception as error:
            # A fault of the program costs this cell only; the log has the traceback.
            logger.exception("%s failed", cell.id)
            record = {"status": FAILED, "reason": f"{type(error).__name__}: {error}"}
        write_json(
            bench.record_of(cell.id),
            {
                "cell": cell.request(),
                **record,
                "seconds": time.perf_counter() - started,
                "peak_memory_mb": _peak_memory_mb(),
                "evsplat": evsplat.__version__,
                "code": code(),
                "machine": machine(),
            },
        )


def _reason(error: EvsplatError) -> str:
    """The sentence of a command's own failure, and where a bench has the option that it names."""
    text = str(error)
    if "--set " not in text:
        return text
    return f"{text} In a bench settings stand in the suite, under 'settings' of the row."


def _measured(bench: BenchFolder, cell: Cell, threads: int | None, device: str) -> dict[str, Any]:
    """Figures of the cell against the capture as it was recorded, restored or not."""
    if cell.policy.use == "everything":
        raise ConfigError(
            f"row {cell.row}: policy.use is everything, so that nothing is held out and there is "
            "nothing to measure; leave it out."
        )
    device = choose_device(device)
    recorded = load_capture(_recorded(bench, cell.capture))
    seen = recorded.for_training(cell.policy)
    trained_on = _restored(bench, recorded, cell)
    run = bench.run_of(cell.id)
    facts: dict[str, Any] = {"iteration": None, "train_seconds": None, "gaussians": None}
    # Of pictures that were made elsewhere nobody knows what they were made from; the camera's own
    # are what is held out.
    terms: Terms | None = None
    reconstruction: Reconstruction
    if cell.trains:
        trained, facts = _trained(run, trained_on, cell, threads, device)
        reconstruction, terms = trained.reconstruction, trained.policy
    elif cell.pictures is not None:
        reconstruction = GivenPictures(Path(cell.pictures), recorded)
    elif cell.method == OWN_PICTURE:
        reconstruction = OwnPicture(recorded)
    else:
        shown = load_capture(trained_on).for_training(cell.policy)
        reconstruction, terms = TRIVIAL[cell.method](shown), shown.terms("nothing")
    if cell.backdrop:
        reconstruction = OnMedianBackground(reconstruction, seen)
    measured = evaluate(recorded, reconstruction, out_dir=run, device=device, test_frames_only=True)
    kept = ("frames", "protocols", "per_frame", "reasons", "weights", "protocol_notes")
    policy = None if terms is None else to_dict(terms)
    return {**facts, "policy": policy, **{key: measured[key] for key in kept}}


def _trained(
    run: Path, capture: Path, cell: Cell, threads: int | None, device: str
) -> tuple["Run", dict[str, Any]]:
    from evsplat.training import load_run, train
    from evsplat.training.checkpoint import latest_checkpoint
    from evsplat.training.run import RunFolder

    folder = RunFolder(run)
    resume = latest_checkpoint(folder.checkpoints) is not None
    if resume:
        # Sums of floats depend on the number of threads, and with it the last bits of a training.
        threads = read_record(folder.facts, {"threads": int}, "remove the run")["threads"]
    else:
        if run.exists():
            remove_folder(run)
    settings = cell.settings
    iterations = cell.iterations
    if cell.max_minutes is not None and iterations is not None:
        # As a setting it is the length of a schedule that the time limit may still shorten.
        settings, iterations = (*settings, f"iterations={iterations}"), None
    go = partial(
        train,
        capture,
        out=run,
        device=device,
        iterations=iterations,
        max_minutes=cell.max_minutes,
        threads=threads,
    )
    with cpu_time(run, resume) as cpu_seconds:
        if resume:
            go(resume=True)
        else:
            go(method=cell.method, overrides=settings, seed=cell.seed)
    used = cpu_seconds()
    trained = load_run(run, device=device)
    return trained, {
        "iteration": trained.iteration,
        "train_seconds": trained.train_seconds,
        "train_cpu_seconds": used,
        "gaussians": trained.gaussians,
        "device": trained.device,
        "threads": torch.get_num_threads(),
    }


def _recorded(bench: BenchFolder, source: CaptureSource) -> Path:
    """Folder of the capture; a staged one is made by the first cell that needs it.

    Raises `DataError` where a recording is another one than when the bench began: figures of two
    captures would stand in one row.
    """
    if source.stage is None:
        description = source.path / "capture.json"
        there = fingerprint_of_file(description) if description.is_file() else "nothing"
        if there != source.fingerprint:
            raise DataError(
                f"{description}: changed since this bench began, expected the same capture for all "
                f"rows; stop it, remove {bench.path} or choose another --out, and begin anew."
            )
        return source.path
    make = partial(stage, source.path, source.stage, progress=False)
    return _made(bench, source.path, source.fingerprint, make)


def _made(bench: BenchFolder, path: Path, fingerprint: str, make: Callable[[], object]) -> Path:
    """A folder in `BenchFolder.captures`, made where it is not there yet.

    ``fingerprint`` is of what it is made of; a `DataError` where it was made of something else.
    """
    with exclusive(bench.lock_of(f"captures/{path.name}")):
        maker = bench.maker_of(path)
        if not path.exists():
            write_json(maker, {"fingerprint": fingerprint})
            make()
        elif maker.exists():
            of = read_record(maker, {"fingerprint": str}, "remove the file")["fingerprint"]
            if of != fingerprint:
                raise DataError(
                    f"{path}: was made by other settings or of another capture than this row asks "
                    f"for; remove {bench.path} or choose another --out, and begin anew."
                )
    return path


def _restored(bench: BenchFolder, recorded: Capture, cell: Cell) -> Path:
    """Folder of what is trained on: restored once for all rows that want it so."""
    if cell.restore is None:
        return recorded.path
    path = restored_at(bench, cell)
    make = partial(restore_capture, recorded.path, path, method=cell.restore, policy=cell.policy)
    return _made(bench, path, cell.capture.fingerprint, make)


def restored_at(bench: BenchFolder, cell: Cell) -> Path:
    """Folder of the restored capture that a cell with a restorer trains on, made or not yet."""
    assert cell.restore is not None
    # What restorers see and is not the default.
    asked = [
        f"{name}-{value}"
        for name in ("held_out_events", "thresholds")
        if (value := getattr(cell.policy, name)) != getattr(Policy(), name)
    ]
    return bench.captures / "-".join((cell.capture.name, cell.restore, *asked))


def _peak_memory_mb() -> float:
    """Peak memory of this process so far, MB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1 << 20 if sys.platform == "darwin" else 1 << 10)
