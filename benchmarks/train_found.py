"""Training with poses that were found against training with the given ones.

    python benchmarks/train_found.py CAPTURE … --found FOLDER [--iterations 400]
        [--rows given events hidden keypoints ...] [--out FOLDER]

FOLDER holds the captures that `find_poses.py --refine --out FOLDER` wrote of each CAPTURE (with
``--held-out-events`` for `events`; with ``--keypoints-px`` for `keypoints`). Rows: `given` poses;
found ones and `events` of held-out frames, in training as well; found ones with these `hidden` in
training; poses fitted to true joints with noise (`keypoints`), with events. Printed: PSNR of the
person's pixels, dB, at held-out and at training times (`evaluate --split train`), and how far each
row stays below `given`. A run that exists is not made again. The last line is one JSON object.
"""

import argparse
import json
from pathlib import Path

import evsplat as ev
from evsplat.options.runs import Split

_EVENTS = ("policy.held_out_events=true", "pose.events_of_held_out=true")
ROWS: dict[str, tuple[str | None, tuple[str, ...]]] = {
    "given": (None, ()),
    "events": ("fit_refined", _EVENTS),
    "hidden": ("fit_refined", ()),
    "keypoints": ("fit to true joints_refined", _EVENTS),
}


def trained(capture: Path, run: Path, settings: tuple[str, ...], iterations: int) -> dict:
    """PSNR of the person's pixels by split, dB."""
    found = {}
    files: dict[Split, str] = {"test": "metrics.json", "train": "metrics_train.json"}
    for split, name in files.items():
        if not (run / name).exists():
            if not run.exists():
                ev.train(capture, out=run, iterations=iterations, overrides=settings)
            ev.evaluate(run, split=split)
        metrics = json.loads((run / name).read_text("utf-8"))
        found[split] = float(metrics["protocols"]["standard"]["person_mask"]["psnr"])
    return found


def main() -> None:
    """Train what is left, and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--found", type=Path, required=True)
    parser.add_argument("--iterations", type=int, default=400)
    parser.add_argument("--rows", nargs="*", default=list(ROWS), choices=list(ROWS))
    parser.add_argument("--out", type=Path, default=Path("bench/train_found"))
    options = parser.parse_args()
    results: dict[str, dict[str, dict[str, float]]] = {}
    for path in options.captures:
        rows = results[path.name] = {}
        for row in options.rows:
            stage, settings = ROWS[row]
            capture = path if stage is None else options.found / f"{path.name}_{stage}"
            rows[row] = trained(
                capture, options.out / f"{path.name}-{row}", settings, options.iterations
            )
            given = rows.get("given", {})
            values = ", ".join(
                f"{split} {value:.2f}" + (f" ({value - given[split]:+.2f})" if given else "")
                for split, value in rows[row].items()
            )
            print(f"{path.name:32} {row:10} {values}", flush=True)
    print(json.dumps(results))


if __name__ == "__main__":
    main()
