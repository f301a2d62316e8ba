"""Checkpoints: every tensor and number of a training run in one safetensors file."""

import json
import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from evsplat.commands import command
from evsplat.errors import DataError, OutputError
from evsplat.files import remove_file, write_pieces
from evsplat.models.model import Model
from evsplat.untrusted.faults import MISFITS, broken_as
from evsplat.untrusted.records import misfit
from evsplat.untrusted.tensors import read_safetensors
from evsplat.untrusted.text import parse_json

logger = logging.getLogger(__name__)

KEEP = 2
"""Checkpoints kept in a run; the one before the last survives a disk that fills up."""


def save_checkpoint(
    folder: Path, iteration: int, tensors: dict[str, Tensor], state: dict[str, Any]
) -> Path:
    """Write one checkpoint atomically and drop all but the newest `KEEP`.

    Where the disk is full the oldest gives way, if another one stays. Later ones, which the
    training went on from before, being damaged, go as well.

    Raises:
        OutputError: No room, or no permission; the message says what is kept.
    """
    path = folder / f"{iteration:06d}.safetensors"
    older = [old for old in checkpoints(folder) if int(old.stem) < iteration]
    try:
        write_state(path, tensors, state)
    except OutputError as error:
        if not error.no_room or len(older) < 2:
            raise OutputError(f"{error} {kept_sentence(folder)}", no_room=error.no_room) from error
        logger.warning("%s Trying again without %s.", error, older[0].name)
        remove_file(older.pop(0))
        return save_checkpoint(folder, iteration, tensors, state)
    kept = [*older, path][-KEEP:]
    for other in checkpoints(folder):
        if other not in kept:
            remove_file(other)
    return path


def kept_sentence(folder: Path) -> str:
    """What a training that cannot go on leaves in its folder of checkpoints, and what to do."""
    newest = latest_checkpoint(folder)
    if newest is None:
        return "No checkpoint is kept: once that is mended, train again."
    return (
        f"The checkpoint of step {int(newest.stem)} is kept: once that is mended, go on with: "
        f"{command('train', 'CAPTURE', '--out', folder.parent, '--resume')}."
    )


def write_state(path: Path, tensors: dict[str, Tensor], state: dict[str, Any]) -> None:
    """Write tensors and state as `load_checkpoint` reads them, whole or not at all."""
    kept = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    # Not safetensors' save_file, which writes to a file of its own and leaves it behind where it is
    # killed; nor its save, which makes the whole file in memory first, 170 MB of an hour's.
    write_pieces(path, _pieces(kept, {"state": json.dumps(state)}))


_TYPES = {
    **{torch.float64: "F64", torch.float32: "F32", torch.float16: "F16", torch.bfloat16: "BF16"},
    **{torch.int64: "I64", torch.int32: "I32", torch.int16: "I16", torch.int8: "I8"},
    **{torch.uint8: "U8", torch.bool: "BOOL"},
}


def _pieces(tensors: dict[str, Tensor], texts: dict[str, str]) -> Iterator[bytes | memoryview]:
    """A file of safetensors: the length of its header, the header, and the numbers in a row.

    The largest types come first, so that all lie at multiples of their size.
    """
    order = sorted(tensors, key=lambda name: (-tensors[name].element_size(), name))
    header: dict[str, Any] = {"__metadata__": texts}
    end = 0
    for name in order:
        begin, end = end, end + tensors[name].nbytes
        kind, shape = _TYPES[tensors[name].dtype], list(tensors[name].shape)
        header[name] = {"dtype": kind, "shape": shape, "data_offsets": [begin, end]}
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    yield len(text).to_bytes(8, "little")
    yield text
    for name in order:
        yield tensors[name].flatten().view(torch.uint8).numpy().data


def checkpoints(folder: Path) -> list[Path]:
    """The checkpoints of a run, the newest last."""
    found = (path for path in folder.glob("*.safetensors") if path.stem.isdecimal())
    # By number: a million has a digit more than what names are padded to.
    return sorted(found, key=lambda path: int(path.stem))


def latest_checkpoint(folder: Path) -> Path | None:
    """The newest checkpoint of a run, None where there is none."""
    found = checkpoints(folder)
    return found[-1] if found else None


def load_latest(folder: Path) -> tuple[Path, dict[str, Tensor], dict[str, Any]] | None:
    """The newest checkpoint that can be read, its tensors and its state; None where none is.

    One that cannot be read gives way to the one before, which is said.

    Raises:
        DataError: There are some, and none of them can be read.
    """
    found = checkpoints(folder)
    for path in reversed(found):
        try:
            return path, *load_checkpoint(path)
        except DataError as error:
            if path == found[0]:
                raise
            logger.warning("%s Taking the one before it.", error)
    return None


