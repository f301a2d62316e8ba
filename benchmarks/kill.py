"""Interruptions of every verb that writes: nothing is damaged, nothing left, all goes on.

python benchmarks/kill.py [--count N] [--seconds S] [--seed S] [--only JOB] [--kind KIND]

Each command is stopped at a random moment: by SIGKILL, by SIGTERM, by Ctrl-C, by a disk that fills
up, by a limit on the size of files, by calls of the system that fail. A failure is printed: an exit
code other than that of the interruption, a traceback, a changed input, an output that is neither
whole nor absent, a temporary file that is left, a second run that does not end as one that nothing
happened to, in every tensor and byte. A file system of its own, for a full disk, needs root. The
last line is JSON; the exit code is 1 where something failed.
"""

import argparse
import hashlib
import json
import random
import re
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import torch
import yaml

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]
from interruption import KINDS, Disk, Interruption, Outcome, Usual, run  # noqa: E402
from tests.benching.helpers import untimed  # noqa: E402
from tests.conftest import write_tiny_capture  # noqa: E402
from tests.small_model import SMALL  # noqa: E402

from evsplat.training import loop  # noqa: E402

EXPECTED = {
    "kill": {-9},
    "term": {130, -15},
    "int": {130},
    "twice": {130},
    "full": {2},
    "limit": {2},
    "fault": {2},
}
"""Exit codes of what was interrupted; 0 where it came too late."""
IMPORTED = (
    "benching.run evaluation.run events.convert export footage.simulate importers inspection "
    "masks.capture posing restore.capture staging synthesis training"
).split()
LEFT = re.compile(
    r"\.evsplat-|(^|/)\.?tmp|\.(watch|evaluating|filming|inspecting|part|partial)$|snapshot\.safetensors$"
)
EVALUATION = rb"evaluation</[^>]*>\s*<[^>]*>[^<]*"
"""What a report tells of the time that it took."""
NOT_FOUND_OUT = re.compile(r"Traceback \(most recent|Exception ignored|Segmentation|core dumped")


@dataclass(frozen=True)
class Job:
    """A command and what it makes in the folder that it works in."""

    command: tuple[str, ...]
    out: str
    again: tuple[str, ...] | None = None
    """The command that goes on, where it is another one."""
    goes_on: str = ""
    """File in ``out`` by which a first run can be gone on with."""
    prepare: Callable[[], None] = lambda: None
    parts: bool = False
    """Whether it ends well with parts that failed, which it lists."""
    keeps: str = "a^"
    """Left-overs, a pattern, that are there to go on from after an orderly end."""


def save_after_every_step() -> None:
    """Checkpoints have no time between them."""
    loop.CHECKPOINT_SECONDS = 0.0


def copied(source: Path) -> Callable[[], None]:
    """What a command changes in place is there, if it is the first to run."""

    def copy() -> None:
        target = Path(source.name)
        if source.is_dir() and not target.exists():
            shutil.copytree(source, target)
        elif not target.exists():
            shutil.copyfile(source, target)

    return copy


