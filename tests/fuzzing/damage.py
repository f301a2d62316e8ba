"""Damage to files: to their bytes, to their words, and to the values that they hold."""

import io
import json
import math
import pickle
import pickletools
from typing import Any

import numpy as np
import safetensors.numpy

from ..events.formats.mutations import damaged

Rng = np.random.Generator
VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 2, 127, 2**31, 2**53 + 1, 2**63, -(2**63), 10**400, 0.5, 1e308),
    *(
        -1e308,
        1e-308,
        math.nan,
        math.inf,
        -math.inf,
        "",
        " ",
        "a",
        "\0",
        "..",
        ".",
        "/",
        "/etc/passwd",
    ),
    *("../../x", "images", "C:\\x", "\ud800", "\u202e", "é\n\r\t", "<script>alert(1)</script>"),
    *("x" * 300, "x" * 5000, [], {}, [[]], [None], [0, 1], [1, 0], ["a"], {"a": 1}, [1e308] * 4),
    *([[1, 0, 0], [0, 1, 0], [0, 0, 1]], [math.nan] * 2, [2**62, 2**62 + 5], [-(2**60), 2**60]),
    *([0.5, 1.5], [[0] * 4] * 4, 1e19, "72000", "nan", "main", "train", "test", "rig", "smpl"),
)
WORDS = (
    *(b"nan", b"inf", b"-1", b"0", b"1e999", b"1e300", b"99999999999", b"9" * 5000, b"{", b"}"),
    *(b"[", b"]", b'"', b"null", b"\n", b" ", b"", b"\0", b"\xff", b":", b"-", b"list", b"x" * 400),
)


def damaged_bytes(data: bytes, rng: Rng) -> bytes:
    """Bits, bytes and lengths changed; pieces cut out or repeated."""
    return damaged(data, rng)


def damaged_text(data: bytes, rng: Rng) -> bytes:
    """Words exchanged, left out, doubled or moved; or bytes damaged."""
    if rng.random() < 0.2:
        return damaged_bytes(data, rng)
    for _ in range(int(rng.integers(1, 4))):
        words = data.split(b" ") if rng.random() < 0.5 else data.split(b"\n")
        at, kind = int(rng.integers(len(words))), rng.integers(4)
        if kind == 0:
            words[at] = WORDS[rng.integers(len(WORDS))]
        elif kind == 1:
            del words[at]
        elif kind == 2:
            words.insert(at, words[rng.integers(len(words))])
        else:
            piece = words[at]
            cut = int(rng.integers(len(piece) + 1))
            words[at] = piece[:cut] + WORDS[rng.integers(len(WORDS))] + piece[cut:]
        data = (b" " if b" " in data and len(words) == data.count(b" ") + 1 else b"\n").join(words)
    return data


def damaged_tree(value: Any, rng: Rng) -> Any:
    """A copy of containers and arrays with one or a few of their values wrong or missing."""
    value = _copied(value)
    for _ in range(int(rng.choice([1, 1, 1, 2, 4]))):
        value = _one_wrong(value, rng)
    return value


def _copied(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _copied(entry) for key, entry in value.items()}
    return [_copied(entry) for entry in value] if isinstance(value, list) else value


def _one_wrong(value: Any, rng: Rng) -> Any:
    """Goes down at random and spoils what it meets at the end."""
    container = isinstance(value, dict | list) and len(value) > 0
    if not container or rng.random() < 0.1:
        if isinstance(value, np.ndarray) and rng.random() < 0.8:
            return damaged_array(value, rng)
        return _copied(VALUES[rng.integers(len(VALUES))])
    keys = list(value) if isinstance(value, dict) else list(range(len(value)))
    key = keys[rng.integers(len(keys))]
    kind = rng.random()
    if kind < 0.1:
        del value[key]
    elif kind < 0.15 and isinstance(value, list):
        value.append(_copied(value[key]))
    elif kind < 0.15:
        value[repr(VALUES[rng.integers(len(VALUES))])[:300]] = _copied(value[key])
    else:
        value[key] = _one_wrong(value[key], rng)
    return value


def damaged_array(array: np.ndarray, rng: Rng) -> np.ndarray:
    """Another shape, type or length, or numbers that are none or too large."""
    kind = rng.integers(9)
    array = array.copy()
    if kind == 0:
        return array[:0] if array.ndim else np.zeros(0, array.dtype)
    if kind == 1:
        return array[:-1] if array.ndim else array[None]
    if kind == 2:
        return array.reshape(-1)
    if kind == 3:
        return array[..., None] if rng.random() < 0.5 else array.T
    if kind == 4 and array.dtype.kind in "fiub":
        with np.errstate(all="ignore"):
            kinds = ["f2", "f4", "f8", "i1", "i8", "u1", "u8", "c16", "?", "S3", "U2", "M8[s]"]
            return array.astype(str(rng.choice(kinds)))
    if kind == 5 and array.dtype.kind == "f" and array.size:
        array.reshape(-1)[rng.integers(array.size)] = rng.choice([np.nan, np.inf, 1e300, -1e30, 0])
    elif kind == 6 and array.dtype.kind in "iu" and array.size:
        wrong = int(rng.choice([-1, 2**31 - 1, 0, 2**15, 2**62, -(2**62)]))
        with np.errstate(all="ignore"):
            array.reshape(-1)[rng.integers(array.size)] = np.array(wrong).astype(array.dtype)
    elif kind == 7 and array.dtype.kind == "f":
        with np.errstate(all="ignore"):
            return array * array.dtype.type(rng.choice([0, 1e6, -1e20, 1e-30]))
    elif kind == 8 and array.ndim and len(array) > 1:
        return array[::-1] if rng.random() < 0.5 else np.concatenate([array, array[:1]])
    return array


