"""How fast the viewer draws what moves, and what watching costs a training.

    python benchmarks/viewer.py                # poses and cameras per second, 100,000 Gaussians
    python benchmarks/viewer.py --training     # what watching costs a training; 4 minutes

Pictures go all the way: changed request, drawing, JPEG, web socket, and are counted by a client
that speaks viser's protocol. The peer is a screen that shows 15 pictures per second.

The training is watched in turns by a client whose camera never rests. Each turn is compared with
those before and after it, in steps per second and in the training's own processor time per step,
which other work on the machine disturbs less; the median of the turns is what counts.
"""

import argparse
import asyncio
import io
import json
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
import viser
import websockets
import zstandard
from PIL import Image
from websockets.typing import Subprotocol

from evsplat.capture import load_capture
from evsplat.config import override
from evsplat.methods import TRAINABLE, method_config
from evsplat.shipped import demo_capture
from evsplat.training.reconstruction import GaussianReconstruction
from evsplat.training.run import Run
from evsplat.view.request import Motion
from evsplat.view.server import Viewer

WANTED_HZ = 15.0
SIDE_PX = 512
PORT = 18330
NETWORK_START = {"evsplat": "shade_start", "paper": "networks.non_rigid_start"}
"""Names of the setting, by method."""


def untrained_run(gaussians: int, method: str) -> Run:
    """A run of the demo capture with so many Gaussians, a fifth of them the person's."""
    capture = load_capture(demo_capture())
    human = gaussians // 5
    values = override({}, (f"human.count={human}", f"{NETWORK_START[method]}=0"))
    config = method_config(method, values, where="benchmark")
    seen = capture.for_training(config.policy)
    model: Any = TRAINABLE[method].build(config, seen, 0, purpose="draw").model
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
    made = GaussianReconstruction(method, model)
    facts = (capture, made, 0, 0.0, "cpu", counts, False)
    return Run(Path("none"), config, method, seen.terms(), *facts)


async def pictures(port: int, seconds: float, change, viewer: Viewer) -> list[tuple[float, int]]:
    """When pictures came and how wide they were, while ``change`` was called at 60 Hz.

    As fast as a hand moves a mouse; the first second, in which drafts find their size, is left out.
    """
    came: list[tuple[float, int]] = []
    async with _connected(port) as socket:
        await socket.send(_camera((0.0, -3.0, 1.0), (0.7, 0.7, 0.0, 0.0)))

        async def receive() -> None:
            async for raw in socket:
                came.extend((time.perf_counter(), width) for width in _widths_in(raw))

        reader = asyncio.create_task(receive())
        while not came or time.perf_counter() - came[-1][0] < 1:  # until it stands still
            await asyncio.sleep(0.05)
        client = next(iter(viewer._clients.values()))
        start = time.perf_counter()
        while (now := time.perf_counter()) < start + seconds:
            change(client, now - start)
            await asyncio.sleep(1 / 60)
        reader.cancel()
    return [(when, width) for when, width in came if start + 1 < when < start + seconds]


def turn_camera(client, elapsed: float) -> None:
    """Another viewpoint."""
    camera = client.current.browser_camera
    position = (0.3 * float(np.sin(elapsed)), *camera.position[1:])
    client.change(recording_camera=None, browser_camera=replace(camera, position=position))


def move_in_time(client, elapsed: float) -> None:
    """Another recorded pose."""
    client.change_playback(lambda p, now: p.moved(p.start_us + 1e6 * (elapsed % 2), now))


def bend_arm(client, elapsed: float) -> None:
    """Another pose by hand."""
    count = len(client.compositor.viewed.sliders)
    angles = [0.0] * count
    angles[-1] = 40 * float(np.sin(3 * elapsed)) + 41
    client.change(motion=Motion(None, tuple(angles)))


def measure_speed(gaussians: int, method: str, seconds: float) -> dict[str, float]:
    viewer = Viewer([untrained_run(gaussians, method)], host="127.0.0.1", port=PORT)
    figures: dict[str, float] = {}
    try:
        for name, change in (
            ("camera", turn_camera),
            ("time", move_in_time),
            ("pose", bend_arm),
        ):
            came = asyncio.run(pictures(viewer.port, seconds, change, viewer))
            rate = len(came) / (seconds - 1)
            side = float(np.median([width for _, width in came] or [0]))
            print(
                f"{name:8} {rate:6.1f} pictures/s of {side:3.0f} x {side:3.0f} px for a window of "
                f"{SIDE_PX} x {SIDE_PX}   {rate / WANTED_HZ:5.2f} x wanted"
            )
            figures[f"{name}_hz"] = rate
            figures[f"{name}_side_px"] = side
            figures[f"{name}_over_{WANTED_HZ:g}_hz"] = rate / WANTED_HZ
    finally:
        viewer.close()
    return figures


TRACED = """
import sys, time
from pathlib import Path
from evsplat.training import train
from evsplat.training.trainer import Trainer
step, trace = Trainer.step, open(sys.argv[3], "a", buffering=1)
def traced(self):
    report = step(self)
    print(time.monotonic(), time.process_time(), file=trace)
    return report
Trainer.step = traced
train(sys.argv[1], method=sys.argv[4], out=Path(sys.argv[2]), iterations=1_000_000)
"""
"""A training that writes down when each step ended, by the wall and by its own processor time."""
LINGERS_S, BEGINS_S = 12.0, 4.0
"""A training writes snapshots for so long after a watcher has left; and one comes to be at home."""


