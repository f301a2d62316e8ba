"""A camera in a file of its own: what is no camera is refused in one sentence."""

import json

import numpy as np
import pytest

from evsplat.capture.camera_file import read_camera
from evsplat.errors import DataError


@pytest.mark.parametrize("required", [(), ("K",), ("width", "K")])
@pytest.mark.parametrize("content", [[], [{"K": 1}], 3, None, "camera"])
def test_what_is_no_object_is_no_camera(tmp_path, content, required):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(content))
    with pytest.raises(DataError, match="expected one camera as in capture.json") as caught:
        read_camera(path, 64, 48, required)
    assert str(caught.value).startswith(f"{path}: found ")


def test_missing_keys_are_named_and_a_matrix_that_nobody_required_as_well(tmp_path):
    path = tmp_path / "camera.json"
    path.write_text("{}")
    with pytest.raises(DataError, match="width, K missing"):
        read_camera(path, 64, 48, ("width", "K"))
    with pytest.raises(DataError, match="K: found nothing, expected a value"):
        read_camera(path, 64, 48, ())


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("K", [[90, 0, 32], [0, 90, 24]], "expected 3x3 finite numbers"),
        ("K", [[90, 0, 32], [0, 0, 24], [0, 0, 1]], "fx and fy above 0"),
        ("K", [[3e6, 0, 32], [0, 90, 24], [0, 0, 1]], "found focal lengths of 3e"),
        ("K", [[90, 0, 5000], [0, 90, 24], [0, 0, 1]], r"found a principal point of \(5000, 24\)"),
        ("world_to_camera", np.diag([2, 2, 2, 1]).tolist(), "not orthonormal"),
        ("world_to_camera", [[1]], "expected 4x4 finite numbers"),
    ],
)
def test_what_no_camera_has_is_said_of_this_file_and_its_field(tmp_path, key, value, told):
    path = tmp_path / "camera.json"
    K = [[90, 0, 32], [0, 90, 24], [0, 0, 1]]
    path.write_text(json.dumps({"K": K, key: value}))
    with pytest.raises(DataError, match=told) as caught:
        read_camera(path, 64, 48)
    assert str(caught.value).startswith(f"{path}: {key}: found ")
