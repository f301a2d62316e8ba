"""Make the figures of the documentation: python tools/make_doc_figures.py RUN."""

import argparse
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from evsplat.capture import Capture
from evsplat.export import render_run
from evsplat.pictures import to_bytes
from evsplat.training import load_run
from evsplat.untrusted.text import read_json

OUT = Path(__file__).parents[1] / "docs" / "images"
EXPOSURE = 4
"""Frame through whose exposure the strip goes."""
GAP_PX = 4
DEMO_PX = 400
FILM_PX = 360


def strip(run: Path, name: str, count: int, **film: object) -> list[Image.Image]:
    """``count`` pictures of a film, evenly spread."""
    with tempfile.TemporaryDirectory() as folder:
        out = render_run(run, out=Path(folder) / name, **film)
        paths = sorted(out.iterdir())
        chosen = [paths[round(i)] for i in np.linspace(0, len(paths) - 1, count)]
        return [Image.open(path).convert("RGB") for path in chosen]


def beside(pictures: list[Image.Image]) -> Image.Image:
    """Pictures of one height, side by side with a gap."""
    width, height = sum(p.width + GAP_PX for p in pictures) - GAP_PX, pictures[0].height
    page = Image.new("RGB", (width, height), (255, 255, 255))
    x = 0
    for picture in pictures:
        page.paste(picture, (x, 0))
        x += picture.width + GAP_PX
    return page


def save(name: str, pictures: list[Image.Image]) -> None:
    """Write pictures side by side."""
    beside(pictures).save(OUT / f"{name}.webp", quality=88, method=6)


def demo(run: Path, capture: Capture) -> None:
    """Blurry input, render and truth of the held-out frame that is blurred most (README)."""
    metrics = read_json(run / "metrics.json")
    blurred = [e["others"]["blurry_input"]["person_mask"]["psnr"] for e in metrics["per_frame"]]
    entry = metrics["per_frame"][int(np.argmin(blurred))]
    render = Image.open(run / entry["pictures"]["render"]).convert("RGB")
    pictures = [
        Image.fromarray(to_bytes(capture.image(entry["frame"]))),
        render,
        Image.fromarray(to_bytes(capture.sharp(entry["frame"]))),
    ]
    side = (DEMO_PX, DEMO_PX)
    large = [picture.resize(side, Image.Resampling.LANCZOS) for picture in pictures]
    beside(large).save(OUT / "demo.png")


def main(run: Path) -> None:
    """Write all figures."""
    capture = load_run(run).capture
    demo(run, capture)
    frame = capture.train_frames[EXPOSURE]
    start, end = frame.exposure_us
    blurry = Image.fromarray((capture.image(frame) * 255).round().byte().numpy())
    first = capture.frames[0].mid_us
    seconds = (end - first) / 1e6
    with tempfile.TemporaryDirectory() as folder:
        film = render_run(run, out=Path(folder) / "exposure", seconds=seconds, fps=100)
        paths = sorted(film.iterdir())
        places = np.linspace((start - first) / 1e6 * 100, len(paths) - 1, 4).round().astype(int)
        through = [Image.open(paths[place]).convert("RGB") for place in places]
    save("through-an-exposure", [blurry, *through])
    at = frame.mid_us / 1e6
    held = {"at": at, "seconds": 0.1, "fps": 10.0}
    looks = [strip(run, show, 1, show=show, **held)[0] for show in ("rgb", "semantic")]
    with tempfile.TemporaryDirectory() as folder:
        gif = render_run(run, out=Path(folder) / "depth.gif", show="depth", **held)
        looks.append(Image.open(gif).convert("RGB"))
    save("looks", [blurry, *looks])
    save(
        "events-given-and-rendered",
        strip(run, "events", 2, show="events", beside=True, seconds=0.5),
    )
    save("novel-motion", strip(run, "spin", 5, motion="spin", in_place=True, fps=5.0))
    render_run(
        run,
        out=OUT / "swing.webp",
        path="swing",
        motion="dance_b",
        in_place=True,
        seconds=2.0,
        fps=12.0,
        size=FILM_PX,
    )
    render_run(run, out=OUT / "film.webp", path="orbit", motion="spin", fps=12.0, size=FILM_PX)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition(":")[0])
    parser.add_argument("run", type=Path, metavar="RUN")
    main(parser.parse_args().run)
