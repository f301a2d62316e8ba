"""ST-LPIPS on AlexNet (Ghildyal and Liu 2022), weights from the wheel of stlpips-pytorch.

A learned distance that forgives shifts of a pixel or two. It is not LPIPS and never takes its name.
Only the weight file of the installed package is read; its code is not imported.
"""

import importlib.util
from pathlib import Path

import torch
from torch import nn

from evsplat.errors import WeightsError
from evsplat.similarity.perceptual import Blur, Network, PerceptualMetric, numbered
from evsplat.weights import MissingWeights, read_state, sha256_of

PACKAGE = "stlpips_pytorch"

_CHANNELS = (64, 192, 384, 256, 256)


def _alexnet() -> Network:
    conv, act, pool = nn.Conv2d, nn.ReLU(), nn.MaxPool2d(3, 1)
    stages = (
        (conv(3, 64, 11, 1, 2), Blur(64), act),
        (pool, Blur(64), conv(64, 192, 5, 1, 2), act),
        (pool, Blur(192), conv(192, 384, 3, 1, 1), act),
        (conv(384, 256, 3, 1, 1), act),
        (conv(256, 256, 3, 1, 1), act),
    )
    return Network("ST-LPIPS AlexNet", numbered(stages, "net.slice{stage}.{place}"), min_side=21)


with torch.device("meta"):
    NETWORK = _alexnet()


def load_st_lpips(*, device: torch.device | str = "cpu") -> PerceptualMetric:
    """ST-LPIPS with the installed package's weights; `MissingWeights` where it is not installed."""
    spec = importlib.util.find_spec(PACKAGE)
    if spec is None or not spec.submodule_search_locations:
        raise MissingWeights(
            "ST-LPIPS AlexNet: no weights. Install the package that carries them with: pip install "
            "'evsplat[perceptual]'."
        )
    folder = Path(spec.submodule_search_locations[0])
    path = folder / "weights" / "vST0.0" / "alex_shift_tolerant.pth"
    if not path.is_file():
        raise WeightsError(f"{path}: file not found; expected stlpips-pytorch 0.0.2.")
    state = read_state(path)
    heads = {f"lin{i}.model.1.weight": (1, c, 1, 1) for i, c in enumerate(_CHANNELS)}
    for key, shape in {**NETWORK.parameter_shapes, **heads}.items():
        found = tuple(state[key].shape) if key in state else "nothing"
        if found != shape:
            raise WeightsError(f"{path}: {key}: expected {shape}, found {found}.")
    return PerceptualMetric(
        NETWORK,
        {key: state[key] for key in NETWORK.parameter_shapes},
        [state[key].flatten() for key in heads],
        sha256=sha256_of(path),
        device=device,
    )
