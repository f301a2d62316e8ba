"""Reading pickles of other people without running code that they might hold.

A pickle is a program: it may name any function and call it. Here the few names that arrays and
plain containers need are answered by functions of our own, and every other name is refused.
numpy's own are not called either, because a forged dtype can make them read arbitrary memory.
"""

import io
import pickle
import struct
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np

from evsplat.errors import DataError
from evsplat.untrusted.faults import BROKEN, ordinary_file, reason
from evsplat.untrusted.sizes import count_of, sound_text, unpacked

StandIns = Callable[[str, str], type | None]
"""Maps a module and a name in it to a class to build instead; it gets state by __setstate__."""

_PLAIN_KINDS = "biufcSU"


def read_pickle(path: Path, *, what: str = "pickle", stand_ins: StandIns | None = None) -> Any:
    """The arrays and plain containers in a pickle, also one that joblib wrote (packed or not).

    ``what`` says in messages what the file should be.

    Raises:
        DataError: unreadable, or holding a type that is neither an array nor a plain container.
    """
    return read_guarded(path, what, lambda: unpickled(path.read_bytes(), stand_ins))


def unpickled(data: bytes, stand_ins: StandIns | None) -> Any:
    """What a pickle stands for, packed or not; errors are those of `BROKEN`."""
    return Unpickler(io.BytesIO(unpacked(data)), stand_ins).load()


def read_guarded(path: Path, what: str, read: Callable[[], Any]) -> Any:
    """What ``read`` gives of an ordinary file; its faults as `read_pickle` says them."""
    ordinary_file(path)
    try:
        return read()
    except _ForbiddenType as error:
        name = " ".join(str(error).split())
        raise DataError(
            f"{path}: holds the pickled type {name}, which no {what} needs, so it was not loaded; "
            "get the file again from its official source."
        ) from None
    except BROKEN as error:
        raise DataError(f"{path}: not a readable {what} ({reason(error)}).") from error


class _ForbiddenType(Exception):
    """A name in a pickle that is not on the list."""


class _DType:
    """A pickled dtype of plain numbers or text, made anew from its code and byte order."""

    def __init__(self, code: str, align: Any = False, copy: Any = False) -> None:
        self.dtype = np.dtype(str(code))
        if self.dtype.kind not in _PLAIN_KINDS + "O":
            raise _ForbiddenType(f"numpy.dtype {code!r}")

    def __setstate__(self, state: tuple) -> None:
        self.dtype = self.dtype.newbyteorder(state[1])


