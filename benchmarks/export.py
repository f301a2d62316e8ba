r"""Exported files drawn by renderers of others, and the avatar page, beside our own picture.

    npm install --prefix FOLDER @sparkjsdev/spark@2.2.0 three@0.187.0 playwright-core \
        @babylonjs/core@9.35.0 @babylonjs/loaders@9.35.0 gsplat@1.2.9 playcanvas@2.23.3 \
        @mkkellogg/gaussian-splats-3d@0.4.7
    python benchmarks/export.py RUN --node-modules FOLDER/node_modules [--out PICTURES]

A test frame is exported as .ply, .spz and .splat, drawn by Spark (WebGL) in headless Chromium
from the recording camera, and compared with evsplat's own picture: with Spark set to the rules of
3DGS, and as it comes. Babylon.js, gsplat.js, PlayCanvas and GaussianSplats3D, all as they come,
draw the .ply, and it exported with `--low-pass` as trained and `0.3`. The avatar page is compared
with the same avatar drawn by our rasteriser, and timed. The files are also read by gsply where that
is installed. The last line is JSON.
"""

import argparse
import io
import json
import shutil
import subprocess
import tempfile
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import torch
from PIL import Image

import evsplat as ev
from evsplat.capture import Camera, Frame
from evsplat.export.avatar import avatar_of
from evsplat.export.bake import at_rest, with_correctives
from evsplat.export.cloud import cloud_of
from evsplat.export.gaussians import file_rotation
from evsplat.render import render
from evsplat.similarity import psnr
from evsplat.training.run import Run

CHROMIUM = (
    "--no-sandbox --disable-quic --use-angle=swiftshader --enable-unsafe-swiftshader "
    "--ignore-gpu-blocklist --disable-background-networking --disable-component-update "
    "--disable-sync --no-first-run"
).split()
HERE = Path(__file__).parent / "browser"
VIEWERS = ("babylon", "gsplat", "playcanvas", "gaussian-splats-3d")
"""Pages beside `HERE` that draw a .ply by the defaults of its viewer."""


