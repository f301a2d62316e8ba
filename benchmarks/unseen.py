"""The person's unseen side before and after the fill at the end of training.

    python benchmarks/unseen.py RUN [RUN ...] [--strength 0.001] [--pictures FOLDER]

For runs of method evsplat on staged captures. Their learned parameters are drawn as they are
("before") and filled anew ("after"); nothing is trained or written to the run. Printed, in dB:
PSNR inside the posed body's silhouette in the cameras left, right and behind (there the person
alone, since a wall of the room stands before the camera), and of the person's pixels in held-out
frames, with their Cb and Cr; roughness of little seen colours against the well seen. The last line
is one JSON object, with the means over runs.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import torch

from evsplat.body import silhouette
from evsplat.capture import Capture, load_body_track
from evsplat.evaluation.chroma import chroma_psnr
from evsplat.models.discs import DiscModel
from evsplat.models.discs.fill import filled
from evsplat.models.seen import roughness, seen_by
from evsplat.options.declare import Parts
from evsplat.pictures import to_bytes
from evsplat.pictures.files import save_png
from evsplat.similarity import psnr
from evsplat.training.checkpoint import load_checkpoint, load_latest, load_model
from evsplat.training.run import Run, load_run

BEHIND = "novel_back"


def figures(run: Run, sheet: list[torch.Tensor]) -> dict[str, float]:
    """All figures of a run as it is now; pictures of the person from behind go to ``sheet``."""
    capture, drawn = run.capture, run.reconstruction
    track = load_body_track(capture, dense=True)
    found: dict[str, list[float]] = {}
    for view in capture.novel_views:
        camera = capture.cameras[view.camera]
        behind = view.camera == BEHIND
        truth = capture.novel_image(view)
        mask = silhouette(track.vertices(view.time_us), track.body.faces, camera)
        parts: Parts = "human" if behind else "all"
        picture = drawn.render(camera, [view.time_us], parts=parts).rgb[0]
        found.setdefault(view.camera, []).append(float(psnr(picture, truth, mask=mask)))
        if behind:
            sheet.append(torch.cat([picture, truth * mask[..., None]]))
    for frame in capture.test_frames:
        person = capture.mask(frame)
        if person is None or not bool((person > 0.5).any()):
            continue
        picture = drawn.render(capture.camera(frame), [frame.mid_us]).rgb[0]
        truth = capture.sharp(frame)
        person = person > 0.5
        values = {"mask": float(psnr(picture, truth, mask=person))}
        for name, value in (values | chroma_psnr(picture, truth, person)).items():
            found.setdefault(name, []).append(value)
    return {name: sum(values) / len(values) for name, values in found.items()}


def rough(run: Run, capture: Capture) -> float | None:
    """Roughness of the little seen against the rest."""
    seen = run.reconstruction.seen
    assert seen is not None
    frame = capture.train_frames[0]
    rest = run.reconstruction.at_rest([(frame.mid_us, capture.camera(frame))])
    return roughness(rest, seen)["ratio"]


def main() -> None:
    """Measure runs before and after."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    parser.add_argument("--strength", type=float, default=0.001)
    parser.add_argument("--pictures", type=Path)
    options = parser.parse_args()
    rows: dict[str, dict[str, dict[str, float]]] = {}
    for path in options.runs:
        run = load_run(path)
        latest = load_latest(path / "checkpoints")
        assert latest is not None
        tensors, state = load_checkpoint(latest[0])
        model = run.reconstruction.model
        load_model(model, tensors, state["human_count"])
        training = run.capture.for_training(run.policy)
        seen = seen_by(model, training)
        run = replace(run, reconstruction=replace(run.reconstruction, seen=seen))
        sheets: dict[str, list[torch.Tensor]] = {"before": [], "after": []}
        rows[str(path)] = {}
        for name, sheet in sheets.items():
            if name == "after":
                assert isinstance(model, DiscModel)
                found = filled(model, training, options.strength, seen)
                model.load_state_dict({**model.state_dict(), **found})
            values = figures(run, sheet)
            values["rough"] = rough(run, run.capture) or 0.0
            rows[str(path)][name] = values
            print(path.name, name, *(f"{key} {value:.2f}" for key, value in values.items()))
        if options.pictures is not None and sheets["before"]:
            whole = torch.cat([torch.cat(sheet[::4], 1) for sheet in sheets.values()])
            save_png(options.pictures / f"{path.name}.png", to_bytes(whole.clamp(0, 1)))
    means = {}
    for name in ("before", "after"):
        keys = set.intersection(*(set(row[name]) for row in rows.values()))
        means[name] = {
            key: round(sum(row[name][key] for row in rows.values()) / len(rows), 3)
            for key in sorted(keys)
        }
    print(json.dumps({"strength": options.strength, "means": means, "runs": rows}))


if __name__ == "__main__":
    main()
