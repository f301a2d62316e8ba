"""What a checkpoint holds beside parameters: records of one tensor per field."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, TypeVar

from torch import Tensor

Record = TypeVar("Record")


def stored(
    kind: type[Record], what: str, tensors: Mapping[str, Tensor], count: int, **columns: int
) -> Record | None:
    """A dataclass of its fields' tensors by their names, or None where there are none.

    Each has a row for each of ``count`` Gaussians; ``columns`` are those of fields that have some.

    Raises:
        ValueError: They are not those of ``count`` Gaussians, or not finite; ``what`` names them.
    """
    if not tensors:
        return None
    names = [field.name for field in fields(kind)]  # type: ignore[arg-type]
    values: dict[str, Any] = {name: tensors[name] for name in names}
    found = [tuple(value.shape) for value in values.values()]
    if found != [(count, columns[name]) if name in columns else (count,) for name in names]:
        raise ValueError(f"{what} is of shapes {found}, of {count} Gaussians")
    if not all(value.isfinite().all() for value in values.values()):
        raise ValueError(f"{what} holds numbers that are not finite")
    return kind(**values)