def main() -> None:
    """Print a table and one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--node-modules", type=Path, required=True)
    parser.add_argument("--chromium", default=shutil.which("chromium") or "chromium")
    parser.add_argument("--out", type=Path, help="folder for the pictures")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        out = arguments.out or Path(folder) / "pictures"
        out.mkdir(parents=True, exist_ok=True)
        figures = compare(arguments, Path(folder), out)
    print(json.dumps(figures))


@torch.no_grad()
def compare(arguments: argparse.Namespace, folder: Path, out: Path) -> dict[str, float]:
    """Export, draw in the browser, compare."""
    run = ev.load_run(arguments.run, device="cpu")
    capture, source = run.capture, run.reconstruction
    frame = next(f for f in capture.frames if f.split == "test")
    camera = capture.camera(frame)
    person, scene = source.splats(camera, [frame.mid_us])
    ours = render(person, camera, static=scene, low_pass=source.low_pass).image[0, ..., :3]
    model = source.render(camera, [frame.mid_us]).rgb[0]

    site = folder / "site"
    site.mkdir()
    shots = exported(run, camera, frame, site)
    seen = photograph(arguments, site, shots, out)

    person_alone = avatar_of(with_correctives(run, at_rest(run, None), None))
    rotations, bones = source.pose([frame.mid_us])
    skinned = person_alone.gaussians.posed(bones, rotations)
    (alone,) = source.splats(camera, [frame.mid_us], parts="scene")
    avatar = render(skinned, camera, static=alone, low_pass=source.low_pass).image[0, ..., :3]
    save(out / "ours.png", ours)
    save(out / "ours-avatar.png", avatar)

    figures = {
        "gaussians": len(cloud_of(person)) + len(cloud_of(scene)),
        "file_to_model_psnr_db": float(psnr(ours.clamp(0, 1), model)),
    }
    for shot in shots:
        name = str(shot["picture"]).removesuffix(".png")
        picture = torch.from_numpy(read(out / f"{name}.png"))
        reference = avatar if shot["page"] == "avatar.html" else ours
        figures[f"{name}_psnr_db"] = float(psnr(picture, reference.clamp(0, 1)))
        print(f"{name:20} {figures[f'{name}_psnr_db']:6.2f} dB against our own picture")
    print(f"avatar page: {seen['avatar_ms']:.1f} ms per picture {camera.width} x {camera.height}")
    figures["avatar_page_ms_per_picture"] = seen["avatar_ms"]
    return {name: round(value, 3) for name, value in figures.items()} | gsply_agrees(site)


def exported(run: Run, camera: Camera, frame: Frame, site: Path) -> list[dict[str, Any]]:
    """Write the run at a frame as every file that is drawn; gives what to draw of each."""
    source = run.reconstruction
    own = source.low_pass
    shots: list[dict[str, Any]] = []
    for kind in ("ply", "spz", "splat"):
        file = site / f"run-trained.{kind}"
        ev.export_run(run.path, kind, frame=frame.name, out=file, low_pass=own, device="cpu")
        view = seen_from(camera, file_rotation(source.track, kind, None))
        for rules in ("3dgs", "default"):
            shots.append(
                {"page": "spark.html", "file": file.name, "rules": rules, "camera": view,
                 "low_pass": own, "picture": f"spark-{kind}-{rules}.png"}
            )  # fmt: skip
    view = seen_from(camera, file_rotation(source.track, "ply", None))
    for name, low_pass in {"run.ply": None, "run-trained.ply": own, "run-0.3.ply": 0.3}.items():
        ev.export_run(
            run.path, "ply", out=site / name, frame=frame.name, low_pass=low_pass, device="cpu"
        )
        for viewer in VIEWERS:
            shots.append(
                {"page": f"{viewer}.html", "file": name, "camera": view,
                 "picture": f"{viewer}{name[3:-4]}.png"}
            )  # fmt: skip
    page = site / "avatar.html"
    ev.export_run(run.path, "avatar", parts="all", out=page, device="cpu")
    first = min(f.mid_us for f in run.capture.frames)
    seconds = (frame.mid_us - first) / 1e6
    shots.append(
        {"page": "avatar.html", "clip": 0, "seconds": seconds, "timed": 10,
         "camera": seen_from(camera, np.eye(3)), "picture": "avatar.png"}
    )  # fmt: skip
    return shots


def seen_from(camera: Camera, rotation: np.ndarray) -> dict[str, object]:
    """The camera in the axes of a file."""
    pose = camera.world_to_camera.double().numpy().copy()
    pose[:3, :3] = pose[:3, :3] @ rotation.T
    size = {"width": camera.width, "height": camera.height}
    return {**size, "K": camera.K.tolist(), "world_to_camera": pose.tolist()}


def photograph(
    arguments: argparse.Namespace, site: Path, shots: list[dict], out: Path
) -> dict[str, float]:
    """Let Chromium draw the shots from a local server; returns what the script measured."""
    for page in (*HERE.glob("*.html"), HERE / "settled.js"):
        shutil.copy(page, site)
    (site / "node_modules").symlink_to(arguments.node_modules.resolve())
    handler = partial(QuietHandler, directory=str(site))
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    Thread(target=server.serve_forever, daemon=True).start()
    order = {
        "address": f"http://127.0.0.1:{server.server_port}",
        "chromium": arguments.chromium,
        "arguments": CHROMIUM,
        "playwright": str((arguments.node_modules / "playwright-core/index.mjs").resolve()),
        "out": str(out.resolve()),
        "shots": shots,
    }
    try:
        done = subprocess.run(
            ["node", str(HERE / "photograph.mjs")],
            input=json.dumps(order),
            capture_output=True,
            text=True,
        )
    finally:
        server.shutdown()
    if done.returncode:
        raise SystemExit(done.stderr)
    return json.loads(done.stdout.splitlines()[-1])


class QuietHandler(SimpleHTTPRequestHandler):
    """Serves a folder and says nothing."""

    def log_message(self, format: str, *args: object) -> None:
        """Drop the line."""


def gsply_agrees(site: Path) -> dict[str, float]:
    """Largest difference between the .ply and the .spz as gsply reads them, in the .spz's axes."""
    try:
        import gsply
    except ImportError:
        return {}
    file = site / "run-trained.ply"
    ply, spz = gsply.plyread(str(file)), gsply.read_spz(str(file.with_suffix(".spz")))
    turn = np.linalg.lstsq(ply.means, spz.means, rcond=None)[0]
    return {
        "gsply_spz_centre_error_m": round(float(np.abs(ply.means @ turn - spz.means).max()), 7),
        "gsply_spz_scale_error_nepers": round(float(np.abs(ply.scales - spz.scales).max()), 4),
    }


def save(path: Path, image: torch.Tensor) -> None:
    """Write an sRGB picture in [0, 1]."""
    Image.fromarray((image.clamp(0, 1) * 255).round().to(torch.uint8).numpy()).save(path)


def read(path: Path) -> np.ndarray:
    """An sRGB picture in [0, 1]."""
    with Image.open(io.BytesIO(path.read_bytes())) as image:
        return np.asarray(image.convert("RGB"), dtype=np.float32) / 255


if __name__ == "__main__":
    main()