def load_checkpoint(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and state of a checkpoint; a damaged file is a `DataError`."""
    try:
        tensors, texts = read_safetensors(path)
        state = parse_json(texts["state"])
    except (OSError, KeyError, ValueError) as error:
        raise DataError(
            f"{path}: not a readable checkpoint ({error}); train again where there is no other."
        ) from None
    wrong = misfit(state, _STATE, "state")
    if wrong:
        raise DataError(f"{path}: {wrong}; train again where there is no other.")
    return tensors, state


_STATE = {
    "clock": {
        **{"iteration": int, "iterations": int},
        **{"fraction": float, "seconds": float, "step_seconds": float},
    },
    "human_count": int,
}
ENDING = {"may_end_early": bool, "ends_at": int}
"""Of the clock, what a training that goes on needs."""
RESUMED = {"clock": ENDING, "queue": [int], "skipped": int, "previous_nominal": float}
"""What the state of a checkpoint holds besides, for a training that goes on."""


@contextmanager
def misfits_of(path: Path) -> Iterator[None]:
    """A `DataError` of what goes wrong where a checkpoint's tensors are not the model's."""
    with broken_as(
        path,
        "does not fit the capture and settings of its run",
        "restore both as they were, or train again",
        kinds=MISFITS,
    ):
        yield


def check_fits(model: Model, tensors: dict[str, Tensor], path: Path) -> None:
    """Refuse a checkpoint of another version of the method with a `DataError`."""
    known, found = set(model.state_dict()), set(below("model", tensors))
    for names, what in ((known - found, "lacks"), (found - known, "holds the unknown")):
        if names:
            first, more = min(names), len(names) - 1
            others = f" and {more} more" if more else ""
            raise DataError(
                f"{path}: {what} {first}{others}, being written by another version of evsplat "
                "(versions.json beside its folder names it), or before config.yaml or the capture "
                "was changed; open it with that one, restore both as they were, or train again."
            )


def load_model(
    model: Model, tensors: dict[str, Tensor], human_count: int, *, filled: bool = False
) -> None:
    """Give a model the parameters of a checkpoint, whatever its number of Gaussians was.

    ``filled``: those that a finished training decided for what it hardly saw, where it did.

    Raises:
        ValueError: Numbers are not finite, or attributes are not of as many Gaussians.
    """
    entries = below("model", tensors) | (below("filled", tensors) if filled else {})
    require_finite(entries)
    for name, rows in model.sets.items():
        device = rows.means.device
        values = {key: entries[f"{name}.{key}"].to(device) for key in rows.attributes}
        for key, value in values.items():
            shape = (*values["means"].shape[:1], *rows.get_parameter(key).shape[1:])
            require_shape(f"{name}.{key}", value, shape)
        if rows.holds("human") and not 0 <= human_count <= len(values["means"]):
            raise ValueError(f"{human_count} Gaussians of the person, of {len(values['means'])}")
        rows.set_rows(values, human_count)
    model.load_state_dict(entries)
    for cache in model.row_caches.values():
        # found for the rows that were there before, which may be as many
        cache.rows_changed()


def require_finite(tensors: Mapping[str, Tensor]) -> None:
    """Raise a `ValueError` that names a tensor whose numbers are not all finite."""
    for name, value in tensors.items():
        if value.is_floating_point() and not value.isfinite().all():
            raise ValueError(f"{name} holds numbers that are not finite")


def require_shape(name: str, value: Tensor, shape: tuple[int, ...]) -> None:
    """Raise a `ValueError` where a tensor has another shape."""
    if tuple(value.shape) != shape:
        raise ValueError(f"{name} has shape {tuple(value.shape)}, expected {shape}")


def check_progress(state: dict[str, Any], frames: int) -> None:
    """Raise a `ValueError` where a state is none that a training with so many frames has."""
    clock = state["clock"]
    within = {
        "iteration": (clock["iteration"], 0, 2**53),
        "iterations": (clock["iterations"], 1, 2**53),
        "ends_at": (clock["ends_at"], 0, 2**53),
        "fraction": (clock["fraction"], 0, 1),
        "seconds": (clock["seconds"], 0, 1e12),
        "step_seconds": (clock["step_seconds"], 0, 1e12),
        **{f"queue[{k}]": (number, 0, frames - 1) for k, number in enumerate(state["queue"])},
    }
    for name, (value, least, most) in within.items():
        if not least <= value <= most:
            raise ValueError(f"{name} is {value}, expected {least} to {most}")


def counts(model: Model) -> dict[str, int]:
    """Number of Gaussians per class."""
    sets = model.sets.values()
    return {
        "human": sum(rows.human_count for rows in sets),
        "scene": sum(rows.scene_count for rows in sets),
    }


def flatten(prefix: str, state: dict[Any, Any]) -> dict[str, Tensor]:
    """Tensors of a nested dictionary under dotted names."""
    flat: dict[str, Tensor] = {}
    for key, value in state.items():
        name = f"{prefix}.{key}"
        if isinstance(value, dict):
            flat |= flatten(name, value)
        else:
            flat[name] = torch.as_tensor(value)
    return flat


def below(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Entries of a flat dictionary below ``prefix``, without it."""
    start = prefix + "."
    return {name[len(start) :]: value for name, value in tensors.items() if name.startswith(start)}
