"""Quality of up-sampling in time: made pictures and made blur against true ones.

python benchmarks/interpolation.py [CAPTURE ...] [--blur] [--video CLIP] [--pictures N]

Of sharp pictures every other one is left out and made again; with --blur, blur made of the
captures' sharp pictures is compared with their own. Plain blending of the two neighbours stands
beside. Super SloMo takes part where its weights are found. PSNR in dB of 8-bit coded values;
"moving" counts the pixels that differ by more than 20 levels between the neighbours or from the
truth. The last line is JSON with a unit in each key.
"""

import evsplat  # noqa: F401 - before torch: it sets how OpenMP's threads wait

# isort: split
import argparse
import itertools
import json
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from evsplat.capture import load_capture
from evsplat.footage import open_footage
from evsplat.options import SynthesisSettings
from evsplat.pictures.files import read_image
from evsplat.synthesis.exposure import ExposureMean, plan_exposures
from evsplat.synthesis.flow import FlowInterpolator
from evsplat.synthesis.interpolate import Interpolator, Picture
from evsplat.synthesis.super_slomo import SuperSloMo
from evsplat.weights import MissingWeights

GAMMA = 2.2
MOVING_LEVELS = 20
FACTOR = 8


class Blend:
    """Fades from one picture to the next: nothing moves. The yardstick for the other kinds."""

    def between(self, before: Picture, after: Picture, fractions: Sequence[float]) -> Iterator:
        """Linear light at each fraction."""
        for fraction in fractions:
            yield (1 - fraction) * before.linear + fraction * after.linear


def main() -> None:
    """Print one line per source and one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("captures", nargs="*", type=Path)
    parser.add_argument("--blur", action="store_true", help="their blur is true: compare it too")
    parser.add_argument("--video", type=Path)
    parser.add_argument("--pictures", type=int, default=12, help="pictures made per source")
    arguments = parser.parse_args()
    kinds: dict[str, Interpolator] = {"blend": Blend(), "flow": FlowInterpolator()}
    try:
        kinds["super_slomo"] = SuperSloMo("power")
    except MissingWeights as error:
        print(f"without Super SloMo: {error}")
    results: dict[str, float] = {}
    for path in arguments.captures:
        capture = load_capture(path)
        pictures = [read_image(frame.sharp) for frame in capture.frames if frame.sharp]
        results |= middles(path.name, pictures, kinds, arguments.pictures)
        if arguments.blur:
            results |= blur(path, kinds)
    if arguments.video:
        footage = itertools.islice(open_footage(arguments.video), 3 * arguments.pictures)
        pictures = [halved(picture.pixels) for picture in footage]
        results |= middles(arguments.video.stem, pictures, kinds, arguments.pictures)
    print(json.dumps({key: round(value, 2) for key, value in results.items()}))


def middles(
    name: str, pictures: list[np.ndarray], kinds: dict[str, Interpolator], count: int
) -> dict[str, float]:
    """PSNR of the picture made half way between two that have one in the middle."""
    chosen = np.unique(np.linspace(1, len(pictures) - 2, count).round().astype(int))
    errors: dict[str, list[tuple[float, float]]] = {kind: [] for kind in kinds}
    seconds = dict.fromkeys(kinds, np.inf)
    for i in chosen:
        before, truth, after = (pictures[i + step].astype(np.float32) for step in (-1, 0, 1))
        change = np.maximum(np.abs(after - before), np.abs(truth - before)).max(-1)
        for kind, interpolator in kinds.items():
            start = time.perf_counter()
            made = next(interpolator.between(picture(before), picture(after), [0.5]))
            seconds[kind] = min(seconds[kind], time.perf_counter() - start)
            error = np.square(coded(made) - truth / 255).mean(-1)
            errors[kind].append((psnr(error), psnr(error[change > MOVING_LEVELS])))
    results: dict[str, float] = {}
    for kind, values in errors.items():
        full, moving = np.mean(values, axis=0)
        print(
            f"{name:24s} middle  {kind:12s} {full:6.2f} dB full  {moving:6.2f} dB moving"
            f"  {1e3 * seconds[kind]:7.0f} ms"
        )
        results |= {
            f"{name}_{kind}_middle_full_db": full,
            f"{name}_{kind}_middle_moving_db": moving,
            f"{name}_{kind}_best_ms": 1e3 * seconds[kind],
        }
    return results


def blur(path: Path, kinds: dict[str, Interpolator]) -> dict[str, float]:
    """PSNR of blur made of the sharp pictures against the capture's own."""
    capture = load_capture(path)
    frames = capture.frames
    times = np.array([frame.mid_us for frame in frames])
    lengths = {frame.exposure_us[1] - frame.exposure_us[0] for frame in frames}
    settings = SynthesisSettings(exposure_us=min(lengths), upsample=FACTOR)
    plan = plan_exposures(times, settings)
    fractions = [step / FACTOR for step in range(1, FACTOR)]
    sharp_files = [frame.sharp for frame in frames if frame.sharp is not None]
    pictures = [picture(read_image(file).astype(np.float32)) for file in sharp_files]
    results: dict[str, float] = {}
    for kind, interpolator in [(None, None), *kinds.items()]:
        mean, values = ExposureMean(plan), []
        for light in subframes(pictures, interpolator, fractions):
            for exposure, made in mean.add(light):
                truth = read_image(frames[exposure.source].image) / 255
                sharp = pictures[exposure.source].coded
                made = sharp if interpolator is None else coded(made)
                mask = capture.mask(frames[exposure.source])
                assert mask is not None
                person = mask.numpy() > 0
                error = np.square(made - truth).mean(-1)
                values.append((psnr(error), psnr(error[person])))
        full, on_person = np.mean(values, axis=0)
        label = kind or "no blur"
        print(
            f"{path.name:24s} blur    {label:12s} {full:6.2f} dB full  {on_person:6.2f} dB person"
        )
        key = f"{path.name}_{label.replace(' ', '_')}_blur"
        results |= {f"{key}_full_db": full, f"{key}_person_db": on_person}
    return results


def subframes(
    pictures: list[Picture], interpolator: Interpolator | None, fractions: list[float]
) -> Iterator[np.ndarray]:
    """Linear light of all sub-frames in order."""
    for before, after in itertools.pairwise(pictures):
        yield before.linear
        yield from (interpolator or Blend()).between(before, after, fractions)
    yield pictures[-1].linear


def picture(pixels: np.ndarray) -> Picture:
    """Both forms of float pixels in [0, 255]."""
    values = pixels / np.float32(255)
    return Picture(values, values ** np.float32(GAMMA))


def coded(linear: np.ndarray) -> np.ndarray:
    """As an 8-bit picture stores linear light, in [0, 1]."""
    return np.round(linear.clip(0, 1) ** (1 / GAMMA) * 255) / 255


def halved(pixels: np.ndarray) -> np.ndarray:
    """Means over squares of two pixels."""
    height, width = pixels.shape[0] // 2 * 2, pixels.shape[1] // 2 * 2
    squares = pixels[:height, :width].reshape(height // 2, 2, width // 2, 2, -1)
    return squares.mean(axis=(1, 3)).round().astype(np.uint8)


def psnr(squared_error: np.ndarray) -> float:
    """Decibels of full scale 1."""
    return float(-10 * np.log10(squared_error.mean()))


if __name__ == "__main__":
    main()
