"""BlazePose's landmark network in torch: the graph of a .tflite file, run layer by layer.

Bazarevsky et al., "BlazePose: On-device Real-time Body Pose tracking" (2020). A weight file,
written by `tools/convert_blazepose.py`, is in safetensors with the graph as JSON in its metadata::

    {"input": NAME, "outputs": [NAME, ...], "nodes": [{"kind": "CONV_2D", "in": [...], "out": NAME,
     "stride": [1, 1], "padding": "same", "activation": "relu6"}, ...]}

Kinds, paddings and activations are TensorFlow Lite's; weights are laid out as torch takes them.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from evsplat.errors import WeightsError
from evsplat.untrusted.tensors import read_safetensors
from evsplat.untrusted.text import parse_json

SIDE = 256
"""Width and height of the pictures that the network takes."""
POINTS = 39
"""Landmarks of the network: 33 of the body, 2 that span the next region, 4 of the hands."""
HEAT_SIDE = 64
_OUTPUTS = ((5 * POINTS,), (1,), (1, SIDE, SIDE), (POINTS, HEAT_SIDE, HEAT_SIDE), (3 * POINTS,))


@dataclass(frozen=True, eq=False)
class NetworkOutput:
    """Outputs of B pictures, as the network gives them."""

    points: Float[Tensor, "B 39 5"]
    """x, y and z in pixels of the crop, logits of visible and of present."""
    flag: Float[Tensor, "B"]
    """Share of belief that there is a person, 0..1."""
    mask: Float[Tensor, "B 256 256"] | None
    """Logit of the person per pixel; None where it was not asked for."""
    heat: Float[Tensor, "B 39 64 64"]
    """Logit of each point per cell."""
    world: Float[Tensor, "B 39 3"]
    """Metres from the middle of the hips, along the crop's axes: right, down, away."""


@dataclass(frozen=True)
class _Plan:
    """The layers that some outputs need, in order."""

    outputs: list[str]
    nodes: list[Mapping[str, Any]]
    last_uses: list[list[str]]
    """Names that no layer needs after each one."""

    @classmethod
    def to(cls, outputs: list[str], graph: Mapping[str, Any]) -> "_Plan":
        needed = set(outputs)
        nodes: list[Mapping[str, Any]] = []
        last: list[list[str]] = []
        for node in reversed(graph["nodes"]):
            if node["out"] in needed:
                nodes.append(node)
                last.append([name for name in node["in"] if name not in needed])
                needed |= set(node["in"])
        return cls(outputs, nodes[::-1], last[::-1])


