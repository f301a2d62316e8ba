"""What a training step would launch on a GPU, counted where there is none.

python benchmarks/launches.py [--method evsplat|paper] [--capture FOLDER] [--set NAME=VALUE ...]

A step runs on tensors that have shapes and a device but no data, as in the tests: every operation
of PyTorch counts that is no view and does not only take memory. An operation may be several kernels
(sorting is), so it is a lower bound. gsplat's own kernels are not counted; what evsplat does around
them is. Each part's forward count is that of its calls, its backward count that of the gradient
nodes that its forward pass made; "rest" is the loop and the sums between the parts. The frame is
one with the most renders, in the second half of the schedule. The last line is JSON.
"""

import evsplat  # noqa: F401 - before torch: it sets how OpenMP's threads wait

# isort: split
import argparse
import json
import sys
from pathlib import Path
from typing import cast

import pytest
from step import Stopwatch, draw_one_frame, watch_parts

from evsplat.capture import load_capture
from evsplat.config import override
from evsplat.devices import DeviceCache
from evsplat.methods import TRAINABLE, method_config
from evsplat.shipped import demo_capture
from evsplat.training.clock import Clock
from evsplat.training.trainer import Trainer

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from tests.training.foreign_device import (  # noqa: E402
    NAME,
    ForeignDevice,
    Here,
    as_on_a_gpu,
)


def main() -> None:
    """Print the table and one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--method", choices=("evsplat", "paper"), default="evsplat")
    parser.add_argument("--capture", type=Path, help="in place of the demo")
    parser.add_argument("--set", action="append", default=[], help="a setting")
    arguments = parser.parse_args()
    config = method_config(arguments.method, override({}, arguments.set), where="--set")
    capture = load_capture(arguments.capture or demo_capture()).for_training(config.policy)
    camera = capture.camera(capture.train_frames[0])
    with pytest.MonkeyPatch.context() as patch, ForeignDevice() as device:
        as_on_a_gpu(device, patch, camera.width, camera.height)
        composition = TRAINABLE[arguments.method].build(
            config, capture, 0, device=NAME, purpose="resume"
        )
        trainer = Trainer(composition, capture, Clock(100_000, fraction=0.7))
        trainer.data = cast(DeviceCache, Here())
        draw_one_frame(trainer)
        trainer.previous_nominal = trainer.clock.nominal  # no densification
        trainer.step()  # what is made once
        watch = Stopwatch(lambda: device.launches)
        watch_parts(watch, trainer)
        before = device.launches
        trainer.step()
        total = device.launches - before
    forward, backward = watch.forward, watch.backward
    parts = sorted(forward | backward, key=lambda part: -(forward[part] + backward[part]))
    print(f"{arguments.method}: {total} launches a step")
    print(f"  {'part':22s} {'forward':>8s} {'backward':>8s}")
    for part in parts:
        print(f"  {part:22s} {forward[part]:8.0f} {backward[part]:8.0f}")
    print(f"  {'rest':22s} {total - sum(forward.values()) - sum(backward.values()):8.0f}")
    around = forward["render"] + backward["render"]
    results = {
        "method": arguments.method,
        "launches": total,
        "launches_around_the_rasteriser": around,
        "launches_without_the_rasteriser": total - around,
    }
    print(json.dumps(results | {f"{part}": forward[part] + backward[part] for part in parts}))


if __name__ == "__main__":
    main()
