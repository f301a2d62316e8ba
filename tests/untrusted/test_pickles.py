"""Pickles of arrays come out as Python's own reader gives them; anything else never runs."""

import collections
import io
import os
import pickle
import struct
import subprocess
import warnings
import zipfile
from pathlib import Path

import joblib
import numpy as np
import pytest

from evsplat.errors import DataError
from evsplat.untrusted.arrays import read_npy, read_npz
from evsplat.untrusted.pickles import read_pickle

RNG = np.random.default_rng(0)
TREE = {
    "float": RNG.normal(size=(3, 4)),
    "fortran": np.asfortranarray(RNG.normal(size=(5, 2, 3)).astype(np.float32)),
    "cut": np.arange(20).reshape(4, 5)[::2, 1:4],
    "big endian": np.arange(5, dtype=">i4"),
    "half": RNG.normal(size=7).astype(np.float16),
    "empty": np.zeros((0, 3), np.uint8),
    "single": np.array(2.5),
    "flags": np.array([True, False]),
    "text": np.array(["left", "right_hip"]),
    "bytes": np.array([b"ab", b"c"]),
    "objects": np.array([{"a": np.arange(3)}, None, "x"], dtype=object),
    "scalars": [np.float32(1.5), np.int64(-3), np.bool_(True)],
    "plain": (1, 2.5, None, True, "ü", b"\x00\xff", {3}, frozenset({4}), 1 + 2j),
    "ordered": collections.OrderedDict(b=1, a=np.ones(2)),
    7: [bytearray(b"xy")],
}
TREE["again"] = TREE["float"]


def assert_same(read, expected) -> None:
    if isinstance(expected, np.ndarray):
        assert type(read) is np.ndarray
        # numpy, too, may turn the bytes round on reading
        assert read.dtype.newbyteorder("=") == expected.dtype.newbyteorder("=")
        assert read.shape == expected.shape
        for one, other in zip(read.ravel().tolist(), expected.ravel().tolist(), strict=True):
            assert_same(one, other)
        return
    assert type(read) is type(expected)
    if isinstance(expected, dict):
        assert list(read) == list(expected)
        assert_same(list(read.values()), list(expected.values()))
    elif isinstance(expected, list | tuple):
        assert len(read) == len(expected)
        for one, other in zip(read, expected, strict=True):
            assert_same(one, other)
    else:
        assert read == expected


@pytest.mark.parametrize("protocol", range(6))
def test_every_protocol_gives_what_was_stored(tmp_path: Path, protocol: int) -> None:
    file = tmp_path / "tree.pkl"
    file.write_bytes(pickle.dumps(TREE, protocol=protocol))
    assert_same(read_pickle(file), TREE)


@pytest.mark.parametrize(
    "compress", [0, *(("zlib", 3), ("gzip", 3), ("bz2", 1)), ("xz", 1), "lzma"]
)
def test_what_joblib_wrote_is_read(tmp_path: Path, compress) -> None:
    file = tmp_path / "tree.pkl"
    joblib.dump(TREE, file, compress=compress)
    assert_same(read_pickle(file), TREE)


def test_python_2_pickles_are_read(tmp_path: Path) -> None:
    """Bytes of str as Python 2 wrote them: no Python 3 writes such a file."""
    array = np.arange(3, dtype=np.float64)
    raw = array.tobytes()
    file = tmp_path / "camera.pkl"
    file.write_bytes(
        b"\x80\x02}q\x00U\x08camera_tq\x01cnumpy.core.multiarray\n_reconstruct\n"
        b"cnumpy\nndarray\nK\x00\x85U\x01b\x87R(K\x01K\x03\x85cnumpy\ndtype\nU\x02f8K\x00K\x01\x87R"
        b"(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89U"
        + bytes([len(raw)])
        + raw
        + b"tbs."
    )
    assert_same(read_pickle(file), {"camera_t": array})


