"""How fast the viewer draws what moves, and what watching costs a training.

    python benchmarks/viewer.py                # poses and cameras per second, 100,000 Gaussians
    python benchmarks/viewer.py --training     # time of training steps, watched and not

Pictures go all the way: changed wish, drawing, JPEG, web socket, and are counted by a client that
speaks viser's protocol. The peer is a screen that shows 15 pictures per second.
"""

import argparse
import asyncio
import json
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import torch
import viser
import websockets
import zstandard

from evsplat.capture import load_capture
from evsplat.config import override
from evsplat.methods import compose, method_config
from evsplat.shipped import demo_capture
from evsplat.training.run import GaussianReconstruction, Run
from evsplat.view.server import Viewer
from evsplat.view.wish import Motion

WANTED_HZ = 15.0
SIDE_PX = 512
PORT = 18330


def untrained_run(gaussians: int) -> Run:
    """A run of the demo capture with so many Gaussians, a tenth of them the person's."""
    capture = load_capture(demo_capture())
    human = gaussians // 10
    values = override({}, (f"human.count={human}", "deform.non_rigid_start=0"))
    config = method_config("paper", values, where="benchmark")
    model = compose(config, capture, 0, fit=False).model
    rows = model.gaussians
    more = gaussians - len(rows)
    own = torch.randint(rows.human_count, len(rows), (max(more, 0),))
    grown = {}
    for name in rows.attributes:
        value = getattr(rows, name).detach()
        copies = value[own].clone()
        if name == "means":
            copies += 0.01 * torch.randn_like(copies)
        grown[name] = torch.cat([value, copies])
    rows.set_rows(grown, rows.human_count)
    counts = {"human": rows.human_count, "scene": rows.scene_count}
    made = GaussianReconstruction("paper", model)
    return Run(Path("none"), config, "paper", capture, made, 0, 0.0, "cpu", counts, False)


async def pictures(port: int, seconds: float, change, viewer: Viewer) -> list[float]:
    """When pictures came while ``change`` was called as fast as a hand moves a mouse (60 Hz)."""
    came: list[float] = []
    async with _connected(port) as socket:
        await socket.send(_camera((0.0, -3.0, 1.0), (0.7, 0.7, 0.0, 0.0)))

        async def receive() -> None:
            async for raw in socket:
                came.extend([time.perf_counter()] * _pictures_in(raw))

        reader = asyncio.create_task(receive())
        while len(came) < 2:  # drawn once, roughly and sharply
            await asyncio.sleep(0.05)
        client = next(iter(viewer._clients.values()))
        start = time.perf_counter()
        while (now := time.perf_counter()) < start + seconds:
            change(client, now - start)
            await asyncio.sleep(1 / 60)
        reader.cancel()
    return [moment for moment in came if start + 1 < moment < start + seconds]


def turn_camera(client, elapsed: float) -> None:
    """Another viewpoint."""
    orbit = client.standing.orbit
    x = 0.3 * np.sin(elapsed)
    client.change(recording=None, orbit=replace(orbit, position=(float(x), *orbit.position[1:])))


def move_in_time(client, elapsed: float) -> None:
    """Another recorded pose."""
    client.play(lambda p, now: p.moved(p.start_us + 1e6 * (elapsed % 2), now))


def bend_arm(client, elapsed: float) -> None:
    """Another pose by hand."""
    count = len(client.painter.subject.sliders)
    angles = [0.0] * count
    angles[-1] = 40 * float(np.sin(3 * elapsed)) + 41
    client.change(motion=Motion(None, tuple(angles)))


def measure_speed(gaussians: int, seconds: float) -> dict[str, float]:
    viewer = Viewer([untrained_run(gaussians)], host="127.0.0.1", port=PORT)
    figures: dict[str, float] = {}
    try:
        for name, change in (
            ("camera", turn_camera),
            ("time", move_in_time),
            ("pose", bend_arm),
        ):
            came = asyncio.run(pictures(viewer.port, seconds, change, viewer))
            rate = len(came) / (seconds - 1)
            print(f"{name:8} {rate:6.1f} pictures/s   {rate / WANTED_HZ:5.2f} x wanted")
            figures[f"{name}_hz"] = rate
            figures[f"{name}_over_{WANTED_HZ:g}_hz"] = rate / WANTED_HZ
    finally:
        viewer.close()
    return figures


