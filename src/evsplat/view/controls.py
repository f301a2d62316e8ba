"""Controls whose callbacks only see values that the control can have."""

from collections.abc import Awaitable, Callable
from typing import Any

import viser


def when_changed(control: Any, changed: Callable[[viser.GuiEvent], Awaitable[None]]) -> None:
    """Call ``changed`` after a change of a slider or of a choice.

    A page may send a value beyond the slider's ends, or none of the choices: that is taken back,
    and a `ValueError` says so, which the server logs in a line.
    """
    last = control.value

    async def checked(event: viser.GuiEvent) -> None:
        nonlocal last
        found = control.value
        if not _can_be(control, found):
            control.value = last
            raise ValueError(f"{control.label}: {str(found)[:40]!r} cannot be chosen")
        last = found
        await changed(event)

    control.on_update(checked)


def _can_be(control: Any, value: Any) -> bool:
    """Whether a control can have a value; the slider's ends are rounded by the page."""
    if hasattr(control, "options"):
        return value in control.options
    if hasattr(control, "max"):
        return bool(control.min - control.step <= value <= control.max + control.step)
    return True