class LandmarkNetwork:
    """A converted landmark network on a device."""

    def __init__(
        self, path: Path | str | None = None, *, device: torch.device | str = "cpu"
    ) -> None:
        """``path``: a converted file; without one the `full` network that ships with evsplat.

        Raises:
            WeightsError: The file is missing or is not such a network.
        """
        self.path = Path(str(files("evsplat") / "data" / "blazepose_full.safetensors"))
        if path is not None:
            self.path = Path(path)
        self._graph, weights = _read(self.path)
        self._weights = {
            name: _fast_layout(weight.float().to(device)) for name, weight in weights.items()
        }
        self._device = torch.device(device)
        self._whole = _Plan.to(self._graph["outputs"], self._graph)
        self._check()
        points, flag, _, heat, world = self._graph["outputs"]
        self._without_mask = _Plan.to([points, flag, heat, world], self._graph)

    @torch.inference_mode()
    def __call__(
        self, pictures: Float[Tensor, "B 256 256 3"], *, mask: bool = False
    ) -> NetworkOutput:
        """Outputs for pictures in [0, 1], on the network's device.

        ``mask``: the person's mask as well, which takes two thirds as long as all the rest.
        """
        plan = self._whole if mask else self._without_mask
        outputs = self._run(pictures.movedim(-1, 1).to(self._device), plan)
        person = outputs.pop(2)[:, 0] if mask else None
        points, flag, heat, world = outputs
        return NetworkOutput(
            points.reshape(-1, POINTS, 5),
            flag[:, 0],
            person,
            heat,
            world.reshape(-1, POINTS, 3),
        )

    def _run(self, picture: Float[Tensor, "B 3 256 256"], plan: "_Plan") -> list[Tensor]:
        """The outputs of a plan."""
        values = {self._graph["input"]: picture.contiguous(memory_format=torch.channels_last)}
        for node, done in zip(plan.nodes, plan.last_uses, strict=True):
            inputs = [
                values[name] if name in values else self._weights[name] for name in node["in"]
            ]
            values[node["out"]] = _ACTIVATE[node.get("activation")](
                _RUN[node["kind"]](node, *inputs)
            )
            for name in done:
                values.pop(name, None)
        return [values[name] for name in plan.outputs]

    @torch.inference_mode()
    def _check(self) -> None:
        """A `WeightsError` where the graph cannot be run or gives something else."""
        try:
            outputs = self._run(torch.zeros(1, 3, SIDE, SIDE, device=self._device), self._whole)
            shapes = [tuple(output.shape[1:]) for output in outputs]
        except (KeyError, TypeError, ValueError, IndexError, RuntimeError) as error:
            raise WeightsError(
                f"{self.path}: its graph cannot be run ({type(error).__name__}: {error}); convert "
                "the network again with tools/convert_blazepose.py."
            ) from error
        if shapes != list(_OUTPUTS):
            raise WeightsError(
                f"{self.path}: gives outputs of shapes {shapes}, expected {list(_OUTPUTS)}; this "
                "is not BlazePose's landmark network."
            )


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Graph and weights of a file."""
    if not path.is_file():
        raise WeightsError(
            f"{path}: file not found; give a network that tools/convert_blazepose.py has written."
        )
    try:
        weights, texts = read_safetensors(path)
        graph = parse_json(texts["graph"])
        kinds = {node["kind"] for node in graph["nodes"]}
        graph["input"], graph["outputs"]
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise WeightsError(
            f"{path}: not a network that tools/convert_blazepose.py has written "
            f"({type(error).__name__}: {error})."
        ) from error
    if unknown := kinds - _RUN.keys():
        raise WeightsError(
            f"{path}: has layers of kind {', '.join(sorted(map(str, unknown)))}, expected "
            f"{', '.join(_RUN)}; this is not BlazePose's landmark network."
        )
    return graph, weights


def _fast_layout(weight: Tensor) -> Tensor:
    """Weights of convolutions channels last, as the values that they meet."""
    return weight.contiguous(memory_format=torch.channels_last) if weight.ndim == 4 else weight


def _same_padding(size: int, kernel: int, stride: int) -> tuple[int, int]:
    """Pixels before and after: as many outputs as strides begin, the odd pixel after."""
    total = max((-(-size // stride) - 1) * stride + kernel - size, 0)
    return total // 2, total - total // 2


def _padded(
    value: Tensor, node: Mapping[str, Any], kernel: tuple[int, int], fill: float = 0.0
) -> tuple[Tensor, tuple[int, int]]:
    """What is left to do for the layer's own padding, and the value with the rest done."""
    if node["padding"] == "valid":
        return value, (0, 0)
    top, bottom = _same_padding(value.shape[2], kernel[0], node["stride"][0])
    left, right = _same_padding(value.shape[3], kernel[1], node["stride"][1])
    if (top, left) == (bottom, right):
        return value, (top, left)
    return F.pad(value, (left, right, top, bottom), value=fill), (0, 0)


def _convolve(node: Mapping[str, Any], value: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    value, padding = _padded(value, node, (weight.shape[2], weight.shape[3]))
    groups = weight.shape[0] if node["kind"] == "DEPTHWISE_CONV_2D" else 1
    return F.conv2d(value, weight, bias, node["stride"], padding, groups=groups)


def _max_pool(node: Mapping[str, Any], value: Tensor) -> Tensor:
    value, padding = _padded(value, node, tuple(node["size"]), fill=float("-inf"))
    return F.max_pool2d(value, node["size"], node["stride"], padding)


def _pad(node: Mapping[str, Any], value: Tensor) -> Tensor:
    _, rows, columns, channels = node["widths"]
    return F.pad(value, (*columns, *rows, *channels))


def _reshape(node: Mapping[str, Any], value: Tensor) -> Tensor:
    return value.movedim(1, -1).reshape(value.shape[0], *node["shape"][1:])


_RUN: dict[str, Callable[..., Tensor]] = {
    "CONV_2D": _convolve,
    "DEPTHWISE_CONV_2D": _convolve,
    "ADD": lambda node, a, b: a + b,
    "PAD": _pad,
    "RESIZE_BILINEAR": lambda node, value: F.interpolate(
        value, node["size"], mode="bilinear", align_corners=False
    ),
    "MAX_POOL_2D": _max_pool,
    "RESHAPE": _reshape,
    "LOGISTIC": lambda node, value: torch.sigmoid(value),
}
_ACTIVATE: dict[str | None, Callable[[Tensor], Tensor]] = {
    None: lambda value: value,
    "relu": torch.relu_,
    "relu6": lambda value: value.clamp_(0, 6),
}
