"""capture.json by a stranger: names and paths that reach elsewhere, JSON that is none."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evsplat.capture import Finding, load_capture, validate_capture
from evsplat.capture.derive import derived_capture
from evsplat.errors import DataError

from ..test_names import BAD_NAMES
from .editing import edit

Factory = Callable[..., Path]
PATHS = {
    "frames[3].image": ("frames", 3, "image"),
    "frames[3].sharp": ("frames", 3, "sharp"),
    "frames[3].mask": ("frames", 3, "mask"),
    "novel_views[0].image": ("novel_views", 0, "image"),
    "body.file": ("body", "file"),
    "events.file": ("events", "file"),
}


def put(path: Path, keys: tuple, value: Any) -> Any:
    """Replace a value of capture.json; gives the old one."""
    old = []

    def change(document: dict[str, Any]) -> None:
        inner: Any = document
        for key in keys[:-1]:
            inner = inner[key]
        old.append(inner[keys[-1]])
        inner[keys[-1]] = value

    edit(path, change)
    return old[0]


def errors(path: Path, field: str) -> list[Finding]:
    """Errors of one field; there are some, and the capture cannot be loaded."""
    found = [f for f in validate_capture(path, deep=False) if f.severity == "error"]
    with pytest.raises(DataError) as refused:
        load_capture(path)
    assert str(refused.value).startswith(str(found[0]))
    chosen = [finding for finding in found if finding.field == field]
    assert chosen, found
    for finding in chosen:
        assert finding.file == path / "capture.json" and len(str(finding)) < 500
        assert str(finding).isprintable()
    return chosen


@pytest.mark.parametrize("kind", BAD_NAMES)
def test_a_name_that_could_write_elsewhere_is_an_error(tiny_capture: Factory, kind: str) -> None:
    path, name = tiny_capture(), BAD_NAMES[kind]
    rule = "1 to 200 bytes of UTF-8 without '/'" if name else "a text"
    whole = put(path, ("name",), name)
    assert rule in errors(path, "name")[0].expected
    put(path, ("name",), whole)
    own = put(path, ("frames", 3, "name"), name)
    assert rule in errors(path, "frames[3].name")[0].expected
    put(path, ("frames", 3, "name"), own)

    def rename(document: dict[str, Any]) -> None:
        document["cameras"][name] = document["cameras"].pop("side")

    edit(path, rename)
    assert "1 to 200 bytes of UTF-8 without '/'" in errors(path, "cameras")[0].expected


@pytest.mark.parametrize("field", PATHS)
def test_a_path_that_leaves_the_capture_is_an_error(
    tiny_capture: Factory, tmp_path: Path, field: str
) -> None:
    path = tiny_capture()
    own = put(path, PATHS[field], "x")
    outside = tmp_path / "outside"
    outside.write_bytes((path / own).read_bytes())
    (path / "link").symlink_to("../outside")
    (path / "up").symlink_to("..")
    for text in (
        str(outside),
        str(path / own),
        "../outside",
        f"images/../{own}",
        "link",
        "up/outside",
        "a" * 5_000,
        "a\\b",
        "a\0b",
        ".",
    ):
        put(path, PATHS[field], text)
        (finding,) = errors(path, field)
        assert "a path below the capture's folder" in finding.expected
        assert ("a link that leads out" in finding.found) == text.startswith(("link", "up/"))
    put(path, PATHS[field], own)
    assert validate_capture(path, deep=False) == []


@pytest.mark.parametrize("field", PATHS)
def test_a_path_that_is_too_long_as_a_whole_is_no_file(tiny_capture: Factory, field: str) -> None:
    path = tiny_capture()
    put(path, PATHS[field], "a/" * 3_000 + "b")
    found = [f for f in validate_capture(path) if f.severity == "error"]
    assert [finding.found.partition(" (")[0] for finding in found] == ["no such file"]


def test_links_within_a_capture_and_hard_links_into_it_are_fine(
    tiny_capture: Factory, tmp_path: Path
) -> None:
    path = tiny_capture()
    (path / "images").rename(path / "stored")
    (path / "images").symlink_to("stored")
    (path / "events.h5").rename(path / "stored" / "e.h5")
    os.symlink("stored/e.h5", path / "events.h5")
    os.link(path / "body.npz", tmp_path / "body.npz")
    put(path, ("frames", 3, "image"), "./images//0003.png")
    (tmp_path / "elsewhere").symlink_to(path)
    for root in (path, tmp_path / "elsewhere"):
        assert validate_capture(root) == []
    with derived_capture(load_capture(path), tmp_path / "derived"):
        pass
    assert validate_capture(tmp_path / "derived") == []


@pytest.mark.parametrize("size", [(10, 24), (32, 10), (1, 1)])
def test_pictures_smaller_than_the_window_of_ssim_are_refused(
    tiny_capture: Factory, size: tuple[int, int]
) -> None:
    path = tiny_capture()
    for key, side in zip(("width", "height"), size, strict=True):
        put(path, ("cameras", "side", key), side)
        if side < 11:
            (finding,) = errors(path, f"cameras.side.{key}")
            assert finding.found == f"{side} pixels"
            assert finding.expected == "at least 11, the side of SSIM's window"


def test_pictures_as_large_as_the_window_of_ssim_are_taken(tiny_capture: Factory) -> None:
    path = tiny_capture(width=11, height=11)
    assert [f for f in validate_capture(path) if f.severity == "error"] == []


@pytest.mark.parametrize(
    ("text", "found", "remedy"),
    [
        ("[" * 100_000, "not valid JSON (nested too deeply)", "Repair it or write it anew."),
        ('{"format": ' + "1" * 5_000, "value has 5000 digits)", "Repair it"),
        ('{"format": "evsplat-capture", ', "not valid JSON (Expecting", "Repair it"),
    ],
)
def test_json_that_is_none_is_an_error(
    tiny_capture: Factory, text: str, found: str, remedy: str
) -> None:
    path = tiny_capture()
    (path / "capture.json").write_text(text)
    (finding,) = errors(path, "")
    assert found in finding.found and finding.remedy.startswith(remedy)


def test_deeply_nested_values_are_errors_of_their_fields(tiny_capture: Factory) -> None:
    """Nesting that the JSON reader still takes, but not all that would show or convert it."""
    path = tiny_capture()
    for depth in range(880, 1_000, 3):
        text = (path / "capture.json").read_text()
        nested = text.replace('"split": "train"', '"split": ' + "[" * depth + "]" * depth, 1)
        (path / "capture.json").write_text(nested)
        found = [f for f in validate_capture(path, deep=False) if f.severity == "error"]
        assert found[0].field in ("frames[0].split", "")
        (path / "capture.json").write_text(text)


def test_a_folder_or_a_locked_file_in_place_of_the_description_is_named(
    tiny_capture: Factory, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tiny_capture()
    text = (path / "capture.json").read_text()
    (path / "capture.json").unlink()
    (path / "capture.json").mkdir()
    assert errors(path, "")[0].found == "a folder, expected a file"
    (path / "capture.json").rmdir()
    (path / "capture.json").write_text(text)

    def denied(*_: object, **__: object) -> str:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "read_text", denied)
    (finding,) = errors(path, "")
    assert finding.found == "may not be read"
    assert finding.remedy == "Give yourself the permission to read it."


def test_a_path_too_long_for_a_capture_is_no_folder(tmp_path: Path) -> None:
    (finding,) = validate_capture(tmp_path / ("x" * 5_000))
    assert finding.found == "no such folder"


def test_a_principal_point_far_off_the_pictures_is_an_error_and_one_beside_them_a_warning(
    tiny_capture: Factory, rng: np.random.Generator
) -> None:
    path = tiny_capture()  # of 32x24 pixels, with a focal length of 40.8
    axis, sign = int(rng.integers(2)), int(rng.integers(2))
    side = (32, 24)[axis]

    def move(beyond: float) -> None:
        put(path, ("cameras", "main", "K", axis, 2), side + beyond if sign else -beyond)

    move(float(rng.uniform(3.01 * 40.8, 9_000)))
    (finding,) = errors(path, "cameras.main.K")
    assert "focal lengths" in finding.found and "outside the 32x24" in finding.found
    assert "at most 3 focal lengths beside them" in finding.expected
    move(float(rng.uniform(0.01, 2.99 * 40.8)))
    (warning,) = validate_capture(path, deep=False)
    assert (warning.severity, warning.field) == ("warning", "cameras.main.K")
    assert "unless they were cut out of larger ones" in warning.expected
    move(-float(rng.uniform(0, side)))
    assert validate_capture(path, deep=False) == []


def test_a_lens_that_folds_within_the_picture_is_one_warning_with_the_radius(
    tiny_capture: Factory, rng: np.random.Generator, caplog: pytest.LogCaptureFixture
) -> None:
    path = tiny_capture()
    radius = float(rng.uniform(6, 16))  # of 20 pixels to the corner
    k1 = -1 / (3 * (radius / 40.8) ** 2)
    lens = {"model": "opencv", "coefficients": [k1, 0, 0, 0]}
    put(path, ("cameras", "main", "distortion"), lens)
    load_capture(path)
    (message,) = [text for text in caplog.messages if "distortion" in text]
    start = f"{path}/capture.json: cameras.main.distortion.coefficients: found a lens that folds"
    assert message.startswith(start) and "one that folds nowhere in the 32x24 picture" in message
    told = int(message.partition("over itself ")[2].split()[0])
    assert radius - 0.6 <= told <= radius + 2
    put(path, ("cameras", "main", "distortion"), lens | {"coefficients": [k1 / 20, 0, 0, 0]})
    assert [f for f in validate_capture(path, deep=False) if "distortion" in f.field] == []
