"""What follows from tensors that nobody learns: made once, and kept for the next picture."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

from torch import Tensor

from evsplat.render import same_memory

Value = TypeVar("Value")


class Unchanged:
    """Tells whether the same tensors are given again."""

    def __init__(self) -> None:
        """Nothing was given yet."""
        self._seen: list[tuple[Tensor, int]] = []

    def again(self, given: Sequence[Tensor]) -> bool:
        """Whether these are what was given the last time, in the same memory and not written since.

        Never of tensors that are learned: an optimiser may write to them without telling.
        """
        known = len(given) == len(self._seen) and all(
            not new.requires_grad and new._version == version and same_memory(new, old)
            for new, (old, version) in zip(given, self._seen, strict=True)
        )
        self._seen = [(tensor.detach(), tensor._version) for tensor in given]
        return known


class Kept:
    """One value, with what it follows from."""

    def __init__(self) -> None:
        """No value yet."""
        self._given = Unchanged()
        self._made = False
        self._asked: Any = None
        self._value: Any = None

    def of(
        self, given: Iterable[Tensor], make: Callable[[], Value], *, asked: object = None
    ) -> Value:
        """What ``make`` gives, made anew unless ``given`` is as it was the last time.

        ``asked``: what else it follows from, which is compared with ``==``.
        """
        given = list(given)
        if any(tensor.requires_grad for tensor in given):
            return make()
        if not self._given.again(given) or asked != self._asked or not self._made:
            # The old value goes first, so that there are never two, and none where this is stopped.
            self._made, self._value = False, None
            self._value = make()
            self._made, self._asked = True, asked
        value: Value = self._value
        return value