class _JoblibArray:
    """joblib's mark for an array whose bytes follow in the file."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.shape = tuple(state["shape"])
        self.order: str = state["order"]
        self.dtype: np.dtype = state["dtype"].dtype
        self.aligned = state.get("numpy_array_alignment_bytes") is not None

    def read(self, read: Callable[[int], bytes]) -> np.ndarray:
        if self.aligned:
            read(read(1)[0])
        count = count_of(self.shape)
        data = read(count * self.dtype.itemsize)
        array = sound_text(np.frombuffer(data, self.dtype, count).copy())
        return array.reshape(self.shape, order="F" if self.order == "F" else "C")


def _new_array(kind: Any, shape: Any, code: Any) -> np.ndarray:
    """An array that `_fill` gives its shape and values."""
    return np.empty(0, object)


def _new_scalar(kind: _DType, data: bytes | str) -> Any:
    return sound_text(np.frombuffer(_bytes(data), kind.dtype, 1))[0]


def _from_buffer(data: bytes, kind: _DType, shape: tuple[int, ...], order: str) -> np.ndarray:
    flat = sound_text(np.frombuffer(_bytes(data), kind.dtype).copy())
    return flat.reshape(shape, order="F" if order == "F" else "C")


def _encode(text: str, encoding: str) -> bytes:
    if encoding not in ("latin1", "latin-1"):
        raise _ForbiddenType(f"_codecs.encode to {encoding!r}")
    return text.encode("latin1")


def _new_object(kind: type, base: Any, state: Any) -> Any:
    return object.__new__(kind)


def _new_bytes(data: Any = b"", encoding: str = "latin1") -> bytes:
    """Never of a number, which would take as many bytes of memory."""
    return _bytes(data)


def _new_bytearray(data: Any = b"", encoding: str = "latin1") -> bytearray:
    return bytearray(_bytes(data))


def _bytes(data: Any) -> bytes:
    """Bytes of Python 2 come as text."""
    if not isinstance(data, bytes | bytearray | str):
        raise ValueError(f"bytes made of {type(data).__name__}")
    return data.encode("latin1") if isinstance(data, str) else bytes(data)


_NO_CALL = object()
_NAMES: dict[tuple[str, str], Any] = {
    **{("numpy", name): _NO_CALL for name in ("ndarray", "memmap")},
    ("numpy", "dtype"): _DType,
    ("_codecs", "encode"): _encode,
    ("collections", "OrderedDict"): OrderedDict,
    ("joblib.numpy_pickle", "NumpyArrayWrapper"): _JoblibArray,
}
for _core in ("numpy.core", "numpy._core"):
    _NAMES[f"{_core}.multiarray", "_reconstruct"] = _new_array
    _NAMES[f"{_core}.multiarray", "scalar"] = _new_scalar
    _NAMES[f"{_core}.numeric", "_frombuffer"] = _from_buffer
for _builtins in ("builtins", "__builtin__"):
    _NAMES[_builtins, "object"] = _NO_CALL
    _NAMES |= {(_builtins, kind.__name__): kind for kind in (set, frozenset, complex)}
    _NAMES |= {(_builtins, "bytes"): _new_bytes, (_builtins, "bytearray"): _new_bytearray}
for _copyreg in ("copyreg", "copy_reg"):
    _NAMES[_copyreg, "_reconstructor"] = _new_object


class Unpickler(pickle._Unpickler):
    """Unpickles arrays, plain containers and the caller's stand-ins, nothing else.

    The Python version of the class, because joblib's arrays lie between the opcodes.
    """

    dispatch = dict(pickle._Unpickler.dispatch)
    stack: list[Any]
    read: Callable[[int], bytes]
    append: Callable[[Any], None]
    _file_read: Callable[[int], bytes]

    def __init__(self, stream: IO[bytes], stand_ins: StandIns | None) -> None:
        super().__init__(stream, encoding="latin1")
        self._stream = stream
        self._stand_ins = stand_ins
        self._fillable: set[type] = {_DType}

    def find_class(self, module: str, name: str) -> Any:
        """What a name of a pickle stands for."""
        stand_in = self._stand_ins(module, name) if self._stand_ins else None
        if stand_in is not None:
            self._fillable.add(stand_in)
            return stand_in
        if (module, name) not in _NAMES:
            raise _ForbiddenType(f"{module}.{name}")
        return _NAMES[module, name]

    def load_build(self) -> None:
        """Give the object on top of the stack its state."""
        state = self.stack.pop()
        target = self.stack[-1]
        if isinstance(target, np.ndarray):
            _fill(target, state)
        elif isinstance(target, _JoblibArray):
            target.__setstate__(state)
            if target.dtype.hasobject:
                self.stack[-1] = Unpickler(self._stream, self._stand_ins).load()
            else:
                self.stack[-1] = target.read(self._file_read)
        elif type(target) in self._fillable:
            target.__setstate__(state)
        else:
            raise _ForbiddenType(f"state of a {type(target).__name__}")

    dispatch[pickle.BUILD[0]] = load_build  # type: ignore[assignment]

    def load_bytearray8(self) -> None:
        """Put a bytearray of as many bytes as there are; Python's reader takes the memory first."""
        (size,) = struct.unpack("<Q", self.read(8))
        self.append(bytearray(self.read(size)))

    dispatch[pickle.BYTEARRAY8[0]] = load_bytearray8  # type: ignore[assignment]


def _fill(array: np.ndarray, state: tuple) -> None:
    """Give an array of `_new_array` its pickled shape and values, in place since others name it.

    Objects come as a list, numbers as bytes. numpy's own ``__setstate__`` gets numbers only: it
    would follow a shape beyond the end of a list of objects.
    """
    _, shape, kind, fortran_order, values = state
    dtype, shape, count = kind.dtype, tuple(shape), count_of(shape)
    if array.dtype != object or array.size:
        raise ValueError("an array that is filled twice")
    if dtype.hasobject:
        if not isinstance(values, list) or len(values) != count:
            raise ValueError(f"an object array of shape {shape} without as many objects")
        array.resize(shape, refcheck=False)
        array.reshape(count)[:] = np.fromiter(values, object, count)
        return
    values = _bytes(values)
    if len(values) != count * dtype.itemsize or (count and not dtype.itemsize):
        raise ValueError(f"an array of shape {shape} of {dtype} in {len(values)} bytes")
    sound_text(np.frombuffer(values, dtype, count))
    array.__setstate__((1, shape, dtype, bool(fortran_order), values))  # type: ignore[arg-type]
