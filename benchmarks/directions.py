"""A run's person from eight directions in other motions: speckle, holes and shreds.

    python benchmarks/directions.py RUN [--motions NAME ...] [--times 4] [--size 360]
        [--learned] [--out FOLDER] [--avatar --node-modules FOLDER/node_modules]

The person alone, as films show them, every 45 degrees around the body of each motion. Printed for
each motion, over the directions: *speckle*, the mean step of Cb and Cr from pixel to pixel of one
surface (depths within 5 cm) inside the body's outline in one direction against that of the recorded
motion from the recording camera's direction, which is what training saw, the larger of the three
directions behind (135 to 225 degrees) and of all; *holes*, the share of the outline's inside
through which one sees (opacity below a half); *shreds*, the share of what is drawn that lies
farther from the outline than 4 % of the picture's height, where clothes and hair are not. Of the
Gaussians themselves, not of the pictures: *size*, the largest standard deviation of one against
that at rest; *torn*, the share of those that leave a neighbour on the surface (the eight nearest,
normals within 60 degrees) by 1.5 cm and to 2.5 times its distance at rest. ``--learned`` shows what
was learned, before the sides that nothing showed were filled. ``--avatar`` looks at the exported
avatar page in headless Chromium instead (`npm install --prefix FOLDER playwright-core`).
FOLDER/MOTION.png is a sheet, a row per time, a column per direction. The last line is one JSON
object.
"""

import argparse
import json
import math
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import binary_dilation, binary_erosion, distance_transform_edt

import evsplat as ev
from evsplat.body import BodyTrack, silhouette, up_axis
from evsplat.body.rotations import quaternion_to_matrix
from evsplat.camera import Camera
from evsplat.film.following import follow
from evsplat.film.motion import load_motion_of
from evsplat.models.discs import DiscModel
from evsplat.neighbours import nearest
from evsplat.pictures import chroma, to_bytes
from evsplat.pictures.files import save_png
from evsplat.training.checkpoint import load_checkpoint, load_latest, load_model
from evsplat.training.run import Run, load_run
from export import photograph, read, seen_from

MOTIONS = ("walk", "run", "jump", "kick", "spin", "dance_a")
DIRECTIONS = 8
BEHIND = (3, 4, 5)
OUTSIDE = 0.04
"""Of the picture's height: clothes and hair reach as far beyond the bare body."""
View = tuple[int, Camera]
"""Time, microseconds, and camera."""
Picture = tuple[torch.Tensor, np.ndarray]
"""sRGB (H, W, 3) over black and opacity (H, W)."""
Draw = Callable[[BodyTrack, list[View]], list[Picture]]
ONE_SURFACE_M = 0.05
TORN_M, TORN_RATIO = 0.015, 2.5
_NEIGHBOURS = 8
_ALIKE = 0.5
_INSET_PX = 2
_GREY = 0.75


def sized(camera: Camera, height: int) -> Camera:
    """A camera of square pictures."""
    K = camera.K * (height / camera.height)
    K[0, 2], K[1, 2], K[2, 2] = height / 2, height / 2, 1
    return replace(camera, width=height, height=height, K=K)


def film_times(track: BodyTrack, count: int) -> list[int]:
    """Even times inside a motion, microseconds."""
    first, last = int(track.times_us[0]), int(track.times_us[-1])
    return np.linspace(first, last, count + 2)[1:-1].astype(int).tolist()


def turned_by(angle: float, share: float) -> float:
    """The same angle all the time."""
    return angle


def steps(rgb: torch.Tensor, depth: np.ndarray, inside: np.ndarray) -> float:
    """Mean absolute step of Cb and Cr between neighbouring pixels of one surface, both ``inside``.

    An arm before the shirt is no speckle: their depths, metres, differ.
    """
    values = chroma(rgb).numpy()
    found = []
    for axis in (0, 1):
        apart = np.abs(np.roll(depth, -1, axis) - depth)
        both = inside & np.roll(inside, -1, axis) & (apart < ONE_SURFACE_M)
        found.append(np.abs(np.roll(values, -1, axis) - values)[both])
    return float(np.concatenate(found).mean())


def by_model(run: Run, track: BodyTrack, views: list[View]) -> list[Picture]:
    """The person as films show it."""
    drawn = run.reconstruction.in_new_motion(track)
    shown = [drawn.render(camera, [time], parts="human") for time, camera in views]
    return [(picture.rgb[0], picture.alpha[0].numpy()) for picture in shown]


def by_page(
    motion: str | None, options: argparse.Namespace, track: BodyTrack, views: list[View]
) -> list[Picture]:
    """The person in the exported page: over black, and over white for its opacity."""
    with tempfile.TemporaryDirectory() as folder:
        site, out = Path(folder) / "site", Path(folder) / "pictures"
        site.mkdir()
        out.mkdir()
        page = site / "avatar.html"
        ev.export_run(options.run, "avatar", motion=motion, parts="human", out=page, device="cpu")
        first = int(track.times_us[0])
        shots = [
            {
                "page": page.name,
                "clip": 1,
                "seconds": (time - first) / 1e6,
                "timed": 0,
                "camera": seen_from(camera, np.eye(3)) | {"background": [ground] * 3},
                "picture": f"{k}-{ground}.png",
            }
            for k, (time, camera) in enumerate(views)
            for ground in (0, 1)
        ]
        photograph(options, site, shots, out)
        pictures = []
        for k in range(len(views)):
            black, white = (read(out / f"{k}-{ground}.png") for ground in (0, 1))
            pictures.append((torch.from_numpy(black), 1 - (white - black).mean(-1)))
    return pictures


