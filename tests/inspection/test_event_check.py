"""Causes of events that do not tell what frames show are named in the order of what is likelier."""

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from evsplat.inspection.event_check import event_findings

from ..conftest import write_event_file
from ..seen import seen


def _warped(t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, ...]:
    return t, x // 2, y // 2, p


def _gap(t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, ...]:
    kept = (t < 200_000) | (t > 300_000)
    return t[kept], x[kept], y[kept], p[kept]


@pytest.mark.parametrize(
    ("changed", "field", "likeliest"),
    [
        (_warped, "events/x, events/y", "Most likely they lie in other pixels than the pictures'"),
        (_gap, "events/t", "Most likely the sensor lost them"),
    ],
)
def test_events_warped_to_half_the_size_are_not_called_lost(
    tiny_capture: Callable[..., Path], changed: Callable, field: str, likeliest: str
) -> None:
    path = tiny_capture(frames=12, width=64, height=48)
    with h5py.File(path / "events.h5") as file:
        columns = [file[f"events/{key}"][:] for key in "txyp"]
    assert event_findings(seen(path)) == []
    write_event_file(path / "events.h5", *changed(*columns))
    (finding,) = event_findings(seen(path))
    assert finding.field == field and likeliest in str(finding)
