"""How fast landmarks are found: the network in torch against the runtime that it was made for.

    python benchmarks/landmarks.py [--weights FILE] [--tflite FILE] [--capture PATH] [--threads N]

Milliseconds of CPU per picture: one pass of the network, one that finds the mask as well, the same
by ai-edge-litert (XNNPACK; needs the .tflite file that the weights were converted from), and all
that is done for a picture of the capture, by default the one that ships; then the passes that this
takes. The last line is one JSON object.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from evsplat.capture import Policy, load_capture
from evsplat.landmarks import LandmarkNetwork, find_landmarks, sharp_pictures
from evsplat.landmarks.network import SIDE, NetworkOutput
from evsplat.shipped import demo_capture

ROUNDS = 15


class Counted(LandmarkNetwork):
    """Counts the pictures that it is given."""

    passes = 0

    def __call__(self, pictures: torch.Tensor, *, mask: bool = False) -> NetworkOutput:
        """Outputs for pictures in [0, 1]."""
        self.passes += len(pictures)
        return super().__call__(pictures, mask=mask)


def milliseconds(call: Callable[[], object]) -> float:
    """CPU time of a call, median over rounds after a warm-up."""
    call()
    times = []
    for _ in range(ROUNDS):
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return 1000 * float(np.median(times))


def litert(path: Path, picture: np.ndarray, threads: int) -> float:
    from ai_edge_litert.interpreter import Interpreter

    interpreter = Interpreter(str(path), num_threads=threads)
    interpreter.allocate_tensors()
    interpreter.set_tensor(interpreter.get_input_details()[0]["index"], picture)
    return milliseconds(interpreter.invoke)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--tflite", type=Path)
    parser.add_argument("--capture", type=Path, default=demo_capture())
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    network = Counted(options.weights)
    picture = torch.rand(1, SIDE, SIDE, 3, generator=torch.Generator().manual_seed(0))
    result = {"network_ms": milliseconds(lambda: network(picture))}
    result["network_with_mask_ms"] = milliseconds(lambda: network(picture, mask=True))
    result["network_of_4_ms"] = milliseconds(lambda: network(picture.expand(4, -1, -1, -1))) / 4
    if options.tflite:
        result["litert_ms"] = litert(options.tflite, picture.numpy(), options.threads)
    capture = load_capture(options.capture).for_training(Policy())
    start = time.process_time()
    pictures = sharp_pictures(capture)
    result["sharpening_ms"] = 1000 * (time.process_time() - start) / len(pictures)
    network.passes = 0
    start = time.process_time()
    find_landmarks(capture, pictures, network=network, progress=False)
    result["landmarks_ms"] = 1000 * (time.process_time() - start) / len(pictures)
    result["passes"] = network.passes / len(pictures)
    for name, value in result.items():
        print(f"{name:20} {value:8.1f}")
    print(json.dumps({"threads": options.threads, "pictures": len(pictures), **result}))


if __name__ == "__main__":
    main()
