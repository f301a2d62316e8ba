"""Causes of events that do not tell what frames show are named in the order of what is likelier."""

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from evsplat.inspection.event_check import event_findings, flicker_findings, lie_elsewhere

from ..conftest import write_event_file
from ..seen import changes_much, seen


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


def test_events_beside_their_pixels_are_told_by_how_far_and_not_as_another_fault(
    rng: np.random.Generator,
    tiny_capture: Callable[..., Path],
) -> None:
    path = tiny_capture(frames=12, width=64, height=48)
    with h5py.File(path / "events.h5") as file:
        t, x, y, p = (file[f"events/{key}"][:] for key in "txyp")
    right = int(rng.integers(4, 8))
    kept = x + right < 64
    write_event_file(path / "events.h5", t[kept], x[kept] + right, y[kept], p[kept])
    (finding,) = event_findings(seen(path))
    assert lie_elsewhere([finding]) and finding.severity == "warning"
    told = float(str(finding).split("in the pictures: ")[1].split(" px to the right")[0])
    assert told == pytest.approx(right, abs=0.5)
    assert str(finding).endswith(f"what brings them there is told by: evsplat inspect {path}")


def test_of_events_without_polarity_is_told_what_needs_none(
    rng: np.random.Generator,
    tiny_capture: Callable[..., Path],
) -> None:
    """That the sensor lost some, and that they lie elsewhere; not which way, which they hide."""
    drawn = (
        tiny_capture(str(seed), frames=12, width=96, height=72, seed=int(seed))
        for seed in rng.integers(10_000, size=300)
    )
    path = next(one for one in drawn if changes_much(one, 5, 6))
    with h5py.File(path / "events.h5") as file:
        t, x, y, p = (file[f"events/{key}"][:] for key in "txyp")

    def found(t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray) -> list[str]:
        write_event_file(path / "events.h5", t, x, y, np.zeros_like(p))
        assert not seen(path).events.has_polarity
        return [finding.field for finding in event_findings(seen(path))]

    assert found(t, x, y, p) == []
    assert found(*_gap(t, x, y, p)) == ["events/t"]
    assert found(*_warped(t, x, y, p)) == ["events/x, events/y"]


@pytest.mark.parametrize("hertz", [100, 120])
def test_lamps_that_flicker_are_told(
    tiny_capture: Callable[..., Path], monkeypatch: pytest.MonkeyPatch, hertz: int
) -> None:
    width, height = 64, 48
    path = tiny_capture(frames=12, width=width, height=height)
    assert flicker_findings(seen(path)) == []
    with h5py.File(path / "events.h5") as file:
        t, x, y, p = (file[f"events/{key}"][:] for key in "txyp")
    y_all, x_all = (places.ravel() for places in np.mgrid[:height, :width])
    halves = np.arange(t[0], t[-1], 5e5 / hertz).astype(np.int64)
    more = (
        np.repeat(halves, len(x_all)),
        np.tile(x_all, len(halves)),
        np.tile(y_all, len(halves)),
        np.repeat(np.arange(len(halves)) % 2, len(x_all)),
    )
    t, x, y, p = (np.concatenate(both) for both in zip((t, x, y, p), more, strict=True))
    order = np.argsort(t, kind="stable")
    write_event_file(path / "events.h5", *(column[order] for column in (t, x, y, p)))
    capture = seen(path)
    (finding,) = flicker_findings(capture)
    assert f"in turns, {hertz} times a second" in str(finding)
    # Found once: the training that was warned does not read millions of events once more.
    monkeypatch.setattr("evsplat.events.EventStore.between", None)
    assert capture.flicker_us == pytest.approx(1e6 / hertz, rel=0.02)
