"""The shift and delay at which silhouettes fit best what moves."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Shaped

from evsplat.inspection.matching import Correlations, OwnTimes, normalised

REACH_PX = 24
"""Shifts of so many map pixels each way are tried: 30 % of the body's height."""
DELAYS = tuple(step / 2 for step in range(-8, 9))
"""Delays that are tried, in frames."""
NOW = DELAYS.index(0.0)
_CHANGES = 0.12
"""A lower correlation of what changes in time tells nothing."""


@dataclass(frozen=True)
class BestPlace:
    """The place where silhouettes fit best, and how well."""

    delay: int = NOW
    """Index in `DELAYS`."""
    down: int = 0
    right: int = 0
    """Shift in map pixels."""
    given_score: float = 0.0
    """Correlation without shift and delay."""
    score: float = 0.0
    own_times: OwnTimes | None = None
    """There, the mean over kinds of movement."""
    parting: float = 0.0
    """`Belonging.parting`."""
    changing: Float[np.ndarray, "3 D"] | None = None
    """Of the recording, its first and its second half, at each of `DELAYS`, without shift:
    correlation of what changes in time (`_changing`)."""

    @classmethod
    def of(
        cls,
        found: Mapping[str, Float32[np.ndarray, "K h w"]],
        silhouettes: Callable[[str, Int[np.ndarray, "K"]], Float32[np.ndarray, "K H W"]],
        far: Bool[np.ndarray, "K K"],
        row: Int[np.ndarray, "K D"],
    ) -> "BestPlace":
        """Of kinds of movement, which count alike, and what ``silhouettes`` gives for rows."""
        if not found:
            return cls()
        half = (len(row) + 1) // 2
        halves = (slice(half), slice(half, None))
        # counts of events have a long tail, which a root shortens
        raw = {k: np.sqrt(m) if k == "events" else m for k, m in found.items()}
        maps = {k: normalised(m) for k, m in raw.items()}
        searched = [
            Correlations.of(m, partial(silhouettes, kind), row, REACH_PX, halves)
            for kind, m in maps.items()
        ]
        overall = np.mean([one.overall for one in searched], axis=0)
        grouped = np.mean([one.grouped for one in searched], axis=0)
        best = np.argwhere(overall == overall.max()).tolist()
        # delays that make no difference, as those of one frame, are none
        delay, y, x = min(best, key=lambda found: abs(found[0] - NOW))
        place, down, right = (delay, y, x), y - REACH_PX, x - REACH_PX
        highest = np.maximum(grouped.max((1, 2, 3)), 1e-9)
        told = [
            OwnTimes.of(
                m, in_picture(silhouettes(kind, row[:, delay]), m.shape[1:], down, right), far
            )
            for kind, m in maps.items()
        ]
        changing = []
        for kind, m in raw.items():
            films = [in_picture(silhouettes(kind, at), m.shape[1:], 0, 0) for at in row.T]
            parts = (slice(None), *halves)
            changing.append([[_changing(m[p], film[p]) for film in films] for p in parts])
        own = [(one.order, one.follows) for one in told if one is not None]
        return cls(
            delay,
            down,
            right,
            given_score=float(overall[NOW, REACH_PX, REACH_PX]),
            score=float(overall[place]),
            own_times=OwnTimes(*np.mean(own, axis=0).tolist()) if own else None,
            parting=float((1 - grouped[:, *place] / highest).max()),
            changing=np.mean(changing, axis=0),
        )

    @property
    def changed(self) -> tuple[int, float] | None:
        """The delay, as an index in `DELAYS`, at which what changes in time fits best, and the
        share of its correlation that is lost without it.

        None where too little changes, or where the gain is no more than its noise: the mean of two
        halves' gains is above its standard error, half of their difference, if both gain there.
        """
        if self.changing is None or self.changing[0].max() < _CHANGES:
            return None
        delay, *halves = self.changing.argmax(1).tolist()
        if any(np.sign(half - NOW) != np.sign(delay - NOW) for half in halves):
            return None
        gains = self.changing[1:, delay] - self.changing[1:, NOW]
        if delay != NOW and gains.min() <= 0:
            return None
        return delay, float(1 - self.changing[0, NOW] / self.changing[0, delay])


def _changing(moves: Float32[np.ndarray, "K h w"], drawn: Float32[np.ndarray, "K h w"]) -> float:
    """Correlation of two films, each less its mean over time: of what differs between frames.

    It tells delays of people who stay where they are, most of whom is the same in all frames. In
    less than two frames nothing changes: 0.
    """
    if len(moves) < 2:
        return 0.0
    one, other = (film - film.mean(0) for film in (moves, drawn))
    size = float(np.sqrt(np.square(one).sum() * np.square(other).sum()))
    return float((one * other).sum()) / size if size > 0 else 0.0


def drawn(
    kind: str, posed: Bool[np.ndarray, "K H W"], edges: Bool[np.ndarray, "K H W"]
) -> Float32[np.ndarray, "K H W"]:
    """Where a body is expected to show: pictures change inside; events come most at the outline."""
    inside = posed.astype(np.float32)
    return inside if kind == "frames" else 0.5 * inside + edges


def in_picture(
    posed: Shaped[np.ndarray, "K H W"], size: tuple[int, ...], down: int, right: int
) -> Shaped[np.ndarray, "K h w"]:
    """The picture's part of wider silhouettes that are moved ``down`` and ``right``."""
    top, left = REACH_PX - down, REACH_PX - right
    return posed[:, top : top + size[0], left : left + size[1]]