def jobs(given: Path) -> dict[str, Job]:
    """Commands by name; ``given`` holds what they read."""
    capture, run_folder = str(given / "capture"), str(given / "run")
    small = SMALL["evsplat"]
    train = ("train", capture, "--no-evaluate", "--threads", "1", "--device", "cpu")
    start = (*train, "--out", "run", "--iterations", "12", "--set", *small)
    on = (*train, "--out", "run", "--iterations", "12", "--resume")
    export = ("export", run_folder)
    still = ("--frame", "0003", "--device", "cpu")
    render = ("render", run_folder, "--device", "cpu", "--out")
    film = (*render, "made/a.mp4", "--show", "events", "--events", "made/a.h5")
    bench = ("bench", str(given / "suite.yaml"), "--out", "made", "--device", "cpu")
    pictures = (str(given / "capture" / "images"), "--source-fps", "200", "--out")
    synthesize = ("synthesize", *pictures, "made", "--fps", "50", "--upsample", "2")

    def in_place(*words: str, source: Path) -> Job:
        return Job(words, source.name, words, prepare=copied(source))

    return {
        "train": Job(start, "run", on, "config.yaml", save_after_every_step),
        "train-seldom": Job(start, "run", on, "config.yaml"),
        "evaluate": in_place("evaluate", "run", "--device", "cpu", source=given / "run"),
        "report": in_place("report", "evaluated", source=given / "evaluated"),
        "inspect": Job(("inspect", capture), "inspect/capture", ("inspect", capture)),
        "simulate": Job(("simulate", *pictures, "made.h5"), "made.h5"),
        "synthesize": Job(synthesize, "made"),
        "import": Job(("import", "neuman", str(given / "neuman"), "--out", "made"), "made"),
        "stage": Job(("stage", "made", "--size", "48", "--frames", "3", "--threads", "1"), "made"),
        "convert-h5": Job(("convert", str(given / "long.csv"), "made.h5"), "made.h5"),
        "convert-npz": Job(("convert", str(given / "long.csv"), "made.npz"), "made.npz"),
        "convert-csv": Job(("convert", str(given / "long.h5"), "made.csv"), "made.csv"),
        "convert-in-place": in_place(
            "convert", "long.csv", "--in-place", "--from-zero", source=given / "long.csv"
        ),
        "convert-raw": Job(("convert", str(given / "long.h5"), "made.raw"), "made.raw"),
        "export-ply": Job((*export, "ply", *still, "--out", "made.ply"), "made.ply"),
        "export-gltf": Job((*export, "gltf", *still, "--out", "made.glb"), "made.glb"),
        "export-html": Job((*export, "html", "--device", "cpu", "--out", "made.html"), "made.html"),
        "export-avatar": Job((*export, "avatar", "--device", "cpu", "--out", "made"), "made"),
        "render-video": Job((*render, "made.mp4"), "made.mp4", keeps=r"made\.mp4\.partial$"),
        "render-pictures": Job((*render, "made"), "made", keeps=r"made\.partial$"),
        "render-events": Job(film, "made", film, keeps=r"made/a\.mp4\.partial$"),
        "masks": Job(("masks", capture, "--out", "made", "--with", "silhouette"), "made"),
        "restore": Job(("restore", capture, "--out", "made", "--with", "edi"), "made"),
        "poses": Job(
            ("poses", str(given / "unposed" / "capture"), "--out", "made", "--refine", "0")
            + ("--keypoints", str(given / "unposed" / "points.npz"), "--threads", "1"),
            "made",
        ),
        "bench": Job(bench, "made", (*bench, "--retry"), keeps=r"made/runs/", parts=True),
    }