@torch.no_grad()
def pulled(run: Run, track: BodyTrack, times: list[int]) -> dict[str, float]:
    """How large Gaussians of the person get in a motion, and how many leave their neighbours."""
    model = run.reconstruction.model
    assert isinstance(model, DiscModel)
    gaussians, rows = model.gaussians, model.gaussians.human
    means, rest = gaussians.means[rows], gaussians.scales_log[rows].exp().amax(-1)
    normals = model.surface.normals(means)
    apart, index = nearest(means, _NEIGHBOURS)
    alike = (normals[:, None] * normals[index]).sum(-1) > _ALIKE
    moving = run.reconstruction.in_new_motion(track).model
    sizes, torn = [], []
    for time in times:
        person = moving.at([time], means.new_zeros(3), hard_semantics=True).human.with_times()
        assert person.linear is not None
        axes = quaternion_to_matrix(person.quaternions[0]) * person.scales[0][:, None]
        sizes.append(float((torch.linalg.svdvals(person.linear[0] @ axes)[:, 0] / rest).max()))
        posed = person.means[0]
        now = (posed[:, None] - posed[index]).norm(dim=-1)
        left = alike & (now > TORN_RATIO * apart) & (now > apart + TORN_M)
        torn.append(100 * float(left.any(1).float().mean()))
    return {"size_most_ratio": round(max(sizes), 3), "torn_most_pct": round(max(torn), 3)}


def views_of(
    run: Run, track: BodyTrack, options: argparse.Namespace, directions: int
) -> list[View]:
    """At even times of a motion, from so many of the directions."""
    start = sized(run.capture.camera(run.capture.train_frames[0]), options.size)
    up = up_axis(run.reconstruction.track)
    angles = [2 * math.pi * column / DIRECTIONS for column in range(directions)]
    return [
        (time, follow(start, track, [time], up, partial(turned_by, angle))[0])
        for time in film_times(track, options.times)
        for angle in angles
    ]


def inside_of(track: BodyTrack, view: View) -> tuple[np.ndarray, np.ndarray]:
    """The body's outline, and what of it is not its rim."""
    outline = silhouette(track.vertices(view[0]), track.body.faces, view[1]).numpy()
    return outline, binary_erosion(outline, iterations=_INSET_PX)


def depth_of(run: Run, track: BodyTrack, view: View) -> np.ndarray:
    """Of the person as the model has it, metres."""
    moving = run.reconstruction.in_new_motion(track)
    return moving.depth(view[1], [view[0]], parts="human")[0].numpy()


def seen_steps(run: Run, draw: Draw, options: argparse.Namespace) -> float:
    """`steps` of what training saw: the recorded motion from the front.

    Another motion may turn the plain back of a shirt there, against which the print is speckle.
    """
    track = run.reconstruction.track
    views = views_of(run, track, options, 1)
    pictures = draw(track, views)
    return float(
        np.mean(
            [
                steps(rgb, depth_of(run, track, view), inside_of(track, view)[1])
                for view, (rgb, _) in zip(views, pictures, strict=True)
            ]
        )
    )


def measured(
    run: Run, track: BodyTrack, draw: Draw, seen: float, out: Path, options: argparse.Namespace
) -> dict[str, float]:
    """Figures of a motion, ``seen`` being `seen_steps`; its sheet is written to ``out``."""
    views = views_of(run, track, options, DIRECTIONS)
    speckle: list[float] = []
    holes, shreds, pictures = [], [], []
    for view, (rgb, alpha) in zip(views, draw(track, views), strict=True):
        outline, inside = inside_of(track, view)
        speckle.append(steps(rgb, depth_of(run, track, view), inside))
        holes.append(float((alpha[inside] < 0.5).mean()))
        away = distance_transform_edt(~binary_dilation(outline)) > OUTSIDE * options.size
        shreds.append(float(alpha[away].sum() / alpha.sum()))
        pictures.append(rgb + _GREY * (1 - torch.from_numpy(alpha)[..., None]))
    rows = [
        torch.cat(pictures[row * DIRECTIONS : (row + 1) * DIRECTIONS], 1)
        for row in range(options.times)
    ]
    save_png(out, to_bytes(torch.cat(rows).clamp(0, 1)))
    against = np.array(speckle).reshape(options.times, DIRECTIONS).mean(0) / seen
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
    parser.add_argument("--avatar", action="store_true")
    parser.add_argument("--node-modules", type=Path)
    parser.add_argument("--chromium", default=shutil.which("chromium") or "chromium")
    options = parser.parse_args()
    if options.avatar and (options.learned or options.node_modules is None):
        parser.error("--avatar takes --node-modules, and not --learned")
    options.out.mkdir(parents=True, exist_ok=True)
    run = load_run(options.run)
    if options.learned:
        latest = load_latest(options.run / "checkpoints")
        assert latest is not None
        tensors, state = load_checkpoint(latest[0])
        load_model(run.reconstruction.model, tensors, state["human_count"])
    recorded, found = run.reconstruction.track, {}
    front = partial(by_page, None, options) if options.avatar else partial(by_model, run)
    seen = seen_steps(run, front, options)
    for motion in options.motions:
        track = load_motion_of(motion, recorded, fps=None, in_place=not options.avatar)
        draw = partial(by_page, motion, options) if options.avatar else partial(by_model, run)
        out = options.out / f"{motion}.png"
        found[motion] = measured(run, track, draw, seen, out, options)
        if not options.avatar:
            found[motion] |= pulled(run, track, film_times(track, options.times))
        print(f"{motion:10}", *(f"{name} {value:.2f} " for name, value in found[motion].items()))
    keys = found[options.motions[0]]
    worst = {key: max(values[key] for values in found.values()) for key in keys}
    print(json.dumps({"worst": worst, "motions": found}))


if __name__ == "__main__":
    main()
