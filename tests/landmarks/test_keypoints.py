"""Files of key points, whole and spoilt."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evsplat.errors import DataError
from evsplat.landmarks import SETS, read_keypoints

FRAMES = 6
TIMES = list(range(1000, 1000 + FRAMES * 40_000, 40_000))


def points(count: int, size: int = 3) -> np.ndarray:
    values = np.random.default_rng(count).uniform(10, 200, (FRAMES, count, size))
    if size == 3:
        values[..., 2] = np.linspace(0.5, 1, count)
    return values


def write_openpose(path: Path, values: np.ndarray) -> Path:
    path.mkdir()
    for index, frame in enumerate(values):
        people = [{"pose_keypoints_2d": frame.ravel().tolist()}]
        (path / f"v_{index:012d}_keypoints.json").write_text(json.dumps({"people": people}))
    return path


def write_coco(path: Path, values: np.ndarray) -> Path:
    entries = [
        {"image_id": f"{index}.jpg", "keypoints": frame.ravel().tolist(), "score": 1.0}
        for index, frame in enumerate(values)
    ]
    path.write_text(json.dumps(entries[::-1]))
    return path


def write_mmpose(path: Path, values: np.ndarray) -> Path:
    entries = [
        {
            "frame_id": index,
            "instances": [
                {"keypoints": frame[:, :2].tolist(), "keypoint_scores": frame[:, 2].tolist()}
            ],
        }
        for index, frame in enumerate(values, 1)
    ]
    path.write_text(json.dumps({"meta_info": {}, "instance_info": entries}))
    return path


def write_npz(path: Path, values: np.ndarray) -> Path:
    np.savez(path, keypoints=values)
    return path


def write_csv(path: Path, values: np.ndarray) -> Path:
    header = ",".join(f"c{index}" for index in range(values[0].size))
    np.savetxt(path, values.reshape(FRAMES, -1), delimiter=",", header=header, comments="")
    return path


WRITERS = {
    "folder": write_openpose,
    "coco.json": write_coco,
    "mmpose.json": write_mmpose,
    "points.npz": write_npz,
    "points.csv": write_csv,
}


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("kind", SETS)
def test_every_kind_of_file_gives_the_points_that_went_in(tmp_path, name, kind):
    values = points(len(SETS[kind]))
    found = read_keypoints(WRITERS[name](tmp_path / name, values), TIMES)
    assert found.names == SETS[kind] and found.times_us.tolist() == TIMES
    np.testing.assert_allclose(found.places, values[..., :2])
    np.testing.assert_allclose(found.seen, values[..., 2])
    assert found.world is None and (np.diff(found.sigma_px) < 0).all()


@pytest.mark.parametrize("first", [0, 7, 98])
def test_frames_of_a_folder_come_in_the_order_of_the_numbers_in_their_names(tmp_path, first):
    """OpenPose names its files as the pictures are: 9 comes before 10, as among these."""
    values = points(25)
    for index, file in enumerate(sorted(write_openpose(tmp_path / "folder", values).iterdir())):
        file.rename(file.with_name(f"clip2_{first + index}_keypoints.json"))
    found = read_keypoints(tmp_path / "folder", TIMES)
    np.testing.assert_allclose(found.places, values[..., :2])


def test_without_confidences_all_points_are_seen(tmp_path):
    found = read_keypoints(write_npz(tmp_path / "a.npz", points(25, 2)), TIMES)
    assert (found.seen == 1).all()


def test_points_at_zero_and_frames_with_nobody_are_not_seen(tmp_path):
    values = points(17)
    values[:, 3] = 0
    folder = write_openpose(tmp_path / "folder", values)
    sorted(folder.iterdir())[2].write_text(json.dumps({"people": []}))
    found = read_keypoints(folder, TIMES)
    assert (found.seen[:, 3] == 0).all() and (found.seen[2] == 0).all()
    assert np.isfinite(found.places).all() and np.isfinite(found.sigma_px).all()


@pytest.mark.parametrize("header", [False, True])
@pytest.mark.parametrize("point", [0, 5, 16])
def test_empty_cells_of_a_table_are_points_that_were_not_found(tmp_path, point, header):
    values = points(17)
    lines = write_csv(tmp_path / "a.csv", values).read_text().splitlines()[0 if header else 1 :]
    first = lines[header].split(",")
    first[3 * point : 3 * point + 3] = ["", "", ""]
    lines[header] = ",".join(first)
    (tmp_path / "a.csv").write_text("\n".join(lines))
    found = read_keypoints(tmp_path / "a.csv", TIMES)
    assert np.flatnonzero(found.seen[0] == 0).tolist() == [point] and (found.seen[1:] > 0).all()
    np.testing.assert_allclose(found.places[1:], values[1:, :, :2])


def test_cocos_visibility_is_no_confidence(tmp_path):
    values = points(17)
    values[..., 2] = 2
    values[:, 5, 2] = 1
    found = read_keypoints(write_coco(tmp_path / "a.json", values), TIMES)
    assert (found.seen[:, 4] == 1).all() and (found.seen[:, 5] == 0.5).all()


def two_people(tmp_path):
    folder = write_openpose(tmp_path / "folder", points(25))
    document = json.loads(next(folder.iterdir()).read_text())
    next(folder.iterdir()).write_text(json.dumps({"people": document["people"] * 2}))
    return folder


def some_file(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    return tmp_path / name


BAD = {
    "2 people": two_people,
    "18 points": lambda path: write_npz(path / "a.npz", points(18)),
    "holds 6 frames": lambda path: write_npz(path / "a.npz", points(17)),
    "beyond": lambda path: write_npz(path / "a.npz", points(17) * [1e9, 1, 1]),
    "not shares": lambda path: write_npz(path / "a.npz", points(17) / [500, 500, 1]),
    "expected confidences": lambda path: write_npz(path / "a.npz", points(17) * [1, 1, 90]),
    "shows nobody": lambda path: write_npz(path / "a.npz", points(17) * 0),
    "shape": lambda path: write_npz(path / "a.npz", points(17)[0]),
    "nothing": lambda path: write_npz(path / "a.npz", np.array([{}], dtype=object)),
    "file not found": lambda path: path / "absent.json",
    "no .json file": lambda path: path,
    "no known file": lambda path: some_file(path, "a.txt", b""),
    "not a table": lambda path: some_file(path, "a.csv", b"1,2\n3,x\n"),
    "rows have 2": lambda path: some_file(path, "a.csv", b"1,2\n3,4\n"),
    "not a readable NumPy": lambda path: some_file(path, "a.npz", b"PK"),
    "not valid JSON": lambda path: some_file(path, "a.json", b"{"),
    "neither": lambda path: some_file(path, "a.json", b"{}"),
    "something else than numbers": lambda path: some_file(
        path, "a.json", b'[{"keypoints": ["a"]}]'
    ),
}


@pytest.mark.parametrize("said", BAD)
def test_a_bad_file_is_one_sentence_that_names_it(tmp_path, said):
    path = BAD[said](tmp_path)
    times = TIMES[:-1] if "frames" in said else TIMES
    said = "not a readable NumPy" if said == "nothing" else said
    with pytest.raises(DataError, match=said) as caught:
        read_keypoints(path, times)
    assert str(tmp_path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.fixture(scope="module")
def good_files(tmp_path_factory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("good")
    names = [name for name in WRITERS if "." in name]
    return {name: WRITERS[name](folder / name, points(17)).read_bytes() for name in names}


@settings(max_examples=150)
@given(data=st.data())
def test_any_mutation_gives_good_data_or_a_sentence(good_files, tmp_path_factory, data):
    name = data.draw(st.sampled_from(sorted(good_files)))
    content = bytearray(good_files[name])
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(content) - 1))
        how = data.draw(st.sampled_from(["byte", "cut", "remove", "repeat"]))
        if how == "byte":
            content[place] = data.draw(st.integers(0, 255))
        elif how == "cut":
            del content[max(1, place) :]
        elif how == "remove":
            del content[place : min(place + 5, len(content) - 1)]
        else:
            content[place:place] = content[place : place + 40]
    path = tmp_path_factory.getbasetemp() / name
    path.write_bytes(content)
    try:
        found = read_keypoints(path, TIMES)
    except DataError as error:
        assert str(path) in str(error)
    else:
        for values in (found.places, found.sigma_px, found.seen):
            assert np.isfinite(values).all()
        assert (found.sigma_px > 0).all() and 0 <= found.seen.min() <= found.seen.max() <= 1
