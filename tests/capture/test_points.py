"""PLY files of other people: read, or refused in one sentence before memory is taken."""

from pathlib import Path

import numpy as np
import pytest

from evsplat.capture.points import read_points, write_points
from evsplat.errors import DataError

XYZ = "property float x\nproperty float y\nproperty float z\n"
ONE = np.zeros(3, "<f4").tobytes()


def write(path: Path, properties: str, body: bytes, *, count: str = "1", more: str = "") -> Path:
    layout = "ascii" if body[:1].isdigit() else "binary_little_endian"
    header = f"ply\nformat {layout} 1.0\nelement vertex {count}\n{properties}{more}end_header\n"
    path.write_bytes(header.encode() + body)
    return path


def test_faces_after_the_vertices_are_left_alone(tmp_path: Path) -> None:
    faces = "element face 1\nproperty list uchar int vertex_indices\n"
    path = write(tmp_path / "a.ply", XYZ, ONE + b"\x03" + bytes(12), more=faces)
    points, colours = read_points(path)
    assert points.tolist() == [[0, 0, 0]] and colours.tolist() == [[0.5] * 3]


@pytest.mark.usefixtures("little_memory")
@pytest.mark.parametrize(
    ("properties", "body", "count", "said"),
    [
        (f"{XYZ}property list uchar int v\n", ONE, "1", "a vertex property of type 'list'"),
        (f"{XYZ}property quad w\n", ONE, "1", "a vertex property of type 'quad'"),
        (XYZ, ONE, "9" * 30, "a vertex count of '9999"),
        (XYZ, ONE, "9" * 5_000, "a vertex count of '9999"),
        (XYZ, ONE, "-1", "a vertex count of '-1'"),
        (XYZ, ONE, "many", "a vertex count of 'many'"),
        (XYZ, ONE, "1000000000000", "12 bytes after the header, too few for 1000000000000"),
        (XYZ, b"1 2 3\n", "1000000000000", "6 bytes after the header, too few for 1000000000000"),
    ],
)
def test_a_header_that_does_not_fit_the_file_is_refused(
    tmp_path: Path, properties: str, body: bytes, count: str, said: str
) -> None:
    path = write(tmp_path / "a.ply", properties, body, count=count)
    with pytest.raises(DataError, match=r"a\.ply: not a readable PLY .*; write it anew") as error:
        read_points(path)
    assert said in str(error.value) and len(str(error.value)) < 400


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("colour", [False, True])
def test_points_that_are_not_finite_are_refused(tmp_path: Path, value: float, colour: bool) -> None:
    rows = np.zeros((4, 6), "<f4")
    rows[2:, 4 if colour else 1] = value
    names = ("x", "y", "z", "red", "green", "blue")
    properties = "".join(f"property float {name}\n" for name in names)
    path = write(tmp_path / "a.ply", properties, rows.tobytes(), count="4")
    what = "red, green, blue" if colour else "x, y, z"
    with pytest.raises(DataError, match=rf"a\.ply: {what} of vertex 2 are .*\(there are 2 such\)"):
        read_points(path)


def test_doubles_beyond_single_precision_are_refused(tmp_path: Path) -> None:
    far = np.array([1e300, 0, 0], "<f8").tobytes()
    path = write(tmp_path / "a.ply", XYZ.replace("float", "double"), far)
    with pytest.raises(DataError, match="of vertex 0 are"):
        read_points(path)


def test_what_was_written_is_read(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    points, colours = rng.normal(size=(5, 3)), rng.integers(0, 256, (5, 3)) / 255
    write_points(tmp_path / "a.ply", np.float32(points), np.float32(colours))
    read = read_points(tmp_path / "a.ply")
    assert np.array_equal(read[0], np.float32(points))
    assert np.allclose(read[1], colours, atol=1e-6)


def test_a_missing_file_and_a_folder_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no\.ply: file not found"):
        read_points(tmp_path / "no.ply")
    with pytest.raises(DataError, match="a folder, expected a file"):
        read_points(tmp_path)
