"""`Correlations` and `OwnTimes` against closed forms."""

from collections.abc import Callable

import numpy as np
import pytest

from evsplat.inspection.matching import Correlations, OwnTimes, normalised
from evsplat.inspection.search import DELAYS, NOW, BestPlace, _changing

REACH = 5


def squares(places: list[tuple[int, int]], size: int = 24) -> np.ndarray:
    """Silhouettes of 4 x 4 pixels at (row, column)."""
    maps = np.zeros((len(places), size, size), bool)
    for k, (row, column) in enumerate(places):
        maps[k, row : row + 4, column : column + 4] = True
    return maps


def drawing(posed: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Silhouettes by their rows, as `Correlations` takes them."""
    return lambda rows: posed[rows].astype(np.float32)


def whole(maps: np.ndarray, posed: np.ndarray) -> np.ndarray:
    """Correlation over all shifts with silhouettes of the same times."""
    row = np.arange(len(maps))[:, None]
    wide = np.pad(posed, ((0, 0), (REACH, REACH), (REACH, REACH)))
    groups = (slice(None),)
    return Correlations.of(normalised(maps), drawing(wide), row, REACH, groups).overall[0]


def test_a_silhouette_that_is_moved_back_onto_the_map_correlates_fully() -> None:
    posed = squares([(8, 9), (3, 12), (11, 6)])
    found = whole(np.roll(posed, (3, -2), (1, 2)).astype(np.float32), posed)
    assert np.unravel_index(found.argmax(), found.shape) == (REACH + 3, REACH - 2)
    assert found.max() == pytest.approx(1, abs=1e-5)


def test_correlation_is_that_of_numpy_at_every_shift() -> None:
    rng = np.random.default_rng(0)
    maps, posed = rng.random((1, 24, 24)), squares([(9, 8)])
    found = whole(maps, posed)
    for down, right in ((0, 0), (4, -5), (-3, 2)):
        moved = np.roll(posed[0], (down, right), (0, 1))
        expected = np.corrcoef(maps.ravel(), moved.ravel())[0, 1]
        assert found[REACH + down, REACH + right] == pytest.approx(expected, abs=1e-5)


def test_groups_have_places_of_their_own() -> None:
    posed = squares([(8, 8), (9, 9)])
    maps = np.stack([np.roll(posed[0], 2, 0), np.roll(posed[1], -3, 1)]).astype(np.float32)
    wide = np.pad(posed, ((0, 0), (REACH, REACH), (REACH, REACH)))
    groups = (slice(0, 1), slice(1, 2))
    found = Correlations.of(normalised(maps), drawing(wide), np.arange(2)[:, None], REACH, groups)
    places = [np.unravel_index(group[0].argmax(), group[0].shape) for group in found.grouped]
    assert places == [(REACH + 2, REACH), (REACH, REACH - 3)]
    assert found.grouped.max((1, 2, 3)) == pytest.approx(1, abs=1e-5)


def test_order_is_one_for_the_own_times_and_a_half_by_chance() -> None:
    rng = np.random.default_rng(1)
    posed = squares([tuple(rng.integers(0, 20, 2)) for _ in range(16)])
    far = ~np.eye(16, dtype=bool)
    noisy = posed + rng.normal(size=posed.shape)
    assert OwnTimes.of(noisy, posed, far).order > 0.95
    chance = [OwnTimes.of(rng.normal(size=posed.shape), posed, far) for _ in range(20)]
    assert np.mean([one.order for one in chance]) == pytest.approx(0.5, abs=0.05)
    assert np.mean([one.follows for one in chance]) == pytest.approx(0, abs=0.02)


def test_what_follows_a_body_does_so_as_far_as_it_is_like_it_whether_it_moves_much_or_little() -> (
    None
):
    rng = np.random.default_rng(2)
    far = ~np.eye(40, dtype=bool)
    for reach in (3, 20):
        posed = squares([tuple(rng.integers(0, reach, 2)) for _ in range(40)])
        noisy = posed + rng.normal(size=posed.shape)
        alike = [np.corrcoef(a.ravel(), b.ravel())[0, 1] for a, b in zip(noisy, posed, strict=True)]
        found = OwnTimes.of(noisy, posed, far)
        assert found.follows == pytest.approx(np.mean(alike), abs=0.03)
        # A part that stands where the body stands is like it at all times, and follows nothing.
        stands = OwnTimes.of(np.repeat(noisy[:1], 40, axis=0), posed, far)
        assert stands.follows == pytest.approx(0, abs=1e-6)


def test_order_of_a_body_that_stands_still_is_not_told() -> None:
    posed = squares([(4, 4)] * 8)
    assert OwnTimes.of(posed.astype(float), posed, ~np.eye(8, dtype=bool)) is None


def test_what_changes_in_time_tells_delays_of_somebody_who_stays():
    """A large part that stands and a small one that moves on by its own width per frame."""
    film = np.zeros((12, 20, 60), np.float32)
    film[:, :16] = 1
    for frame in range(12):
        film[frame, 17:19, 4 * frame : 4 * frame + 4] = 1
    now, late = film[2:10], film[4:12]
    assert _changing(now, now) == pytest.approx(1)
    assert _changing(now, 3 * now + 5) == pytest.approx(1)
    assert np.corrcoef(now.ravel(), late.ravel())[0, 1] > 0.95
    assert _changing(now, late) < 0.3
    assert _changing(now, np.ones_like(now)) == 0
    assert _changing(now[:1], now[:1]) == _changing(now[:0], now[:0]) == 0


def test_delays_are_told_where_both_halves_say_so():
    def peaks(*at: int, top: float = 0.4) -> BestPlace:
        """Curves that fall by 0.075 a step, down to 0.1."""
        away = np.abs(np.arange(len(DELAYS)) - NOW - np.array(at)[:, None])
        return BestPlace(changing=np.maximum(top - 0.075 * away, 0.1))

    delay, lost = peaks(4, 3, 5).changed
    assert (delay, lost) == (NOW + 4, pytest.approx(0.75))
    assert peaks(0, 0, 0).changed == (NOW, pytest.approx(0))
    assert peaks(4, -3, 5).changed is None
    assert peaks(4, 0, 5).changed is None
    # The second half is better without the delay of both together, so that it is noise.
    assert peaks(6, 7, 2).changed is None
    assert peaks(6, 7, 4).changed == (NOW + 6, pytest.approx(0.75))
    faint = BestPlace(changing=np.full((3, len(DELAYS)), 0.05))
    assert faint.changed is None and BestPlace().changed is None