def measure_training(turns: int, turn_s: float, method: str) -> dict[str, float]:
    folder = Path(tempfile.mkdtemp(prefix="evsplat-viewer-"))
    run, trace = folder / "run", folder / "steps"
    code = [sys.executable, "-c", TRACED, str(demo_capture()), str(run), str(trace), method]
    train = subprocess.Popen(code, stderr=subprocess.DEVNULL)
    view, seen = None, 0
    spans: list[tuple[float, float]] = []
    try:
        while train.poll() is None and not (trace.exists() and trace.read_text().count("\n") > 5):
            time.sleep(0.5)
        view = subprocess.Popen(
            [sys.executable, "-m", "evsplat", "view", str(run), "--port", str(PORT)],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert view.stdout is not None
        watch = run / ".watch"
        while train.poll() is None and not (run / "snapshot.safetensors").exists():
            watch.touch()  # the first one, for the viewer to begin with
            time.sleep(1)
        while not view.stdout.readline().startswith("view:"):
            pass
        for turn in range(2 * turns + 1):
            if turn % 2:
                _watched(BEGINS_S)
                begin = time.monotonic()
                seen += _watched(turn_s)
            else:
                time.sleep(LINGERS_S)
                begin = time.monotonic()
                time.sleep(turn_s)
            spans.append((begin, time.monotonic()))
        rates = _rates(trace, spans)
    finally:
        for process in (view, train):
            if process is not None and process.poll() is None:
                process.terminate()
                process.wait()
        shutil.rmtree(folder)
    return _compared(rates, seen, turn_s)


def _rates(trace: Path, spans: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Seconds per step, of the wall and of the processor, in each span."""
    steps = np.array([[float(v) for v in line.split()] for line in trace.read_text().splitlines()])
    rates = []
    for begin, end in spans:
        inside = steps[(steps[:, 0] >= begin) & (steps[:, 0] <= end)]
        if len(inside) < 3:
            sys.exit(f"Only {len(inside)} steps in a turn of {end - begin:.0f} s; see --seconds.")
        rates.append(tuple((inside[-1] - inside[0]) / (len(inside) - 1)))
    return rates


def _compared(rates: list[tuple[float, float]], seen: int, turn_s: float) -> dict[str, float]:
    alone, watched = np.array(rates[::2]), np.array(rates[1::2])
    # Steps become slower as Gaussians become more: a turn lies between two others.
    slower = 100 * (2 * watched / (alone[:-1] + alone[1:]) - 1)
    wall, cpu = np.median(slower, axis=0)
    print("turn   s/step watched   alone   slower   more processor time")
    for turn, (percent, more) in enumerate(slower):
        around = (alone[turn, 0] + alone[turn + 1, 0]) / 2
        seconds = f"{watched[turn, 0]:14.3f}   {around:5.3f}"
        print(f"{turn:4}   {seconds}   {percent:5.1f} %   {more:5.1f} %")
    print(f"median: {wall:.1f} % slower, {cpu:.1f} % more processor time per step")
    return {
        "s_per_step_alone": float(np.median(alone[:, 0])),
        "s_per_step_watched": float(np.median(watched[:, 0])),
        "slower_percent": float(wall),
        "more_processor_time_percent": float(cpu),
        "slower_over_wanted_5_percent": float(wall) / 5,
        "pictures_per_s_while_training": seen / (len(watched) * turn_s),
    }


def _watched(seconds: float) -> int:
    try:
        return asyncio.run(_watch(seconds))
    except (TimeoutError, OSError):
        sys.exit("The viewer does not answer: this machine leaves nothing over for it.")


async def _watch(seconds: float) -> int:
    """Be a browser whose camera turns all the time; returns how many pictures came."""
    came = 0
    async with _connected(PORT) as socket:
        end = time.monotonic() + seconds

        async def turn() -> None:
            while time.monotonic() < end:
                x = 0.3 * float(np.sin(time.monotonic()))
                await socket.send(_camera((x, -3.0, 1.0), (0.7, 0.7, 0.0, 0.0)))
                await asyncio.sleep(1 / 30)

        turning = asyncio.create_task(turn())
        while time.monotonic() < end:
            try:
                came += len(_widths_in(await asyncio.wait_for(socket.recv(), 0.5)))
            except TimeoutError:
                continue
        await turning
    return came


def _connected(port: int):
    return websockets.connect(
        f"ws://127.0.0.1:{port}",
        subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
        max_size=None,
        compression=None,
        open_timeout=30,
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


def _widths_in(raw: bytes) -> list[int]:
    """Widths of the pictures in one message of viser's server."""
    size = int.from_bytes(raw[8:16], "little")
    plain = zstandard.ZstdDecompressor().decompress(
        raw[16 : 16 + size], max_output_size=int.from_bytes(raw[:8], "little")
    )
    messages = msgspec.msgpack.decode(plain)["messages"]
    return [
        Image.open(io.BytesIO(message["rgb_data"])).width
        for message in messages
        if message["type"] == "BackgroundImageMessage" and message["rgb_data"]
    ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--training", action="store_true", help="what watching costs a training")
    parser.add_argument("--gaussians", type=int, default=100_000)
    parser.add_argument("--method", default="paper", choices=sorted(NETWORK_START))
    parser.add_argument("--seconds", type=float, default=12.0, help="of each measurement or turn")
    parser.add_argument("--turns", type=int, default=4, help="in which the training is watched")
    options = parser.parse_args()
    if options.seconds < 2:
        parser.error("--seconds: the first second of a measurement does not count; give 2 or more")
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # no process is left behind
    if options.training:
        figures = measure_training(options.turns, options.seconds, options.method)
    else:
        figures = measure_speed(options.gaussians, options.method, options.seconds)
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