def damaged_json(data: bytes, rng: Rng) -> bytes:
    """Values exchanged; or words, bytes, or brackets without end."""
    kind = rng.random()
    if kind < 0.7:
        text = json.dumps(
            damaged_tree(json.loads(data), rng), ensure_ascii=bool(rng.random() < 0.5)
        )
        return text.encode("utf-8", "surrogatepass")
    if kind < 0.72:
        return rng.choice([b"[", b'{"a":']) * int(rng.choice([900, 5_000, 50_000]))
    if kind < 0.74:
        return data.decode().encode(str(rng.choice(["utf-16", "utf-8-sig", "utf-32"])))
    return damaged_text(data, rng)


def damaged_npz(data: bytes, rng: Rng) -> bytes:
    """Arrays exchanged, left out or pickled; or bytes."""
    if rng.random() < 0.3:
        return damaged_bytes(data, rng)
    with np.load(io.BytesIO(data), allow_pickle=True) as archive:
        arrays = {key: archive[key] for key in archive.files}
    key = list(arrays)[rng.integers(len(arrays))]
    kind, file = rng.random(), io.BytesIO()
    if kind < 0.1:
        del arrays[key]
    elif kind < 0.2:
        arrays[key] = np.array([{"a": 1}, arrays[key]], dtype=object)
    elif kind < 0.3:
        arrays[key] = np.asarray(VALUES[rng.integers(len(VALUES) - 8)], dtype=object).astype("U9")
    else:
        arrays[key] = damaged_array(arrays[key], rng)
    np.savez(file, **arrays)
    return file.getvalue()


def damaged_safetensors(data: bytes, rng: Rng) -> bytes:
    """Tensors exchanged or left out, values in the texts beside them exchanged; or bytes."""
    if rng.random() < 0.2:
        return damaged_bytes(data, rng)
    tensors = dict(safetensors.numpy.load(data))
    length = int.from_bytes(data[:8], "little")
    texts = json.loads(data[8 : 8 + length]).get("__metadata__", {})
    if texts and rng.random() < 0.3:
        name = list(texts)[rng.integers(len(texts))]
        texts[name] = json.dumps(damaged_tree(json.loads(texts[name]), rng))
    else:
        name = list(tensors)[rng.integers(len(tensors))]
        if rng.random() < 0.1:
            del tensors[name]
        else:
            # No type that the format lacks.
            spoilt = damaged_array(tensors[name], rng)
            fits = spoilt.dtype.kind in "fiub"
            tensors[name] = np.ascontiguousarray(spoilt if fits else tensors[name][..., None])
    return safetensors.numpy.save(tensors, texts)


def damaged_pickle(data: bytes, rng: Rng) -> bytes:
    """Opcodes left out, doubled or exchanged, with other numbers and names; or values; or bytes."""
    kind = rng.random()
    if kind < 0.35 or not data.startswith(b"\x80"):
        return damaged_bytes(data, rng)
    if kind < 0.5:
        try:
            return pickle.dumps(damaged_tree(pickle.loads(data), rng), int(rng.integers(2, 6)))
        except pickle.UnpicklingError:  # joblib's, whose arrays lie between the opcodes
            return damaged_bytes(data, rng)
    for _ in range(int(rng.integers(1, 4))):
        try:
            at = [place for _, _, place in pickletools.genops(data) if place is not None]
        except Exception:  # damaged enough
            return data
        at.append(len(data))
        one, other = (int(rng.integers(len(at) - 1)) for _ in "ab")
        piece, new = data[at[one] : at[one + 1]], data[at[other] : at[other + 1]]
        if piece[:1] in b"KMJ":
            number = int(rng.choice([0, 1, 7, 127, -1, -2, 65535, 2**31 - 1, -(2**31)]))
            new = b"J" + number.to_bytes(4, "little", signed=True)
        elif piece[:1] in (b"\x8c", b"X") and rng.random() < 0.6:
            name = str(
                rng.choice(["O8", "f8", "V8", "S99999999", "i4,O", "M8", "eval", "bytearray"])
            )
            new = b"X" + len(name).to_bytes(4, "little") + name.encode()
        elif rng.random() < 0.4:
            new = b""
        elif rng.random() < 0.5:
            new = piece + piece
        data = data[: at[one]] + new + data[at[one + 1] :]
    return data
