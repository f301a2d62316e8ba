"""Speed of the simulated event sensor beside eventcv's, both from the same pictures.

python benchmarks/simulator.py [--width W] [--height H] [--pictures N] [--threads T] [--repeats R]

The clip is a textured ellipse that moves over a textured background, 8 bit, 1000 pictures a second,
C = 0.2. "clean" is the ideal sensor, "everything" has mismatch, low-pass, leak, shot noise, hot
pixels and dead time at once. Pictures are decoded to linear light beforehand for evsplat; eventcv
does it itself, which is timed too ("with decoding") on both sides. CPU seconds count all threads.
The last line is JSON with a unit in each key.
"""

import evsplat  # noqa: F401 - before torch: it sets how OpenMP's threads wait

# isort: split
import argparse
import json
import os
import time
from collections.abc import Callable, Iterable
from functools import partial

import numpy as np
import torch
from scipy import ndimage

from evsplat.events import SensorSettings, SensorSimulator, sensor_settings
from evsplat.pictures import decode

STEP_US = 1_000
CLEAN = SensorSettings(response="lin-log")
EVERYTHING = sensor_settings(
    "dvxplorer",
    response="lin-log",
    cutoff_hz=200.0,
    leak_hz=1.0,
    shot_hz=10.0,
    refractory_us=100.0,
    hot_pixel_hz=100.0,
)


def main() -> None:
    """Print a table and one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--width", type=int, default=346)
    parser.add_argument("--height", type=int, default=260)
    parser.add_argument("--pictures", type=int, default=200)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    # read by eventcv when it is imported
    os.environ["RAYON_NUM_THREADS"] = str(arguments.threads)
    coded = clip(arguments.width, arguments.height, arguments.pictures)
    pixels = coded.size
    results: dict[str, float | str] = {
        "width_px": arguments.width,
        "height_px": arguments.height,
        "pictures": len(coded),
        "threads": arguments.threads,
    }
    size = f"{arguments.width}x{arguments.height}"
    print(f"{size}, {len(coded)} pictures, {arguments.threads} thread(s)")
    for name, settings in (("clean", CLEAN), ("everything", EVERYTHING)):
        light = [to_light(picture) for picture in coded]
        runs = {
            "evsplat": best(partial(evsplat_events, light, settings), arguments.repeats),
            "evsplat_with_decoding": best(
                partial(decoded_events, coded, settings), arguments.repeats
            ),
        }
        peer = peer_of(coded, settings)
        if peer is not None:
            runs["eventcv"] = best(peer, arguments.repeats)
        for who, (seconds, cpu, events) in runs.items():
            rate, cpu_rate = pixels / seconds / 1e6, pixels / cpu / 1e6
            print(
                f"  {name:10s} {who:22s} {rate:7.1f} Mpixel/s  {cpu_rate:6.1f} per CPU second"
                f"  {events / seconds / 1e6:5.1f} Mevents/s  {events:>9,} events"
            )
            results |= {
                f"{name}_{who}_best_mpixel_per_s": round(rate, 1),
                f"{name}_{who}_mpixel_per_cpu_s": round(cpu_rate, 1),
                f"{name}_{who}_events": events,
            }
        if peer is not None:
            ours, theirs = runs["evsplat_with_decoding"], runs["eventcv"]
            wall, cpu = theirs[0] / ours[0], theirs[1] / ours[1]
            print(f"  {name:10s} with decoding {wall:.1f}x eventcv, {cpu:.1f}x in CPU seconds")
            results |= {
                f"{name}_evsplat_over_eventcv": round(wall, 1),
                f"{name}_evsplat_over_eventcv_cpu": round(cpu, 1),
            }
    print(json.dumps(results))


def clip(width: int, height: int, count: int) -> np.ndarray:
    """Grey pictures (N, H, W), uint8."""
    rng = np.random.default_rng(0)

    def texture(w: int) -> np.ndarray:
        smooth = ndimage.gaussian_filter(rng.random((height, w)), 1.5)
        return (smooth - smooth.min()) / (smooth.max() - smooth.min())

    background, skin = 0.1 + 0.5 * texture(width), 0.05 + 0.9 * texture(2 * width)
    y, x = np.mgrid[:height, :width]
    pictures = np.empty((count, height, width), dtype=np.uint8)
    for k in range(count):
        centre = (width * (0.3 + 0.4 * k / count), height * (0.5 + 0.2 * np.sin(k / 20)))
        inside = ((x - centre[0]) / (0.15 * width)) ** 2 + (
            (y - centre[1]) / (0.3 * height)
        ) ** 2 < 1
        moved = skin[:, width - int(centre[0]) : 2 * width - int(centre[0])]
        pictures[k] = 255 * np.where(inside, moved, background) + 0.5
    return pictures


def to_light(picture: np.ndarray) -> np.ndarray:
    """Linear light of a grey sRGB picture, as float32."""
    table = decode(torch.arange(256, dtype=torch.float32) / 255, "srgb").numpy()
    return table[picture]


def decoded_events(coded: np.ndarray, settings: SensorSettings) -> int:
    """The same of coded pictures."""
    return evsplat_events(map(to_light, coded), settings)


def evsplat_events(light: Iterable[np.ndarray], settings: SensorSettings) -> int:
    """Number of events of pictures of linear light."""
    sensor, count = None, 0
    for k, luma in enumerate(light):
        sensor = sensor or SensorSimulator(luma.shape[1], luma.shape[0], settings)
        count += len(sensor.step(luma, k * STEP_US))
    return count


def peer_of(coded: np.ndarray, settings: SensorSettings) -> Callable[[], int] | None:
    """The same in eventcv, or None where it is not installed."""
    try:
        import eventcv
    except ImportError:
        print("  eventcv is not installed (pip install eventcv): no ratio")
        return None
    return lambda: len(
        eventcv.simulate(
            coded,
            fps=1e6 / STEP_US,
            pos_thres=settings.contrast_on,
            neg_thres=settings.contrast_off,
            sigma_thres=settings.contrast_mismatch * settings.contrast_on,
            cutoff_hz=settings.cutoff_hz,
            leak_rate_hz=settings.leak_hz,
            shot_noise_rate_hz=settings.shot_hz,
            refractory_us=int(settings.refractory_us),
            upsample="off",
        )
    )


def best(run: Callable[[], int], repeats: int) -> tuple[float, float, int]:
    """Best wall and CPU seconds of the repeats after one to warm up, and the events."""
    seconds = []
    for _ in range(repeats + 1):
        wall, cpu = time.perf_counter(), time.process_time()
        events = run()
        seconds.append((time.perf_counter() - wall, time.process_time() - cpu))
    walls, cpus = zip(*seconds[1:], strict=True)
    return min(walls), min(cpus), events


if __name__ == "__main__":
    main()
