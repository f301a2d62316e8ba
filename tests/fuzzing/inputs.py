"""One damaged input: a file of a sound folder spoilt, the folder read, the file put back."""

import os
import shutil
import zlib
from pathlib import Path

import h5py
import numpy as np

from evsplat.errors import EvsplatError

from . import damage
from .damage import Rng
from .readers import Reader

_DAMAGE = {
    ".json": damage.damaged_json,
    ".npz": damage.damaged_npz,
    ".pkl": damage.damaged_pickle,
    ".safetensors": damage.damaged_safetensors,
    **dict.fromkeys(
        (".yaml", ".ply", ".bvh", ".amc", ".asf", ".txt", ".csv", ".jsonl", ".set"),
        damage.damaged_text,
    ),
}


def rng_of(name: str, seed: int, number: int) -> Rng:
    """The numbers of one input, the same on every machine.

    What they spoil depends on the sound files, whose lengths differ by the times within them.
    """
    return np.random.default_rng([seed, zlib.crc32(name.encode()), number])


class Folder:
    """A copy of a reader's sound files, spoilt one at a time."""

    def __init__(self, reader: Reader, sound: Path, copy: Path) -> None:
        shutil.copytree(sound, copy)
        self.reader, self.root = reader, copy
        groups: dict[tuple[Path, str], list[Path]] = {}
        for path in sorted(path for path in copy.rglob("*") if path.is_file()):
            if path.suffix == ".where":  # tells the reader where the others are
                continue
            groups.setdefault((path.parent, path.suffix), []).append(path)
        self._groups = list(groups.values())
        self._content: dict[Path, bytes] = {}

    def check_sound(self) -> None:
        """Sound files are read: else damaged ones would be refused for another reason."""
        for group in self._groups[:1] if self.reader.whole else self._groups:
            assert self.reader.read(self.root, group[0]) != "refused", group[0]

    def attempt(self, rng: Rng) -> str:
        """``read`` or ``refused``; whatever else is raised is a failure."""
        group = self._groups[rng.integers(len(self._groups))]
        path = group[rng.integers(len(group))]
        if path not in self._content:
            self._content[path] = path.read_bytes()
        try:
            spoil(path, self._content[path], rng)
            found = self.reader.read(self.root, path)
            return "refused" if found == "refused" else "read"
        except EvsplatError as error:
            said = str(error)
            said.encode()
            assert 10 < len(said) < 8_000, f"a message of {len(said)} characters"
            return "refused"
        finally:
            remove(path)
            path.write_bytes(self._content[path])


def remove(path: Path) -> None:
    """Whatever is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def spoil(path: Path, content: bytes, rng: Rng) -> None:
    """Damage a file by what it holds, or put something else in its place."""
    path.unlink()
    kind = rng.integers(250)
    if kind == 0:
        path.mkdir()
    elif kind == 1:
        path.symlink_to(path)
    elif kind == 2:
        os.mkfifo(path)
    elif kind == 3:
        path.symlink_to("/dev/zero")
    elif kind == 4:
        path.write_bytes(b"")
    elif kind == 5:
        path.symlink_to("/etc/passwd")
    elif kind != 6 and path.suffix == ".h5" and rng.random() < 0.6:
        path.write_bytes(content)
        spoil_hdf5(path, rng)
    elif kind != 6:
        path.write_bytes(_DAMAGE.get(path.suffix, damage.damaged_bytes)(content, rng))


def spoil_hdf5(path: Path, rng: Rng) -> None:
    """Exchange, cut, link or empty one of the data sets of an event file."""
    with h5py.File(path, "a") as file:
        name = str(rng.choice(["events/t", "events/x", "events/y", "events/p", "ms_to_idx"]))
        if rng.random() < 0.1:
            name = "t_offset"
        values, kind = file[name][()], rng.integers(14)
        del file[name]
        if kind == 0:
            file[name] = h5py.ExternalLink("/etc/passwd", "/x")
        elif kind == 1:
            file[name] = h5py.SoftLink(f"/{name}")
        elif kind == 2:
            file.create_group(name)
        elif kind == 3:
            file.create_dataset(name, (10**13,), values.dtype, chunks=(65536,))
        elif kind == 4:
            outside = [("/etc/passwd", 0, max(values.nbytes, 1))]
            file.create_dataset(name, values.shape, values.dtype, external=outside)
        elif kind == 5:
            file.create_dataset(name, (10**6,), "i8", chunks=(10**6,), compression="gzip")
        elif kind == 6 and values.ndim:
            order = np.sort(rng.integers(0, 2**40, len(values)))
            file[name] = order.astype(values.dtype) if rng.random() < 0.5 else order[::-1]
        elif kind == 7 and values.ndim:
            shift = int(rng.choice([1, 50, 5000, -1]))
            limit = int(values.max()) if name != "ms_to_idx" else 10**6
            file[name] = np.clip(values.astype(np.int64) + shift, 0, limit).astype(values.dtype)
        elif kind == 8 and values.ndim:
            file[name] = np.full_like(values, rng.choice([0, values.max(), 255]))
        elif kind != 9:
            array = damage.damaged_array(np.asarray(values), rng)
            file[name] = array if array.dtype.kind not in "UM" else array.astype("S")


def note(error: BaseException) -> str:
    """Kind and place of an error, by which failures are grouped."""
    frames, trace = [], error.__traceback__
    while trace is not None:
        frames.append((trace.tb_frame.f_code.co_filename, trace.tb_lineno))
        trace = trace.tb_next
    ours = [(file, line) for file, line in frames if "/src/evsplat/" in file]
    file, line = (ours or frames)[-1]
    return f"{type(error).__name__} at {file.split('/evsplat/')[-1]}:{line}"
