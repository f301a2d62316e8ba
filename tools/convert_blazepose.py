"""Convert BlazePose: `convert_blazepose.py pose_landmark_full.tflite blazepose_full.safetensors`.

The .tflite files are those of the npm package @mediapipe/pose 0.5.1675469404 (Apache-2.0), which
`npm pack` fetches. The tool needs the PyPI package `tflite`, evsplat itself does not. Weights stay
what they are, half floats, and are laid out as torch takes them; the graph goes into the metadata
as JSON, in the form that `evsplat.landmarks.network` documents.
"""

import argparse
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import tflite
from safetensors.numpy import save_file

ACTIVATIONS = {0: None, 1: "relu", 3: "relu6"}
OPTIONS = {
    "CONV_2D": tflite.Conv2DOptions,
    "DEPTHWISE_CONV_2D": tflite.DepthwiseConv2DOptions,
    "ADD": tflite.AddOptions,
    "RESIZE_BILINEAR": tflite.ResizeBilinearOptions,
    "MAX_POOL_2D": tflite.Pool2DOptions,
}
KINDS = {v: k for k, v in vars(tflite.BuiltinOperator).items() if isinstance(v, int)}
TYPES = {
    tflite.TensorType.FLOAT16: "<f2",
    tflite.TensorType.FLOAT32: "<f4",
    tflite.TensorType.INT32: "<i4",
}


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", type=Path)
    parser.add_argument("target", type=Path)
    arguments = parser.parse_args()
    content = arguments.source.read_bytes()
    weights, graph = convert(content)
    metadata = {
        "graph": json.dumps(graph, separators=(",", ":")),
        "made_from": f"{arguments.source.name} of @mediapipe/pose, "
        f"sha256 {hashlib.sha256(content).hexdigest()}",
        "license": "Apache-2.0",
    }
    save_file(weights, arguments.target, metadata)
    print(f"{arguments.target}: {arguments.target.stat().st_size / 1e6:.2f} MB")


def convert(content: bytes) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Weights by name, and the graph, of a flatbuffer."""
    model = tflite.Model.GetRootAsModel(content, 0)
    subgraph = model.Subgraphs(0)
    reader = _Reader(model, subgraph)
    nodes = [
        node
        for index in range(subgraph.OperatorsLength())
        if (node := reader.node(subgraph.Operators(index))) is not None
    ]
    graph = {
        "input": reader.name(subgraph.Inputs(0)),
        "outputs": [reader.name(index) for index in subgraph.OutputsAsNumpy()],
        "nodes": nodes,
    }
    return reader.weights, graph


class _Reader:
    """Constants and operators of a subgraph."""

    def __init__(self, model: Any, subgraph: Any) -> None:
        self._model, self._subgraph = model, subgraph
        self._same: dict[int, int] = {}
        self.weights: dict[str, np.ndarray] = {}

    def name(self, index: int) -> str:
        """Name of a tensor; of a constant that was half as wide the narrow one's."""
        return f"t{self._same.get(int(index), int(index))}"

    def node(self, operator: Any) -> dict[str, Any] | None:
        """An operator in words; None for one that only widens a constant."""
        code = self._model.OperatorCodes(operator.OpcodeIndex())
        kind = KINDS[max(code.BuiltinCode(), code.DeprecatedBuiltinCode())]
        inputs = [int(index) for index in operator.InputsAsNumpy()]
        if kind == "DEQUANTIZE":
            self._same[operator.Outputs(0)] = inputs[0]
            return None
        node = {"kind": kind, "out": self.name(operator.Outputs(0))}
        if kind in OPTIONS:
            table, options = operator.BuiltinOptions(), OPTIONS[kind]()
            options.Init(table.Bytes, table.Pos)
            node |= self._settings(kind, options)
        if kind in ("CONV_2D", "DEPTHWISE_CONV_2D"):
            weight = self._constant(inputs[1])
            axes = (0, 3, 1, 2) if kind == "CONV_2D" else (3, 0, 1, 2)
            self.weights[self.name(inputs[1])] = np.ascontiguousarray(weight.transpose(axes))
            self.weights[self.name(inputs[2])] = self._constant(inputs[2])
            node |= {"in": [self.name(index) for index in inputs]}
        elif kind == "ADD":
            node |= {"in": [self.name(index) for index in inputs]}
        else:
            node |= {"in": [self.name(inputs[0])]}
        if kind == "PAD":
            node["widths"] = self._constant(inputs[1]).tolist()
        if kind == "RESIZE_BILINEAR":
            node["size"] = self._constant(inputs[1]).tolist()
        if kind == "RESHAPE":
            node["shape"] = self._constant(inputs[1]).tolist()
        return node

    def _settings(self, kind: str, options: Any) -> dict[str, Any]:
        if kind == "RESIZE_BILINEAR":
            assert options.HalfPixelCenters() and not options.AlignCorners()
            return {}
        settings: dict[str, Any] = {"activation": ACTIVATIONS[options.FusedActivationFunction()]}
        if kind == "ADD":
            return settings
        settings["stride"] = [options.StrideH(), options.StrideW()]
        settings["padding"] = "same" if options.Padding() == tflite.Padding.SAME else "valid"
        if kind == "MAX_POOL_2D":
            settings["size"] = [options.FilterHeight(), options.FilterWidth()]
        else:
            assert options.DilationHFactor() == options.DilationWFactor() == 1
        if kind == "DEPTHWISE_CONV_2D":
            assert options.DepthMultiplier() == 1
        return settings

    def _constant(self, index: int) -> np.ndarray:
        tensor = self._subgraph.Tensors(self._same.get(index, index))
        data = self._model.Buffers(tensor.Buffer()).DataAsNumpy().tobytes()
        return np.frombuffer(data, TYPES[tensor.Type()]).reshape(tensor.ShapeAsNumpy())


if __name__ == "__main__":
    main()
