"""A run's person from eight directions in other motions: speckle, holes and shreds.

    python benchmarks/directions.py RUN [--motions NAME ...] [--times 4] [--size 360]
        [--learned] [--out FOLDER]

The person alone, as films show them, every 45 degrees around the body of each motion. Printed for
each motion, over the directions: *speckle*, the mean step of Cb and Cr from pixel to pixel inside
the body's outline in one direction against that from the front, the larger of the three directions
behind (135 to 225 degrees) and of all; *holes*, the share of the outline's inside through which one
sees (opacity below a half); *shreds*, the share of what is drawn that lies farther from the outline
than 4 % of the picture's height, where clothes and hair are not. ``--learned`` shows what was
learned, before the sides that nothing showed were filled. FOLDER/MOTION.png is a sheet, a row per
time, a column per direction. The last line is one JSON object.
"""

import argparse
import json
import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import binary_dilation, binary_erosion, distance_transform_edt

from evsplat.body import silhouette, up_axis
from evsplat.camera import Camera
from evsplat.evaluation.chroma import chroma
from evsplat.film.following import follow
from evsplat.film.motion import load_motion_of
from evsplat.pictures import to_bytes
from evsplat.pictures.files import save_png
from evsplat.training.checkpoint import load_checkpoint, load_latest, load_model
from evsplat.training.run import Run, load_run

MOTIONS = ("walk", "run", "jump", "kick", "spin", "dance_a")
DIRECTIONS = 8
BEHIND = (3, 4, 5)
OUTSIDE = 0.04
"""Of the picture's height: clothes and hair reach as far beyond the bare body."""
_INSET_PX = 2
_GREY = 0.75


def sized(camera: Camera, height: int) -> Camera:
    """A camera of square pictures."""
    K = camera.K * (height / camera.height)
    K[0, 2], K[1, 2], K[2, 2] = height / 2, height / 2, 1
    return replace(camera, width=height, height=height, K=K)


def turned_by(angle: float, share: float) -> float:
    """The same angle all the time."""
    return angle


def steps(rgb: torch.Tensor, inside: np.ndarray) -> float:
    """Mean absolute step of Cb and Cr between neighbouring pixels, both ``inside``."""
    values = chroma(rgb).numpy()
    found = []
    for axis in (0, 1):
        both = inside & np.roll(inside, -1, axis)
        found.append(np.abs(np.roll(values, -1, axis) - values)[both])
    return float(np.concatenate(found).mean())


def measured(run: Run, motion: str, options: argparse.Namespace) -> dict[str, float]:
    """Figures of a motion; its sheet is written."""
    recorded = run.reconstruction.track
    track = load_motion_of(motion, recorded, fps=None, in_place=True)
    drawn = run.reconstruction.following(track)
    first, last = int(track.times_us[0]), int(track.times_us[-1])
    times = np.linspace(first, last, options.times + 2)[1:-1].astype(int).tolist()
    start = sized(run.capture.camera(run.capture.train_frames[0]), options.size)
    speckle = np.zeros((len(times), DIRECTIONS))
    holes, shreds, rows = [], [], []
    for row, time in enumerate(times):
        pictures = []
        for column in range(DIRECTIONS):
            angle = 2 * math.pi * column / DIRECTIONS
            camera = follow(start, track, [time], up_axis(recorded), partial(turned_by, angle))[0]
            shown = drawn.render(camera, [time], parts="human")
            alpha = shown.alpha[0].numpy()
            outline = silhouette(track.vertices(time), track.body.faces, camera).numpy()
            inside = binary_erosion(outline, iterations=_INSET_PX)
            speckle[row, column] = steps(shown.rgb[0], inside)
            holes.append(float((alpha[inside] < 0.5).mean()))
            away = distance_transform_edt(~binary_dilation(outline)) > OUTSIDE * options.size
            shreds.append(float(alpha[away].sum() / alpha.sum()))
            pictures.append(shown.rgb[0] + _GREY * (1 - shown.alpha[0][..., None]))
        rows.append(torch.cat(pictures, 1))
    save_png(options.out / f"{motion}.png", to_bytes(torch.cat(rows).clamp(0, 1)))
    front = speckle[:, :1].mean()
    against = speckle.mean(0) / front
    return {
        "speckle_behind_ratio": round(float(against[list(BEHIND)].max()), 3),
        "speckle_most_ratio": round(float(against.max()), 3),
        "holes_mean_pct": round(100 * float(np.mean(holes)), 3),
        "holes_most_pct": round(100 * float(np.max(holes)), 3),
        "shreds_mean_pct": round(100 * float(np.mean(shreds)), 3),
        "shreds_most_pct": round(100 * float(np.max(shreds)), 3),
    }


def main() -> None:
    """Draw, measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, metavar="RUN")
    parser.add_argument("--motions", nargs="+", default=list(MOTIONS))
    parser.add_argument("--times", type=int, default=4)
    parser.add_argument("--size", type=int, default=360)
    parser.add_argument("--learned", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("bench/directions"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    run = load_run(options.run)
    if options.learned:
        latest = load_latest(options.run / "checkpoints")
        assert latest is not None
        tensors, state = load_checkpoint(latest[0])
        load_model(run.reconstruction.model, tensors, state["human_count"])
    found = {}
    for motion in options.motions:
        found[motion] = measured(run, motion, options)
        print(f"{motion:10}", *(f"{name} {value:.2f} " for name, value in found[motion].items()))
    keys = found[options.motions[0]]
    worst = {key: max(values[key] for values in found.values()) for key in keys}
    print(json.dumps({"worst": worst, "motions": found}))


if __name__ == "__main__":
    main()
