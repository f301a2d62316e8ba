"""The torch executor of BlazePose's graph against the runtime that the graph was made for."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from evsplat.capture import load_capture
from evsplat.errors import WeightsError
from evsplat.landmarks.detect import Region, crop
from evsplat.landmarks.network import LandmarkNetwork, NetworkOutput, _same_padding
from evsplat.shipped import demo_capture

REFERENCE = Path(__file__).with_name("reference.npz")
TFLITE = os.environ.get("EVSPLAT_BLAZEPOSE_TFLITE")
"""pose_landmark_full.tflite, where there is one."""
LARGEST = {"points": 256.0, "flag": 1.0, "mask": 64.0, "heat": 64.0, "world": 1.0}
"""Outputs are compared as shares of what they reach."""


def demo_crop() -> torch.Tensor:
    """The dancer of the capture that ships, blurry."""
    capture = load_capture(demo_capture())
    picture = capture.image(capture.frames[0])
    height, width = picture.shape[:2]
    region = Region(np.array([width / 2, height / 2]), 0.9 * max(height, width), 0.1)
    return crop(picture, region, mirrored=False)


def thinned(points, flag, mask, heat, world) -> dict[str, np.ndarray]:
    """Outputs of one picture, the large ones at every fifth pixel."""
    values = {"points": points, "flag": flag, "mask": mask[:, ::5, ::5]}
    values |= {"heat": heat[:, :, ::5, ::5], "world": world}
    return {name: np.asarray(value, np.float32) for name, value in values.items()}


def outputs(found: NetworkOutput) -> dict[str, np.ndarray]:
    return thinned(found.points, found.flag, found.mask, found.heat, found.world)


def test_outputs_are_those_that_litert_gave(network):
    found = outputs(network(demo_crop()[None], mask=True))
    with np.load(REFERENCE) as expected:
        assert expected["flag"] > 0.9
        for name, largest in LARGEST.items():
            np.testing.assert_allclose(found[name], expected[name], atol=1e-3 * largest)


@pytest.mark.skipif(TFLITE is None, reason="needs EVSPLAT_BLAZEPOSE_TFLITE, the file converted")
def test_outputs_are_those_of_litert_on_people_and_on_noise(network):
    litert = pytest.importorskip("ai_edge_litert.interpreter")
    interpreter = litert.Interpreter(TFLITE, num_threads=1)
    interpreter.allocate_tensors()
    person = demo_crop()
    noise = torch.rand(256, 256, 3, generator=torch.Generator().manual_seed(0))
    for picture in (person, person.flip(1), person.flip(0), noise):
        interpreter.set_tensor(interpreter.get_input_details()[0]["index"], picture[None].numpy())
        interpreter.invoke()
        given = [interpreter.get_tensor(part["index"]) for part in interpreter.get_output_details()]
        points, flag, mask, heat, world = given
        expected = thinned(
            points.reshape(1, 39, 5),
            flag[:, 0],
            mask[..., 0],
            np.moveaxis(heat, -1, 1),
            world.reshape(1, 39, 3),
        )
        found = outputs(network(picture[None], mask=True))
        for name, values in expected.items():
            largest = max(1.0, np.abs(values).max())
            np.testing.assert_allclose(found[name], values, atol=1e-3 * largest)


def test_pictures_in_a_batch_do_not_meet(network):
    person = demo_crop()
    both = outputs(network(torch.stack((person, person.flip(1))), mask=True))
    one = outputs(network(person.flip(1)[None], mask=True))
    for name, largest in LARGEST.items():
        np.testing.assert_allclose(both[name][1:], one[name], atol=1e-4 * largest)


def test_what_is_found_does_not_depend_on_the_mask_being_asked_for(network):
    picture = demo_crop()[None]
    whole, without = network(picture, mask=True), network(picture)
    assert without.mask is None
    for name in LARGEST.keys() - {"mask"}:
        assert torch.equal(getattr(without, name), getattr(whole, name))


def test_same_padding_is_tensorflows():
    """An even picture and a stride of 2 need one pixel, which comes after it."""
    assert _same_padding(256, 3, 2) == (0, 1)
    assert _same_padding(255, 3, 2) == (1, 1)
    assert _same_padding(64, 5, 1) == (2, 2)
    assert _same_padding(8, 2, 2) == (0, 0)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_outputs_are_the_same_on_cuda(network):
    picture = demo_crop()[None]
    found, expected = outputs_of_cuda(picture), outputs(network(picture, mask=True))
    for name, largest in LARGEST.items():
        np.testing.assert_allclose(found[name], expected[name], atol=2e-3 * largest)


def outputs_of_cuda(picture) -> dict[str, np.ndarray]:
    found = LandmarkNetwork(device="cuda")(picture, mask=True)
    return thinned(*(getattr(found, name).cpu() for name in LARGEST))


def spoilt(tmp_path: Path, change) -> Path:
    """A copy of the shipped network with its graph changed."""
    source = LandmarkNetwork().path
    with safe_open(source, framework="pt") as file:
        metadata = file.metadata()
    graph = json.loads(metadata["graph"])
    weights = load_file(source)
    change(graph, weights)
    path = tmp_path / "spoilt.safetensors"
    save_file(weights, path, {"graph": json.dumps(graph)})
    return path


def without_a_weight(graph, weights):
    weights.popitem()


def with_a_strange_layer(graph, weights):
    graph["nodes"][5]["kind"] = "SOFTMAX"


def with_fewer_outputs(graph, weights):
    graph["outputs"] = graph["outputs"][:2]


def with_a_wrong_stride(graph, weights):
    graph["nodes"][1]["stride"] = [0, 0]


@pytest.mark.parametrize(
    "change", [without_a_weight, with_a_strange_layer, with_fewer_outputs, with_a_wrong_stride]
)
def test_a_file_that_is_no_such_network_is_one_sentence(tmp_path, change):
    with pytest.raises(WeightsError, match="spoilt.safetensors"):
        LandmarkNetwork(spoilt(tmp_path, change))


@pytest.mark.parametrize("content", [b"", b"not a network", b"\xff" * 100])
def test_a_file_of_something_else_is_one_sentence(tmp_path, content):
    path = tmp_path / "other.safetensors"
    path.write_bytes(content)
    with pytest.raises(WeightsError, match="other.safetensors"):
        LandmarkNetwork(path)
    with pytest.raises(WeightsError, match="file not found"):
        LandmarkNetwork(tmp_path / "absent.safetensors")
