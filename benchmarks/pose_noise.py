"""What noise of the given poses costs method `evsplat`, and what it gets back.

    python benchmarks/pose_noise.py CAPTURE [--noise-rad 0.03] [--iterations N]
        [--set KEY=VALUE ...] [--only ROW ...] [--out FOLDER]

Adds independent noise to every joint of every key pose and trains on exact poses, on noisy ones as
they are, and with what `pose.*` does about them. Printed per row, for training and for held-out
frames: PSNR of the person against the sharp truth, and the share of the loss that is got back,
``(row - noisy) / (exact - noisy)``. The last line is one JSON object.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

import evsplat as ev
from evsplat.capture import Capture, load_capture
from evsplat.capture.derive import derived_capture
from evsplat.evaluation.protocols import eight_bit
from evsplat.similarity.psnr_ssim import psnr

AS_GIVEN = ("pose.smooth=never", "pose.refine=never")
ROWS: dict[str, tuple[bool, tuple[str, ...]]] = {
    "exact": (False, AS_GIVEN),
    "exact_refined": (False, ("pose.smooth=never", "pose.refine=always")),
    "noisy": (True, AS_GIVEN),
    "smoothed": (True, ("pose.smooth=always", "pose.refine=never")),
    "refined": (True, ("pose.smooth=never", "pose.refine=always")),
    "default": (True, ()),
    "default_held_out_events": (
        True,
        ("policy.held_out_events=true", "pose.events_of_held_out=true"),
    ),
}
"""Whether poses are noisy, and settings."""


def write_noisy(source: Capture, path: Path, noise_rad: float, seed: int) -> None:
    """The capture with key poses off by Gaussian noise each, radians per axis, which say so."""
    with derived_capture(source, path) as making:
        file = making.folder / source.body_file.path.name
        with np.load(file) as archive:
            body = dict(archive)
        exact = Rotation.from_rotvec(body["poses"].reshape(-1, 3).astype(np.float64))
        noise = noise_rad * np.random.default_rng(seed).normal(size=(len(exact), 3))
        turned = (exact * Rotation.from_rotvec(noise)).as_rotvec()
        body["poses"] = turned.reshape(body["poses"].shape).astype(np.float32)
        body["pose_std_rad"] = np.full(body["poses"].shape[:2], noise_rad, np.float32)
        body["transl_std_m"] = np.full((len(body["poses"]), 3), 1e-3, np.float32)
        making.document["body"]["source"] = "estimated"
        file.unlink()  # it may be a hard link, and what it is linked to must stay
        np.savez(file, **body)


@torch.no_grad()
def person_psnr(run_path: Path) -> dict[str, float]:
    """Mean PSNR of the person's pixels at mid-exposure, dB, of training and held-out frames."""
    run = ev.load_run(run_path)
    found: dict[str, list[float]] = {"train": [], "test": []}
    for frame in run.capture.frames:
        truth, mask = run.capture.sharp(frame), run.capture.mask(frame)
        if truth is None or mask is None:
            continue
        drawn = run.reconstruction.render(run.capture.camera(frame), [frame.mid_us]).rgb[0]
        found[frame.split].append(float(psnr(eight_bit(drawn.cpu()), truth, mask=mask > 0.5)))
    return {split: float(np.mean(values)) for split, values in found.items()}


def main() -> None:
    """Train what is left, and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--noise-rad", type=float, default=0.03, help="per axis")
    parser.add_argument("--iterations", type=int, default=1_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE")
    parser.add_argument("--only", nargs="*", default=list(ROWS), choices=list(ROWS))
    parser.add_argument("--out", type=Path, default=Path("bench/pose_noise"))
    options = parser.parse_args()
    noisy = options.out / "noisy_capture"
    if not noisy.exists():
        write_noisy(load_capture(options.capture), noisy, options.noise_rad, options.seed)
    figures: dict[str, dict[str, float]] = {}
    for name in options.only:
        is_noisy, settings = ROWS[name]
        run = options.out / name
        capture = noisy if is_noisy else options.capture
        if run.exists():
            ev.train(capture, out=run, resume=True, threads=options.threads)
        else:
            ev.train(
                capture,
                method="evsplat",
                out=run,
                iterations=options.iterations,
                threads=options.threads,
                seed=options.seed,
                overrides=(*options.set, *settings),
            )
        figures[name] = person_psnr(run)
    print(f"{'':24} {'train dB':>9} {'back':>6} {'held-out dB':>12} {'back':>6}")
    known = {"exact", "noisy"} <= figures.keys()
    results: dict[str, float] = {}
    for name, found in figures.items():
        line = f"{name:24}"
        for split, width in (("train", 9), ("test", 12)):
            results[f"{name}_{split}_mask_psnr_db"] = round(found[split], 3)
            line += f" {found[split]:{width}.2f}"
            if known and ROWS[name][0]:
                lost = figures["exact"][split] - figures["noisy"][split]
                share = (found[split] - figures["noisy"][split]) / lost
                results[f"{name}_{split}_recovered_ratio"] = round(share, 3)
                line += f" {share:6.0%}"
            else:
                line += " " * 7
        print(line)
    print(json.dumps({"noise_rad": options.noise_rad, **results}))


if __name__ == "__main__":
    main()
