"""The optional initial scene points: PLY, read as ASCII or binary, written as binary."""

import os
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Float32

from evsplat.errors import DataError
from evsplat.files import write_bytes
from evsplat.untrusted.arrays import read_table
from evsplat.untrusted.faults import open_bytes

_TYPES = {
    **{name: "i1" for name in ("char", "int8")},
    **{name: "u1" for name in ("uchar", "uint8")},
    **{name: "i2" for name in ("short", "int16")},
    **{name: "u2" for name in ("ushort", "uint16")},
    **{name: "i4" for name in ("int", "int32")},
    **{name: "u4" for name in ("uint", "uint32")},
    **{name: "f4" for name in ("float", "float32")},
    **{name: "f8" for name in ("double", "float64")},
}
_COLOURS = ("red", "green", "blue")
_LONGEST_LINE = 4096
_BYTE_ORDER = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}


def read_points(
    path: Path,
) -> tuple[Float32[np.ndarray, "N 3"], Float32[np.ndarray, "N 3"]]:
    """Positions (metres, world) and colours in [0, 1] of the vertices; grey 0.5 without colour."""
    try:
        with open_bytes(path) as file:
            layout, count, fields = _read_header(file)
            left = os.fstat(file.fileno()).st_size - file.tell()
            if count * len(fields) > left:
                # each number has a byte or more: found out before memory is taken for them
                raise ValueError(f"{left} bytes after the header, too few for {count} vertices")
            dtype = np.dtype([(name, _BYTE_ORDER[layout] + kind) for name, kind in fields])
            if layout == "ascii":
                table = read_table(file, rows=count)
                columns = {name: table[:, i] for i, (name, _) in enumerate(fields)}
                length = len(table)
            else:
                rows = np.frombuffer(file.read(count * dtype.itemsize), dtype=dtype)
                columns = {name: rows[name] for name, _ in fields}
                length = len(rows)
    except (OSError, ValueError, IndexError) as error:
        raise DataError(f"{path}: not a readable PLY ({error}); write it anew.") from error
    if length != count:
        raise DataError(f"{path}: holds {length} vertices, expected {count}; write it anew.")
    missing = [axis for axis in "xyz" if axis not in columns]
    if missing:
        raise DataError(f"{path}: vertices have no {missing}, expected x, y and z; write it anew.")
    points = _stacked(path, columns, ("x", "y", "z"))
    kinds = dict(fields)
    if not all(name in columns for name in _COLOURS):
        return points, np.full_like(points, 0.5)
    scale = 255.0 if kinds["red"] == "u1" else 1.0
    return points, _stacked(path, columns, _COLOURS, scale)


def _stacked(
    path: Path, columns: dict[str, np.ndarray], names: tuple[str, ...], scale: float = 1.0
) -> Float32[np.ndarray, "N 3"]:
    """Columns beside each other, divided by ``scale``; a `DataError` where one is not finite."""
    with np.errstate(over="ignore"):
        rows = (np.stack([columns[name] for name in names], axis=-1) / scale).astype(np.float32)
    wrong = ~np.isfinite(rows).all(axis=1)
    if wrong.any():
        at, count = int(np.argmax(wrong)), int(wrong.sum())
        raise DataError(
            f"{path}: {', '.join(names)} of vertex {at} are {rows[at].tolist()}, expected finite "
            f"numbers; remove the vertex (there are {count} such)."
        )
    return rows


def write_points(
    path: Path,
    points: Float32[np.ndarray, "N 3"],
    colours: Float32[np.ndarray, "N 3"] | None = None,
) -> None:
    """Write positions (metres, world) and colours (sRGB in [0, 1]), whole or not at all."""
    fields = [(axis, "<f4", "float") for axis in "xyz"]
    if colours is not None:
        fields += [(name, "u1", "uchar") for name in _COLOURS]
    rows = np.zeros(len(points), dtype=[(name, kind) for name, kind, _ in fields])
    for column, axis in enumerate("xyz"):
        rows[axis] = points[:, column]
    if colours is not None:
        for column, name in enumerate(_COLOURS):
            rows[name] = (colours[:, column].clip(0, 1) * 255).round()
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += [*(f"property {word} {name}" for name, _, word in fields), "end_header", ""]
    write_bytes(path, "\n".join(lines).encode("ascii") + rows.tobytes())


def _read_header(file: BinaryIO) -> tuple[str, int, list[tuple[str, str]]]:
    """Layout, vertex count and (name, numpy type) of the vertex properties."""
    lines = []
    while raw := file.readline(_LONGEST_LINE):
        lines.append(raw.decode("ascii").split())
        if lines[-1] == ["end_header"]:
            break
        if len(lines) > 200:
            raise ValueError("no end of the header")
    if not lines or lines[0] != ["ply"]:
        raise ValueError("the first line is not 'ply'")
    layout, count, element = "", 0, ""
    fields: list[tuple[str, str]] = []
    for words in lines:
        if words[:1] == ["format"]:
            layout = words[1]
        elif words[:1] == ["element"]:
            if not fields and words[1] != "vertex":
                raise ValueError("the first element is not 'vertex'")
            element = words[1]
            count = _count(words[2]) if element == "vertex" else count
        elif words[:1] == ["property"] and element == "vertex":
            if words[1] not in _TYPES:
                raise ValueError(f"a vertex property of type {words[1]!r}, expected plain numbers")
            fields.append((words[2], _TYPES[words[1]]))
    if layout not in _BYTE_ORDER:
        raise ValueError(f"unknown layout {layout!r}")
    return layout, count, fields


def _count(word: str) -> int:
    # more digits are no file's, and int() refuses very many with words for programmers
    if not word.isdecimal() or len(word) > 18:
        raise ValueError(f"a vertex count of {word[:40]!r}")
    return int(word)
