"""A camera in a file of its own: what is no camera is refused in one sentence."""

import json

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
    with pytest.raises(DataError, match="K: expected 3x3 numbers"):
        read_camera(path, 64, 48, ())
