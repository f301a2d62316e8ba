"""Plans and means of exposures against arithmetic done by hand and in float64."""

import numpy as np
import pytest

from evsplat.errors import ConfigError
from evsplat.options import SynthesisSettings
from evsplat.options.declare import given
from evsplat.synthesis.exposure import ExposureMean, plan_exposures

TIMES = np.arange(11) * 10_000


def means(times, settings, light):
    """(exposure, mean) of all exposures when sub-frame k shows ``light[k]``."""
    plan = plan_exposures(times, settings)
    mean = ExposureMean(plan)
    assert len(light) == len(plan.subframe_us)
    return [done for picture in light for done in mean.add(np.float32(picture))]


def random_light(count, seed):
    return np.random.default_rng(seed).random((count, 3, 4, 2))


@pytest.mark.parametrize("count", [1, 3, 5, 9])
def test_k_subframes_are_the_plain_mean_of_k(count):
    settings = SynthesisSettings(upsample=4, subframes=count) if count > 1 else None
    if settings is None:
        with pytest.raises(ConfigError, match="not blurry"):
            plan_exposures(TIMES, SynthesisSettings(upsample=4, subframes=1))
        return
    light = random_light(41, seed=count)
    done = means(TIMES, settings, light)
    assert len(done) >= 8
    for exposure, mean in done:
        first = 4 * exposure.source - count // 2
        assert mean == pytest.approx(light[first : first + count].mean(axis=0), abs=3e-4)


def test_full_duty_counts_the_ends_half():
    """Eight sub-frames per gap, exposure one gap long: the trapezoid of nine around the middle."""
    light = random_light(81, seed=0)
    done = means(TIMES, SynthesisSettings(upsample=8, duty=1.0), light)
    assert [exposure.source for exposure, _ in done] == list(range(1, 10))
    weights = np.array([0.5, 1, 1, 1, 1, 1, 1, 1, 0.5]) / 8
    for exposure, mean in done:
        first = 8 * exposure.source - 4
        expected = np.einsum("k,k...->...", weights, light[first : first + 9])
        assert mean == pytest.approx(expected, abs=2e-6)
        assert (exposure.start_us, exposure.end_us) == (
            10_000 * exposure.source - 5000,
            10_000 * exposure.source + 5000,
        )


@pytest.mark.parametrize("seed", range(4))
def test_any_exposure_of_uneven_times_is_the_integral_in_float64(seed):
    """Overlapping exposures too: each is the integral of the piecewise constant light."""
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.integers(5000, 15_000, 20))
    settings = SynthesisSettings(upsample=int(rng.integers(1, 6)), exposure_us=31_000)
    plan = plan_exposures(times, settings)
    light = random_light(len(plan.subframe_us), seed)
    middles = (plan.subframe_us[1:] + plan.subframe_us[:-1]) / 2
    edges = np.concatenate([[-1e9], middles, [1e9]])
    done = means(times, settings, light)
    assert len(done) > 10
    for exposure, mean in done:
        seen = np.clip(edges, exposure.start_us, exposure.end_us)
        share = np.diff(seen) / (exposure.end_us - exposure.start_us)
        assert share.sum() == pytest.approx(1)
        assert mean == pytest.approx(np.einsum("k,k...->...", share, light), abs=1e-6)
        middle = (exposure.start_us + exposure.end_us) // 2
        assert middle == times[exposure.source]


def test_lower_rate_takes_the_pictures_nearest_to_even_times():
    times = np.round(np.arange(240) * 1e6 / 240).astype(int)
    plan = plan_exposures(times, SynthesisSettings(fps=25, duty=0.5, interpolation="none"))
    middles = times[[exposure.source for exposure in plan.exposures]]
    wanted = middles[0] + np.arange(len(middles)) * 40_000
    assert np.abs(middles - wanted).max() <= 2084
    assert len(middles) == 25 and (np.diff(middles) > 0).all()
    assert {e.end_us - e.start_us for e in plan.exposures} == {20_000}


@pytest.mark.parametrize("count", range(20, 29))
def test_spacing_stays_even_to_the_last_frame(count):
    """The end of the footage may not draw the last frame nearer."""
    times = np.round(np.arange(count) * 1e6 / 60).astype(int)
    plan = plan_exposures(times, SynthesisSettings(fps=15, duty=0.9, upsample=4))
    assert set(np.diff([exposure.source for exposure in plan.exposures])) == {4}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fps": 102}, "100 pictures per second"),
        ({"duty": 0.1}, "not blurry"),
        ({"exposure_us": 101_300}, "too short"),
        ({"upsample": 20_000}, "whole microseconds"),
    ],
)
def test_settings_that_do_not_fit_the_footage_are_refused(changes, words):
    with pytest.raises(ConfigError, match=words):
        plan_exposures(TIMES, SynthesisSettings(**changes))
    with pytest.raises(ConfigError, match="at least 2"):
        plan_exposures(TIMES[:1], SynthesisSettings())


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"recipe": "zju"}, "zju-mocap-blur"),
        ({"interpolation": "slow"}, "flow, super-slomo, none"),
        ({"duty": -1.0}, "--duty -1: expected a number above 0"),
        ({"duty": 0.5, "subframes": 3}, "--duty and --subframes"),
        ({"sensor": "evk"}, "evk4"),
        ({"contrast": 0.0}, "--contrast 0"),
        ({"upsampel": 2}, "did you mean upsample"),
        ({"read_noise": 2.0}, "--read-noise 2"),
        ({"upsample": 0}, "--upsample 0"),
    ],
)
def test_settings_out_of_range_are_refused(changes, words):
    with pytest.raises(ConfigError, match=words):
        given(SynthesisSettings, None, changes)


def test_length_given_replaces_the_length_of_the_recipe():
    settings = SynthesisSettings("zju-mocap-blur", subframes=5)
    assert settings.duty is None and settings.subframes == 5 and settings.upsample == 8
