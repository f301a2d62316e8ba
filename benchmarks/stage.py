"""Time of one picture of a synthetic capture, beside an earlier renderer of the same room.

python benchmarks/stage.py [--threads T] [--repeats R]

A character of 27 thousand triangles in a room of 74 thousand, textured, with soft shadow and 2x2
samples. The earlier renderer (compiled with numba, one thread, a quiet machine of two cores) took
12.5 ms at 256 x 256 and 28.6 ms at 512 x 512. Best of the repeats, in CPU time. The last line is
JSON with a unit in each key.
"""

import evsplat  # noqa: F401 - before torch: it sets how OpenMP's threads wait

# isort: split
import argparse
import json
import time

import numpy as np

from evsplat.body.motion import load_motion
from evsplat.staging.assets import find_character, find_motion
from evsplat.staging.camera import MAIN, CameraPath, make_camera
from evsplat.staging.character import load_character
from evsplat.staging.motion import place_motion
from evsplat.staging.renderer import StageRenderer
from evsplat.staging.room import load_room

EARLIER_MS = {256: 12.5, 512: 28.6}
TIMES_US = np.linspace(200_000, 2_300_000, 8).round().astype(np.int64)


def main() -> None:
    """Print a table and one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=20)
    arguments = parser.parse_args()
    character = load_character(find_character("man"))
    track = place_motion(load_motion(find_motion("dance_b")), character)
    bones = track.body.bone_transforms(*track.at(TIMES_US.tolist()))
    renderer = StageRenderer(load_room(), character, threads=arguments.threads)
    results: dict[str, float] = {"threads": arguments.threads, "pictures": len(TIMES_US)}
    for size, earlier in EARLIER_MS.items():
        camera = make_camera(MAIN, size, size)
        path = CameraPath("orbit", 2.5).at(TIMES_US)
        # the first call also draws the empty room, which is kept while the camera stands
        first = best(lambda c=camera: renderer.draw(c, bones[:1]), 0)
        still = best(lambda c=camera: renderer.draw(c, bones), arguments.repeats)
        moving = best(
            lambda c=camera, p=path: renderer.draw(c, bones, world_to_camera=p),
            max(1, arguments.repeats // 5),
        )
        still_ms, moving_ms = still / len(TIMES_US), moving / len(TIMES_US)
        print(
            f"{size} px: {still_ms:.1f} ms a picture, earlier {earlier} ms "
            f"({earlier / still_ms:.1f}x); moving camera {moving_ms:.1f} ms; first {first:.0f} ms"
        )
        results |= {
            f"still_{size}_cpu_ms": round(still_ms, 2),
            f"moving_{size}_cpu_ms": round(moving_ms, 2),
            f"first_{size}_cpu_ms": round(first, 1),
            f"earlier_over_still_{size}": round(earlier / still_ms, 2),
        }
    print(json.dumps(results))


def best(run, repeats: int) -> float:
    """CPU milliseconds: best of the repeats after the first, or the first where there are none."""
    spent = []
    for _ in range(repeats + 1):
        start = time.process_time()
        run()
        spent.append(1e3 * (time.process_time() - start))
    return min(spent[1:] or spent)


if __name__ == "__main__":
    main()
