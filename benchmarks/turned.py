"""A person who turns: training sees the front alone, the pictures of the back are the test.

    python benchmarks/turned.py [--characters man woman worker] [--motion spin] [--yaw 0]
        [--width 128] [--iterations 400] [--out FOLDER]

Captures are staged with a motion that turns. Frames in which the hips face the camera by less than
90 degrees are trained on, but for every fourth, and all that show the back are held out with their
events. Printed, of the person's pixels in dB, as learned and as filled at the end of training: the
held-out front, and the back, with Cb and Cr; ST-LPIPS of the back's crop where its package is
installed. FOLDER/CHARACTER.png shows the back: learned, filled, truth. What exists is not made
again. The last line is one JSON object.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import torch

import evsplat as ev
from evsplat.body.skeleton import find_skeleton
from evsplat.capture import Capture, Frame, load_body_track, load_capture
from evsplat.evaluation.chroma import chroma_psnr
from evsplat.files import write_json
from evsplat.pictures import to_bytes
from evsplat.pictures.files import save_png
from evsplat.similarity import psnr
from evsplat.similarity.perceptual import PerceptualMetric
from evsplat.similarity.st_lpips import load_st_lpips
from evsplat.training.checkpoint import load_checkpoint, load_latest, load_model
from evsplat.training.run import Run, load_run
from evsplat.weights import MissingWeights

FRONT_TEST = 4
"""One frame in as many of the front is held out."""


def angles(capture: Capture) -> dict[str, float]:
    """Between where the hips face and the camera, in the horizontal plane, degrees, by frame."""
    track = load_body_track(capture, dense=True)
    body = track.body
    limbs = find_skeleton(body.parents.tolist(), body.joint_names, str(capture.path)).limbs
    found = {}
    for frame in capture.frames:
        joints = body.joint_transforms(*track.at([frame.mid_us]))[0, :, :3, 3]
        across = joints[limbs["left_thigh"]] - joints[limbs["right_thigh"]]
        ahead = np.array([across[1], -across[0]])
        towards = (capture.camera(frame).center() - joints[0])[:2].numpy()
        cosine = ahead @ towards / np.linalg.norm(ahead) / np.linalg.norm(towards)
        found[frame.name] = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    return found


def staged(folder: Path, options: argparse.Namespace, character: str) -> Path:
    """The capture whose training frames show the front alone."""
    path = folder / f"{character}-{options.motion}-{options.yaw:g}"
    if path.exists():
        return path
    part = folder / f".{path.name}"
    if not part.exists():
        ev.stage(
            part,
            character=character,
            motion=options.motion,
            width=options.width,
            fps=20.0,
            yaw_deg=options.yaw,
            in_place=True,
            novel_views="none",
            progress=False,
        )
    turned = angles(load_capture(part))
    stated = json.loads((part / "capture.json").read_text("utf-8"))
    front = [frame for frame in stated["frames"] if turned[frame["name"]] < 90]
    for frame in stated["frames"]:
        frame["split"] = "test"
    for number, frame in enumerate(front):
        frame["split"] = "test" if number % FRONT_TEST == FRONT_TEST - 1 else "train"
    write_json(part / "capture.json", stated)
    part.rename(path)
    return path


def figures(run: Run, frames: list[Frame], lpips: PerceptualMetric | None) -> dict[str, float]:
    """Means over frames of the person's pixels."""
    found: dict[str, list[float]] = {}
    for frame in frames:
        mask = run.capture.mask(frame)
        assert mask is not None
        picture, truth = drawn(run, frame), run.capture.sharp(frame)
        values = {"mask": float(psnr(picture, truth, mask=mask > 0.5))}
        values |= chroma_psnr(picture, truth, mask > 0.5)
        if lpips is not None:
            values["st_lpips"] = float(lpips(picture, truth))
        for name, value in values.items():
            found.setdefault(name, []).append(value)
    return {name: sum(values) / len(values) for name, values in found.items()}


def drawn(run: Run, frame: Frame) -> torch.Tensor:
    """The picture at mid-exposure."""
    return run.reconstruction.render(run.capture.camera(frame), [frame.mid_us]).rgb[0].cpu()


def measured(
    run: Run, front: list[Frame], back: list[Frame], picture: Path
) -> dict[str, dict[str, float]]:
    """Figures of the front and the back, as learned and as filled; ``picture`` shows the back."""
    try:
        lpips = load_st_lpips()
    except MissingWeights:
        lpips = None
    model = run.reconstruction.model
    latest = load_latest(run.path / "checkpoints")
    assert latest is not None
    tensors, state = load_checkpoint(latest[0])
    shown = back[:: max(1, len(back) // 8)]
    found: dict[str, dict[str, float]] = {}
    rows: list[torch.Tensor] = []
    for name in ("filled", "learned"):
        if name == "learned":
            load_model(model, tensors, state["human_count"])
        found[f"front_{name}"] = figures(run, front, lpips)
        found[f"back_{name}"] = figures(run, back, lpips)
        rows.insert(0, torch.cat([drawn(run, frame) for frame in shown], 1))
    rows.append(torch.cat([run.capture.sharp(frame) for frame in shown], 1))
    save_png(picture, to_bytes(torch.cat(rows).clamp(0, 1)))
    return found


def main() -> None:
    """Stage, train, measure what is left, and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--characters", nargs="*", default=["man", "woman", "worker"])
    parser.add_argument("--motion", default="spin")
    parser.add_argument("--yaw", type=float, default=0.0)
    parser.add_argument("--width", type=int, default=128)
    parser.add_argument("--iterations", type=int, default=400)
    parser.add_argument("--out", type=Path, default=Path("bench/turned"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rows: dict[str, dict[str, dict[str, float]]] = {}
    for character in options.characters:
        capture = staged(options.out, options, character)
        path = options.out / f"run-{capture.name}"
        if not (path / "metrics.json").exists():
            ev.train(capture, out=path, iterations=options.iterations, resume=path.exists())
            ev.evaluate(path)
        run = load_run(path)
        turned = angles(run.capture)
        held = run.capture.test_frames
        front = [frame for frame in held if turned[frame.name] < 90]
        back = [frame for frame in held if turned[frame.name] >= 90]
        rows[character] = measured(run, front, back, options.out / f"{capture.name}.png")
        print(f"{character}: {len(front)} frames of the front, {len(back)} of the back")
        for name, values in rows[character].items():
            print(f"  {name:14}", *(f"{key} {value:.2f}" for key, value in values.items()))
    means = {
        name: {
            key: round(sum(row[name][key] for row in rows.values()) / len(rows), 3)
            for key in rows[options.characters[0]][name]
        }
        for name in rows[options.characters[0]]
    }
    print(json.dumps({"means": means, "characters": rows}))


if __name__ == "__main__":
    main()