def test_object_arrays_in_numpy_files_come_bare(tmp_path: Path) -> None:
    np.save(tmp_path / "one.npy", np.array(TREE, dtype=object))
    np.save(tmp_path / "list.npy", np.array([TREE, None], dtype=object))
    np.save(tmp_path / "plain.npy", TREE["fortran"])
    np.savez_compressed(tmp_path / "all.npz", a=np.array(TREE, dtype=object), b=TREE["text"])
    assert_same(read_npy(tmp_path / "one.npy"), TREE)
    assert_same(read_npy(tmp_path / "list.npy")[0], TREE)
    assert_same(read_npy(tmp_path / "plain.npy"), TREE["fortran"])
    assert_same(read_npz(tmp_path / "all.npz"), {"a": TREE, "b": TREE["text"]})
    assert list(read_npz(tmp_path / "all.npz", keys=["b"])) == ["b"]


class Call:
    """Calls a function when it is unpickled without care."""

    def __init__(self, function, *arguments) -> None:
        self.call = function, arguments

    def __reduce__(self):
        return self.call


CALLS = {
    "system": Call(os.system, "touch touched"),
    "popen": Call(subprocess.Popen, ["touch", "touched"]),
    "open": Call(open, "touched", "w"),
    "eval": Call(eval, "open('touched', 'w')"),
    "numpy load": Call(np.load, "x.npy"),
}
WRITERS = {
    "pickle": lambda value, file: file.write_bytes(pickle.dumps(value)),
    "old pickle": lambda value, file: file.write_bytes(pickle.dumps(value, protocol=0)),
    "joblib": lambda value, file: joblib.dump(value, file),
    "joblib object array": lambda value, file: joblib.dump(np.array([value], dtype=object), file),
}


@pytest.mark.parametrize("writer", WRITERS)
@pytest.mark.parametrize("call", CALLS)
def test_nothing_in_a_pickle_runs(tmp_path: Path, monkeypatch, call: str, writer: str) -> None:
    monkeypatch.chdir(tmp_path)
    WRITERS[writer]({"poses": CALLS[call]}, tmp_path / "x.pkl")
    with pytest.raises(DataError, match=r"x\.pkl: holds the pickled type .*\..*was not loaded"):
        read_pickle(tmp_path / "x.pkl")
    assert not (tmp_path / "touched").exists()


