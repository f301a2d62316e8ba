"""LPIPS 0.1 on AlexNet and VGG16: the linear heads ship with us, the networks' weights do not."""

import os
import re
from importlib import resources
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor, nn

from evsplat.errors import WeightsError
from evsplat.similarity.perceptual import Network, PerceptualMetric, numbered
from evsplat.untrusted.arrays import read_plain_npz
from evsplat.weights import MissingWeights, home_as_tilde, hub_folder, read_state, sha256_of

LpipsName = Literal["alex", "vgg"]

WEIGHTS_VARIABLE = "EVSPLAT_LPIPS_WEIGHTS"
"""Environment variable with a weight file, or a folder with files named as in the hub's cache."""


def _alexnet() -> Network:
    conv, act, pool = nn.Conv2d, nn.ReLU(), nn.MaxPool2d(3, 2)
    stages = (
        (conv(3, 64, 11, 4, 2), act),
        (pool, conv(64, 192, 5, 1, 2), act),
        (pool, conv(192, 384, 3, 1, 1), act),
        (conv(384, 256, 3, 1, 1), act),
        (conv(256, 256, 3, 1, 1), act),
    )
    return Network("LPIPS AlexNet", numbered(stages, "features.{place}"), min_side=31)


def _vgg16() -> Network:
    stages: list[list[nn.Module]] = []
    channels = 3
    for width, convolutions in ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3)):
        layers: list[nn.Module] = [nn.MaxPool2d(2, 2)] if stages else []
        for _ in range(convolutions):
            layers += [nn.Conv2d(channels, width, 3, 1, 1), nn.ReLU()]
            channels = width
        stages.append(layers)
    return Network("LPIPS VGG16", numbered(stages, "features.{place}"), min_side=16)


with torch.device("meta"):
    NETWORKS: dict[LpipsName, Network] = {"alex": _alexnet(), "vgg": _vgg16()}
HUB_FILES: dict[LpipsName, str] = {
    "alex": "alexnet-owt-7be5be79.pth",
    "vgg": "vgg16-397923af.pth",
}


def lpips_heads(name: LpipsName) -> list[Tensor]:
    """The five linear heads, version 0.1, each (C,) and not negative."""
    file = resources.files("evsplat") / "data" / "lpips_heads.npz"
    arrays = read_plain_npz(Path(str(file)))
    return [torch.from_numpy(arrays[f"{name}_{stage}"]) for stage in range(5)]


def load_lpips(
    name: LpipsName, weights: Path | str | None = None, *, device: torch.device | str = "cpu"
) -> PerceptualMetric:
    """LPIPS with weights from ``weights``, the environment variable or torch's hub cache.

    The three places are tried in this order; nothing is ever downloaded. A file or folder that was
    named but holds no network at all is a WeightsError; `MissingWeights` says that all is well but
    this network is in none of the places. torchvision's state dicts are read, with or without the
    classifier.
    """
    variable = os.environ.get(WEIGHTS_VARIABLE)
    named = [Path(place).expanduser() for place in (weights, variable) if place]
    for place in named:
        found = _look_in(place, name)
        if found is not None:
            return _metric(name, *found, device=device)
    cached = hub_folder() / HUB_FILES[name]
    if cached.is_file():
        return _metric(name, cached, _read(cached), device=device)
    raise MissingWeights(
        f"{NETWORKS[name].name}: no weights. Fetch https://download.pytorch.org/models/"
        f"{HUB_FILES[name]} and put it in {home_as_tilde(cached.parent)}, or give its place with "
        f"{WEIGHTS_VARIABLE}, or --lpips-weights of evsplat evaluate."
    )


def _look_in(place: Path, name: LpipsName) -> tuple[Path, dict[str, Tensor]] | None:
    """The weights of ``name`` in a file or folder that the user named; None if it has others."""
    if place.is_dir():
        files = {net: place / file for net, file in HUB_FILES.items() if (place / file).is_file()}
        if not files:
            expected = " or ".join(HUB_FILES.values())
            raise WeightsError(f"{place}: no LPIPS weights in this folder; expected {expected}.")
        return (files[name], _read(files[name])) if name in files else None
    if not place.is_file():
        raise WeightsError(f"{place}: no such LPIPS weight file or folder.")
    state = _read(place)
    fitting = [net for net, network in NETWORKS.items() if not _misfits(network, state)]
    if not fitting:
        first = {net: _misfits(network, state)[0] for net, network in NETWORKS.items()}
        raise WeightsError(
            f"{place}: neither torchvision's AlexNet ({first['alex']}) nor its VGG16 "
            f"({first['vgg']})."
        )
    return (place, state) if name in fitting else None


def _read(path: Path) -> dict[str, Tensor]:
    """State dict of ``path`` without the classifier; a hub file must have its own checksum."""
    checksum = re.search(r"-([0-9a-f]{8})\.pth$", path.name)
    if checksum and not sha256_of(path).startswith(checksum[1]):
        raise WeightsError(
            f"{path}: the SHA-256 does not begin with {checksum[1]}; the file is damaged, fetch it "
            "again."
        )
    return {k: v for k, v in read_state(path).items() if not k.startswith("classifier.")}


def _misfits(network: Network, state: dict[str, Tensor]) -> list[str]:
    expected = network.parameter_shapes
    return [
        f"{key}: expected {expected.get(key, 'nothing')}, found "
        f"{tuple(state[key].shape) if key in state else 'nothing'}"
        for key in sorted(expected.keys() | state.keys())
        if key not in state or tuple(state[key].shape) != expected.get(key)
    ]


def _metric(
    name: LpipsName, path: Path, state: dict[str, Tensor], *, device: torch.device | str
) -> PerceptualMetric:
    misfits = _misfits(NETWORKS[name], state)
    if misfits:
        raise WeightsError(f"{path}: not torchvision's {NETWORKS[name].name[6:]}: {misfits[0]}.")
    parameters = {key: value.float() for key, value in state.items()}
    return PerceptualMetric(
        NETWORKS[name], parameters, lpips_heads(name), sha256=sha256_of(path), device=device
    )