def main() -> None:
    """Interrupt until the count or the time is over."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=10**9)
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", help="one job, or several with commas")
    parser.add_argument("--kind", help=f"one of {', '.join(KINDS)}, or several with commas")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    for module in IMPORTED:
        import_module(f"evsplat.{module}")
    rng = random.Random(asked.seed)
    place = Path(tempfile.mkdtemp(prefix="kill-"))
    try:
        given = place / "given"
        every = jobs(given)
        names = asked.only.split(",") if asked.only else list(every)
        chosen = {name: every[name] for name in names}
        make_inputs(given, place)
        started, failures = time.monotonic(), []
        counts: Counter[str] = Counter()
        benches = {name: Bench(name, job, given, place) for name, job in chosen.items()}
        kinds = asked.kind.split(",") if asked.kind else list(KINDS)
        # A job that takes long is interrupted as often as its time allows.
        weights = [1 / bench.usual.seconds**0.5 for bench in benches.values()]
        while sum(counts.values()) < asked.count and time.monotonic() - started < asked.seconds:
            name = rng.choices(list(benches), weights)[0]
            what = Interruption.random(rng.choice(kinds), rng)
            wrong = benches[name].interrupted(what)
            counts[f"{name} {what.kind}"] += 1
            failures += [f"{name}, {what}: {text}" for text in wrong]
            for text in wrong:
                print(f"FAILED {name}, {what}: {text}", flush=True)
        print(json.dumps(summary(counts, benches, failures, time.monotonic() - started)))
    finally:
        shutil.rmtree(place, ignore_errors=True)
    sys.exit(1 if failures else 0)


def summary(
    counts: Counter[str], benches: "dict[str, Bench]", failures: list[str], seconds: float
) -> dict[str, object]:
    """What the last line says."""
    by_job: Counter[str] = Counter()
    by_kind: Counter[str] = Counter()
    for both, count in counts.items():
        name, kind = both.rsplit(" ", 1)
        by_job[name] += count
        by_kind[kind] += count
    return {
        "interruptions": sum(counts.values()),
        "in_time": sum(bench.in_time for bench in benches.values()),
        "failures": len(failures),
        "jobs": dict(by_job),
        "kinds": dict(by_kind),
        "seconds": round(seconds),
    }


def make_inputs(given: Path, place: Path) -> None:
    """Captures with poses and without, a trained run, recordings, a data set, a suite."""
    import numpy as np
    from tests.fuzzing.readers import write_unposed
    from tests.importers import trees

    from evsplat.events import EventStream, write_events

    given.mkdir()
    write_tiny_capture(given / "capture", frames=10)
    trees.write_neuman(given / "neuman")
    (given / "unposed").mkdir()
    write_unposed(given / "unposed")
    generator = np.random.default_rng(0)
    count = 200_000
    t = np.sort(generator.integers(0, 10**7, count))
    x, y = generator.integers(0, 64, (2, count)).astype(np.uint16)
    p = np.where(generator.random(count) < 0.5, 1, -1).astype(np.int8)
    for suffix in ("csv", "h5"):
        write_events(given / f"long.{suffix}", EventStream(t, x, y, p), width=64, height=64)
    rows = [
        {"name": "small", "method": "evsplat", "settings": list(SMALL["evsplat"])},
        {"name": "median", "method": "median_background"},
    ]
    suite = {"name": "tiny", "iterations": 6, "rows": rows}
    suite["captures"] = [{"name": "capture", "path": str(given / "capture")}]
    (given / "suite.yaml").write_text(yaml.safe_dump(suite))
    with closing(Disk(place / "first")) as disk:
        ended = run(list(jobs(given)["train"].command), disk)
        assert ended.code == 0, ended.said
        shutil.copytree(disk.path / "run", given / "run")
        ended = run(["evaluate", "run", "--device", "cpu"], disk)
        assert ended.code == 0, ended.said
        shutil.copytree(disk.path / "run", given / "evaluated")


class Bench:
    """One job, how it usually goes, and what interruptions make of it."""

    def __init__(self, name: str, job: Job, given: Path, place: Path) -> None:
        self.name, self.job, self.given, self.place = name, job, given, place
        self.inputs = digests(given)
        self.number = self.in_time = 0
        with closing(Disk(place / f"{name}-whole")) as disk:
            ended = run(list(job.command), disk, prepare=job.prepare)
            assert ended.code == 0, f"{name}: {ended.said}"
            self.expected = made(disk.path / job.out)
            sizes = [file.stat().st_size for file in disk.path.rglob("*") if file.is_file()]
            self.usual = Usual(ended.seconds, ended.calls, max(sizes))
        print(f"{name}: {ended.seconds:.2f} s, {ended.calls} calls that write", flush=True)

    def interrupted(self, what: Interruption) -> list[str]:
        """Run, interrupt, run again; what is wrong."""
        self.number += 1
        with closing(Disk(self.place / f"{self.name}-{self.number}")) as disk:
            wrong = self._interrupted(what, disk)
        shutil.rmtree(disk.path, ignore_errors=True)
        return wrong

    def _interrupted(self, what: Interruption, disk: Disk) -> list[str]:
        job = self.job
        first = run(
            list(job.command),
            disk,
            prepare=job.prepare,
            interruption=what,
            usual=self.usual,
        )
        wrong = _wrong_end(first, EXPECTED[what.kind])
        self.in_time += first.code != 0
        if digests(self.given) != self.inputs:
            wrong.append("an input has changed")
        if first.code != -9:
            wrong += self._left_overs(disk.path, job.keeps)
        out = disk.path / job.out
        whole = out.exists() and made(out) == self.expected
        if whole or (first.code == 0 and not job.parts) or (out.exists() and job.again is None):
            return wrong if whole else [*wrong, "what is there is not whole"]
        on = job.again is not None and (out / job.goes_on).exists()
        command = job.again if on and job.again is not None else job.command
        second = run(list(command), disk, prepare=job.prepare)
        if second.code != 0:
            return [*wrong, f"the second run ends with {second.code}: {second.said[-600:]}"]
        wrong += _wrong_end(second, set())
        if made(out) != self.expected:
            differing = different(made(out), self.expected)
            wrong.append(f"the second run makes something else: {differing}")
        return wrong + self._left_overs(disk.path, "a^")

    def _left_overs(self, folder: Path, keeps: str) -> list[str]:
        left = [path.relative_to(folder).as_posix() for path in folder.rglob("*")]
        found = [name for name in left if LEFT.search(name) and not re.search(keeps, name)]
        return [f"left: {', '.join(found[:5])}"] if found else []


def _wrong_end(ended: Outcome, expected: set[int]) -> list[str]:
    wrong = []
    if ended.code not in expected | {0}:
        wrong.append(f"ended with {ended.code}: {ended.said[-4000:]}")
    elif NOT_FOUND_OUT.search(ended.said):
        wrong.append(f"said: {ended.said[-3000:]}")
    elif ended.code == 2 and ended.said.count("evsplat: ") != 1:
        wrong.append(f"not one sentence: {ended.said[-600:]}")
    return wrong


def digests(folder: Path) -> dict[str, str]:
    """Digest of every file below a folder, or of a file."""
    files = [folder] if folder.is_file() else sorted(folder.rglob("*"))
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
        if path.is_file()
    }


def made(out: Path) -> dict[str, str]:
    """Digests of what a command made, without what depends on the clock."""
    found = digests(out)
    for name in list(found):
        path = out / name
        if re.search(r"(^|/)(logs|locks|runs)/|evsplat-traceback|(index\.html|tables\..+)$", name):
            del found[name]
        elif path.suffix == ".safetensors":
            found[name] = tensors(path)
        elif re.search(r"(^|/)(log\.jsonl|metrics\.json|cells/.*\.json)$", name):
            lines = [untimed(json.loads(line)) for line in _documents(path)]
            found[name] = hashlib.sha256(json.dumps(lines).encode()).hexdigest()
        elif path.name == "report.html":
            page = re.sub(EVALUATION, b"", path.read_bytes())
            found[name] = hashlib.sha256(page).hexdigest()
    steps = sorted(name for name in found if name.endswith(".safetensors"))
    for name in steps[:-1]:
        del found[name]  # which ones are kept depends on when they were saved
    return found


def _documents(path: Path) -> list[str]:
    text = path.read_text()
    return text.splitlines() if path.suffix == ".jsonl" else [text]


def tensors(path: Path) -> str:
    """Digest of all tensors of a checkpoint, bit for bit."""
    from safetensors import safe_open

    digest = hashlib.sha256()
    with safe_open(path, framework="pt") as file:
        for name in sorted(file.keys()):
            digest.update(name.encode() + file.get_tensor(name).numpy().tobytes())
    return digest.hexdigest()


def different(found: dict[str, str], expected: dict[str, str]) -> str:
    """Names of files that differ."""
    names = {name for name in found | expected if found.get(name) != expected.get(name)}
    return ", ".join(sorted(names)[:5])


if __name__ == "__main__":
    main()