def test_an_object_array_in_an_npz_does_not_run_either(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    np.savez("x.npz", a=np.array([CALLS["open"]], dtype=object))
    with pytest.raises(DataError, match="was not loaded"):
        read_npz(tmp_path / "x.npz")
    assert not (tmp_path / "touched").exists()


ARRAY = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\ntS'b'\ntR"
FORGED = {
    # an object array whose pointers come as bytes: numpy itself would follow them
    "pointers": ARRAY
    + b"(I1\n(I1\ntcnumpy\ndtype\n(S'O8'\nI0\nI1\ntR(I3\nS'|'\nNNNI-1\nI-1\nI0\ntbI00\n"
    + b"S'\\x01\\x02\\x03\\x04\\x05\\x06\\x07\\x08'\ntb.",
    # numbers whose dtype claims to hold objects
    "flags": ARRAY
    + b"(I1\n(I1\ntcnumpy\ndtype\n(S'f8'\nI0\nI1\ntR(I3\nS'<'\nNNNI-1\nI-1\nI63\ntbI00\n"
    + b"S'\\x01\\x02\\x03\\x04\\x05\\x06\\x07\\x08'\ntb.",
    "too few bytes": ARRAY
    + b"(I1\n(I9999\ntcnumpy\ndtype\n(S'f8'\nI0\nI1\ntR(I3\nS'<'\nNNNI-1\nI-1\nI0\ntb"
    + b"I00\nS'ab'\ntb.",
    "array from a buffer": b"cnumpy\nndarray\n((I1\ntS'O'\nS'12345678'\ntR.",
    "state of a class": b"\x80\x02ccollections\nOrderedDict\n}X\x01\x00\x00\x00xK\x01sb.",
    "state of a function": b"\x80\x02c_codecs\nencode\nN}X\x01\x00\x00\x00xK\x01s\x86b.",
    "another codec": b"c_codecs\nencode\n(Vx\nVrot13\ntR.",
    "persistent": b"Pabc\n.",
    "extension": b"\x80\x02\x82\x01.",
}


@pytest.mark.parametrize("kind", FORGED)
def test_forged_pickles_are_refused_or_harmless(tmp_path: Path, kind: str) -> None:
    (tmp_path / "x.pkl").write_bytes(FORGED[kind])
    if kind == "flags":
        array = read_pickle(tmp_path / "x.pkl")
        assert array.dtype == np.float64 and not array.dtype.hasobject
        assert array[0] == struct.unpack("<d", bytes(range(1, 9)))[0]
        return
    with pytest.raises(DataError, match=r"x\.pkl: "):
        read_pickle(tmp_path / "x.pkl")


def test_damaged_files_are_one_sentence(tmp_path: Path) -> None:
    """Cut or changed anywhere, a file is read or refused, never another error."""
    for name, write in WRITERS.items():
        file = tmp_path / f"{name}.pkl"
        write({"a": np.arange(40.0), "b": ["x", 1]}, file)
        whole = bytearray(file.read_bytes())
        for _ in range(150):
            spoilt = bytearray(whole)
            spoilt[RNG.integers(len(whole))] = RNG.integers(256)
            file.write_bytes(spoilt if RNG.random() < 0.5 else whole[: RNG.integers(len(whole))])
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                try:
                    read_pickle(file, what="pose file")
                except DataError as error:
                    assert str(error).startswith(f"{file}: ")
    with pytest.raises(DataError, match="none.pkl: file not found"):
        read_pickle(tmp_path / "none.pkl")
    (tmp_path / "x.npy").write_bytes(b"\x93NUMPY\x01\x00")
    with pytest.raises(DataError, match="x.npy: not a readable npy file"):
        read_npy(tmp_path / "x.npy")
    (tmp_path / "x.npz").write_bytes(b"PK\x03\x04")
    with pytest.raises(DataError, match="x.npz: not a readable npz archive"):
        read_npz(tmp_path / "x.npz")


def test_damaged_numpy_files_are_one_sentence(tmp_path: Path) -> None:
    """numpy's header reader and zipfile have errors of their own: cut tokens, unknown packing."""
    np.save(tmp_path / "a.npy", np.array(TREE, dtype=object))
    np.savez_compressed(tmp_path / "a.npz", a=TREE["text"], b=TREE["float"])
    for name, read in (("a.npy", read_npy), ("a.npz", read_npz)):
        file = tmp_path / name
        whole = file.read_bytes()
        for _ in range(400):
            spoilt = bytearray(whole)
            spoilt[RNG.integers(min(len(whole), 200))] = RNG.integers(256)
            file.write_bytes(spoilt)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                try:
                    read(file)
                except DataError as error:
                    assert str(error).startswith(f"{file}: ") and "\n" not in str(error)


OBJECTS = pickle.dumps(np.array([{}, {}], dtype=object), protocol=2)
NUMBERS = pickle.dumps(np.zeros((2, 3), np.float32), protocol=2)
TOO_MUCH = {
    # the shape (2,) of an object array of two becomes (127,): numpy reads on behind the list
    "more objects than there are": OBJECTS.replace(b"K\x02\x85", b"K\x7f\x85"),
    "fewer objects than there are": OBJECTS.replace(b"K\x02\x85", b"K\x01\x85"),
    "negative count of objects": OBJECTS.replace(b"K\x02\x85", b"J\xfe\xff\xff\xff\x85"),
    # 2^32 x 2^32 and two objects: NumPy's product of that is 0
    "product that overflows": OBJECTS.replace(
        b"K\x02\x85", b"\x8a\x05\0\0\0\0\x01\x8a\x05\0\0\0\0\x01\x86"
    ),
    "more numbers than there are": NUMBERS.replace(b"K\x02K\x03", b"K\x7fK\x7f"),
    "numbers of no bytes": ARRAY
    + b"(I1\n(I999999999999\ntcnumpy\ndtype\n(S'S0'\nI0\nI1\ntR(I3\nS'|'\nNNNI0\nI1\nI0\ntb"
    + b"I00\nS''\ntb.",
    "bytearray of a number": b"\x80\x02cbuiltins\nbytearray\nJ\x00\x00\x00\x40\x85R.",
    "bytes of a number": b"\x80\x02cbuiltins\nbytes\nJ\x00\x00\x00\x40\x85R.",
    "bytearray of Python 2": b"\x80\x02c__builtin__\nbytearray\nJ\x00\x00\x00\x40\x85R.",
    "bytearray of a list": b"\x80\x02cbuiltins\nbytearray\n]K\x01a\x85R.",
    "bytearray by length": b"\x80\x05\x96" + struct.pack("<Q", 1 << 30) + b"abc.",
    "numbers of an array of objects": b"\x80\x05cnumpy.core.numeric\n_frombuffer\n("
    + OBJECTS[2:-1]
    + b"cnumpy\ndtype\nX\x02\x00\x00\x00i8\x85RK\x02\x85X\x01\x00\x00\x00CtR.",
    # its values again, after it was filled: a second BUILD
    "array filled twice": OBJECTS[:-1] + OBJECTS[OBJECTS.rindex(b"(K\x01") : -1] + b".",
}


@pytest.mark.usefixtures("little_memory")
@pytest.mark.parametrize("kind", TOO_MUCH)
def test_what_a_pickle_promises_beyond_its_bytes_is_refused(tmp_path: Path, kind: str) -> None:
    file = tmp_path / "x.pkl"
    file.write_bytes(TOO_MUCH[kind])
    with pytest.raises(DataError, match=r"x\.pkl: not a readable pickle"):
        read_pickle(file)


@pytest.mark.usefixtures("little_memory")
@pytest.mark.parametrize("shape", [(10**12,), (1 << 32, 1 << 32), (-1,), (1 << 70,)])
@pytest.mark.parametrize("packed", [False, True])
def test_what_a_header_promises_beyond_the_file_is_refused(
    tmp_path: Path, shape: tuple[int, ...], packed: bool
) -> None:
    file = tmp_path / ("x.npz" if packed else "x.npy")
    stream = io.BytesIO()
    header = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(stream, header)
    stream.write(bytes(80))
    if packed:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("a.npy", stream.getvalue())
    else:
        file.write_bytes(stream.getvalue())
    with pytest.raises(DataError, match=r"x\.np.: not a readable np"):
        (read_npz if packed else read_npy)(file)


@pytest.mark.parametrize("protocol", range(6))
def test_object_arrays_of_every_shape_are_read(tmp_path: Path, protocol: int) -> None:
    rows = np.empty((2, 3), dtype=object)
    rows[:] = [[1, "a", None], [(2, 3), [4], {"b": 5}]]
    nested = np.empty(2, dtype=object)
    nested[:] = [rows, np.arange(3)]
    scalar = np.empty(1, dtype=object)
    scalar[0] = np.array(2.5)
    tree = {
        "rows": rows,
        "by columns": np.asfortranarray(rows),
        "turned": rows.T,
        "nested": nested,
        "of one array": scalar,
        "none": np.empty((0, 4), dtype=object),
        "single": np.array({"a": 1}, dtype=object),
    }
    tree["shared"] = [rows, rows]
    file = tmp_path / "tree.pkl"
    file.write_bytes(pickle.dumps(tree, protocol=protocol))
    read = read_pickle(file)
    assert_same(read, tree)
    # one array that several name stays one
    assert read["shared"][0] is read["shared"][1] is read["rows"] is read["nested"][0]


def test_an_object_array_may_hold_itself(tmp_path: Path) -> None:
    circle = np.empty(2, dtype=object)
    circle[0] = circle
    (tmp_path / "x.pkl").write_bytes(pickle.dumps(circle))
    read = read_pickle(tmp_path / "x.pkl")
    assert read[0] is read and read[1] is None


@pytest.mark.parametrize("protocol", range(6))
def test_bytes_of_every_kind_are_read(tmp_path: Path, protocol: int) -> None:
    tree = [b"", b"a\xff", bytearray(), bytearray(b"a\xff"), bytearray(70_000)]
    (tmp_path / "x.pkl").write_bytes(pickle.dumps(tree, protocol=protocol))
    assert_same(read_pickle(tmp_path / "x.pkl"), tree)
    # as Python 2 writes a bytearray
    (tmp_path / "x.pkl").write_bytes(
        b"\x80\x02c__builtin__\nbytearray\nX\x02\x00\x00\x00abX\x07\x00\x00\x00latin-1\x86R."
    )
    assert read_pickle(tmp_path / "x.pkl") == bytearray(b"ab")
