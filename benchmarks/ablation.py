"""What each part of method `evsplat` is worth: from `paper` upwards, one part at a time.

    python benchmarks/ablation.py [--captures CAPTURE ...] [--seeds S ...] [--iterations N]
        [--only ROW ...] [--jobs N] [--out FOLDER]

Runs the suite `ablation.yaml` beside this file (rows with a + build on the one before, the others
on evsplat) and prints the PSNR of held-out frames, mean over captures ± spread over seeds, and the
minutes of training. Goes on where it was stopped; the folder has the full tables. The last line is
one JSON object.
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import evsplat as ev
from evsplat.benching.figures import Record, Records
from evsplat.benching.folder import BenchFolder
from evsplat.benching.plan import make_plan
from evsplat.benching.suite import read_suite

SUITE = Path(__file__).with_name("ablation.yaml")
REGIONS = {"full": "full", "crop": "person_crop", "mask": "person_mask"}


def psnr(region: str) -> Callable[[Record], float | None]:
    """Reads a record's mean PSNR over test frames, protocol `standard`."""
    return lambda record: record["protocols"]["standard"][region]["psnr"]


def minutes(record: Record) -> float:
    """Of training."""
    return record["train_seconds"] / 60


def main() -> None:
    """Run what is left and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--captures", nargs="*", default=[])
    parser.add_argument("--out", type=Path, default=Path("bench/ladder"))
    parser.add_argument("--iterations", type=int)
    parser.add_argument("--seeds", nargs="*", type=int, default=[])
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--jobs", type=int)
    options = vars(parser.parse_args())
    folder = BenchFolder(ev.bench(SUITE, **options))
    del options["out"], options["jobs"]
    plan = make_plan(read_suite(SUITE), folder, **options)
    records = Records.read(plan, folder)
    print(f"{'':48} {'full':>13} {'crop':>13} {'mask':>13}   min")
    figures = {}
    for row in plan.suite.rows:
        found = {
            name: records.figure(row.name, psnr(region), records.captures)
            for name, region in REGIONS.items()
        }
        time = records.figure(row.name, minutes, records.captures)
        if time is None:
            continue
        cells = [
            "" if f is None else f"{f.mean:.2f}" + ("" if f.spread is None else f" ±{f.spread:.2f}")
            for f in found.values()
        ]
        print(f"{row.title:48} " + " ".join(f"{cell:>13}" for cell in cells), f"{time.mean:5.1f}")
        figures[row.name] = {
            **{f"{name}_psnr_db": f.mean for name, f in found.items() if f is not None},
            "train_minutes": time.mean,
            "captures": sum(bool(records.of(one, row.name)) for one in records.captures),
        }
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