def measure_training(iterations: int, turn_s: float) -> dict[str, float]:
    """Steps per second of a training, in turns watched by a browser that never rests and not."""
    folder = Path(tempfile.mkdtemp(prefix="evsplat-viewer-"))
    run, command = folder / "run", [sys.executable, "-m", "evsplat"]
    options = ["--iterations", str(iterations), "--no-evaluate", "--out", str(run)]
    train = subprocess.Popen([*command, "train", str(demo_capture()), *options])
    view = None
    rates: dict[bool, list[float]] = {False: [], True: []}
    try:
        while train.poll() is None and not (run / ".watch").exists():
            time.sleep(0.2)
        view = subprocess.Popen(
            [*command, "view", str(run), "--port", str(PORT)], stdout=subprocess.PIPE, text=True
        )
        assert view.stdout is not None
        while not view.stdout.readline().startswith("view:"):
            pass
        seen = 0
        while train.poll() is None:
            for watched in (False, True):
                seen += asyncio.run(_watch(turn_s)) if watched else time.sleep(turn_s) or 0
                if train.poll() is None:
                    rates[watched].append(_latest_rate(run / "log.jsonl", turn_s))
    finally:
        for process in (view, train):
            if process is not None and process.poll() is None:
                process.terminate()
                process.wait()
        shutil.rmtree(folder)
    # A busy machine slows some turns; the undisturbed ones are alike.
    alone, along = (max(rates[watched], default=float("nan")) for watched in (False, True))
    slower = 100 * (1 - along / alone)
    print(f"training {alone:.2f} steps/s alone, {along:.2f} watched: {slower:.1f} % slower")
    return {
        "steps_per_s_alone": alone,
        "steps_per_s_watched": along,
        "slower_percent": slower,
        "pictures_while_training": seen,
    }


def _latest_rate(log: Path, seconds: float) -> float:
    """Steps per second of training over the last stretch of the log."""
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    end = lines[-1]
    start = next(line for line in lines if line["seconds"] > end["seconds"] - 0.8 * seconds)
    return (end["iteration"] - start["iteration"]) / max(end["seconds"] - start["seconds"], 1e-9)


async def _watch(seconds: float) -> int:
    """Be a browser whose camera turns all the time; returns how many pictures came."""
    came = 0
    async with _connected(PORT) as socket:
        end = time.time() + seconds

        async def turn() -> None:
            while time.time() < end:
                x = 0.3 * float(np.sin(time.time()))
                await socket.send(_camera((x, -3.0, 1.0), (0.7, 0.7, 0.0, 0.0)))
                await asyncio.sleep(1 / 30)

        turning = asyncio.create_task(turn())
        while time.time() < end:
            try:
                came += _pictures_in(await asyncio.wait_for(socket.recv(), 0.5))
            except TimeoutError:
                continue
        await turning
    return came


def _connected(port: int):
    return websockets.connect(
        f"ws://127.0.0.1:{port}",
        subprotocols=[f"viser-v{viser.__version__}"],
        max_size=None,
        compression=None,
    )


def _camera(position: tuple[float, ...], wxyz: tuple[float, ...]) -> bytes:
    """What a browser says of its camera."""
    return msgspec.msgpack.encode(
        {
            "type": "ViewerCameraMessage",
            "wxyz": wxyz,
            "position": position,
            "fov": 0.8,
            "near": 0.01,
            "far": 1000.0,
            "image_height": SIDE_PX,
            "image_width": SIDE_PX,
            "look_at": [0.0, 0.0, 1.0],
            "up_direction": [0.0, 0.0, 1.0],
        }
    )


def _pictures_in(raw: bytes) -> int:
    """Number of pictures in one message of viser's server."""
    size = int.from_bytes(raw[8:16], "little")
    plain = zstandard.ZstdDecompressor().decompress(
        raw[16 : 16 + size], max_output_size=int.from_bytes(raw[:8], "little")
    )
    messages = msgspec.msgpack.decode(plain)["messages"]
    return sum(m["type"] == "BackgroundImageMessage" and bool(m["rgb_data"]) for m in messages)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--training", action="store_true", help="what watching costs a training")
    parser.add_argument("--gaussians", type=int, default=100_000)
    parser.add_argument("--seconds", type=float, default=8.0, help="of each measurement or turn")
    parser.add_argument("--iterations", type=int, default=600, help="of the watched training")
    options = parser.parse_args()
    if options.training:
        figures = measure_training(options.iterations, options.seconds)
    else:
        figures = measure_speed(options.gaussians, options.seconds)
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
