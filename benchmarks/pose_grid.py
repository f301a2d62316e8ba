"""The default treatment of given poses against forced settings, on captures drawn at random.

    python benchmarks/pose_grid.py [--captures 24] [--seed 0] [--iterations 400] [--out FOLDER]
        [--characters NAME ...] [--only ROW ...]

Each capture is staged (128 px) with a character, motion, frame rate, exposure, sensor and level of
pose errors drawn at random, and trained by each row: `default`; `unsaid`, the default where the
capture doesn't say how far its poses err; the default's forced settings; `paper`. A row that comes
to the same composition and start as an earlier one is not trained again. Printed: PSNR of the
person's pixels in held-out frames, dB, and how far `default` and `unsaid` stay behind the best of
the forced settings and behind `paper`. What exists is not made again, so a grid can be stopped and
gone on with. The last line is one JSON object.
"""

import argparse
import json
import shutil
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

import evsplat as ev
from evsplat.body.motion import load_motion
from evsplat.capture import Policy, load_capture
from evsplat.methods.evsplat import EvsplatConfig
from evsplat.methods.poses import prepare_poses
from evsplat.staging.assets import characters, find_motion, motions

FORCED = {
    "never": ("pose.smooth=never", "pose.refine=never"),
    "refine": ("pose.smooth=never", "pose.refine=always"),
    "both": ("pose.smooth=always", "pose.refine=always"),
}
ROWS: dict[str, tuple[str, tuple[str, ...]]] = {
    **{name: ("evsplat", settings) for name, settings in FORCED.items()},
    "paper": ("paper", ()),
    "default": ("evsplat", ()),
    "unsaid": ("evsplat", ()),
}
STATED = ("pose_std_rad", "transl_std_m")
NOISE = ("none", "mocap", "estimated", "estimated-blurry")
RATES = (12.5, 15.0, 20.0, 25.0)
LEAST_FRAMES = 16
"""Of short motions; the rate is raised until there are as many, or is the highest."""
CLOSE_DB = 0.2
"""Behind the best of the forced settings by no more than this counts as close."""


def draw(rng: np.random.Generator, people: list[str], frames: int) -> dict[str, Any]:
    """Settings of one staged capture."""
    fps = float(rng.choice(RATES))
    character, motion = str(rng.choice(people)), str(rng.choice(motions()))
    lasts_s = float(np.ptp(load_motion(find_motion(motion)).times_us)) * 1e-6
    if int(lasts_s * fps) < LEAST_FRAMES:
        fps = next((rate for rate in RATES if int(lasts_s * rate) >= LEAST_FRAMES), RATES[-1])
    return {
        "character": character,
        "motion": motion,
        "fps": fps,
        "frames": min(frames, int(lasts_s * fps)),
        "exposure_ms": float(rng.uniform(0.3, 0.9) * min(1000 / fps, 80)),
        "yaw_deg": float(rng.uniform(0, 360)),
        "events": str(rng.choice(["clean", "davis346", "dvxplorer", "evk4"])),
        "pose_noise": str(rng.choice(NOISE)),
        "seed": int(rng.integers(1 << 30)),
    }


def without_errors(capture: Path) -> Path:
    """The capture again, as one that doesn't say how far its poses err."""
    copy = capture.with_name(f"{capture.name}_unsaid")
    if not copy.exists():
        part = capture.with_name(f".{copy.name}")
        shutil.copytree(capture, part, dirs_exist_ok=True)
        stated = json.loads((part / "capture.json").read_text("utf-8"))
        del stated["body"]["source"]
        (part / "capture.json").write_text(json.dumps(stated), "utf-8")
        with np.load(part / "body.npz") as file:
            kept = {name: file[name] for name in file if name not in STATED}
        np.savez(part / "body.npz", **kept)
        part.rename(copy)
    return copy


def same_as(row: str, capture: Path, pose_noise: str) -> str:
    """The row whose composition and start ``row`` comes to."""
    if row == "default":
        return "never" if pose_noise == "none" else "both"
    if row == "unsaid" and taken_as_exact(without_errors(capture)):
        return "never"
    return row


def taken_as_exact(capture: Path) -> bool:
    """Whether training takes the poses of a capture as exact; kept in a file beside it."""
    kept = capture.with_suffix(".exact.json")
    if not kept.exists():
        shown = load_capture(capture).for_training(Policy())
        poses = prepare_poses(EvsplatConfig().pose, shown, fit=True)
        exact = poses.correction is None or bool(poses.correction.exact)
        kept.write_text(json.dumps(exact), "utf-8")
    return bool(json.loads(kept.read_text("utf-8")))


def trained(capture: Path, run: Path, row: str, iterations: int) -> float:
    """PSNR of the person's pixels in held-out frames, dB, of a run that is made if it is not."""
    method, settings = ROWS[row]
    if row == "unsaid":
        capture = without_errors(capture)
    if not (run / "metrics.json").exists():
        if run.exists():
            ev.train(capture, out=run, resume=True)
        else:
            ev.train(capture, method=method, out=run, iterations=iterations, overrides=settings)
        ev.evaluate(run)
    found = json.loads((run / "metrics.json").read_text("utf-8"))
    return float(found["protocols"]["standard"]["person_mask"]["psnr"])


def main() -> None:
    """Stage and train what is left, and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--captures", type=int, default=24)
    parser.add_argument("--frames", type=int, default=32)
    parser.add_argument("--iterations", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--characters", nargs="*", default=list(characters()))
    parser.add_argument("--only", nargs="*", default=list(ROWS), choices=list(ROWS))
    parser.add_argument("--out", type=Path, default=Path("bench/pose_grid"))
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    behind: defaultdict[str, list[float]] = defaultdict(list)
    print(f"{'capture':44}" + "".join(f"{row:>9}" for row in options.only))
    for number in range(options.captures):
        settings = draw(rng, options.characters, options.frames)
        capture = options.out / f"capture_{options.seed}_{number:02d}"
        if not capture.exists():
            ev.stage(capture, width=128, progress=False, **settings)
        found = {
            row: trained(
                capture, options.out / "runs" / f"{capture.name}-{same}", same, options.iterations
            )
            for row in options.only
            for same in [same_as(row, capture, settings["pose_noise"])]
        }
        said = " ".join(str(settings[key]) for key in ("character", "motion", "fps", "pose_noise"))
        print(f"{said:44}" + "".join(f"{value:9.2f}" for value in found.values()), flush=True)
        for row in options.only:
            if row in FORCED or row == "paper":
                continue
            if forced := FORCED.keys() & found.keys():
                best = max(found[name] for name in forced)
                behind[f"{row}_best_forced"].append(best - found[row])
                if settings["pose_noise"] == "none" and "never" in forced:
                    behind[f"{row}_never_of_exact"].append(found["never"] - found[row])
            if "paper" in found:
                behind[f"{row}_paper"].append(found["paper"] - found[row])
    figures: dict[str, float] = {"captures": options.captures}
    for name, values in behind.items():
        figures[f"{name}_behind_most_db"] = round(max(values), 3)
        figures[f"{name}_behind_mean_db"] = round(float(np.mean(values)), 3)
        close = np.mean(np.array(values) <= CLOSE_DB)
        figures[f"{name}_within_{CLOSE_DB}_db_ratio"] = round(float(close), 3)
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
