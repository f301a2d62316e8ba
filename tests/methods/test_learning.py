"""Learning rates over a training, in closed form."""

import pytest

from evsplat.methods.learning import Rate, row_rates
from evsplat.methods.settings import NOMINAL_ITERATIONS


@pytest.mark.parametrize("constant", [0.0, 0.3, 0.75])
@pytest.mark.parametrize("final", [1.0, 0.1, 0.01])
def test_a_rate_stays_for_its_share_and_then_falls_exponentially_to_its_end(constant, final):
    rate = Rate(3e-3, final, constant)
    turn = constant * NOMINAL_ITERATIONS
    assert rate.factor(0) == rate.factor(0.5 * turn) == rate.factor(turn) == 1
    for share in (0.25, 0.5, 0.9, 1.0):
        nominal = turn + share * (NOMINAL_ITERATIONS - turn)
        assert rate.factor(nominal) == pytest.approx(final**share)
    assert rate.factor(2 * NOMINAL_ITERATIONS) == pytest.approx(final)


def test_centres_have_an_end_of_their_own_and_labels_learn_in_a_window():
    rows = row_rates(
        {"scales_log": 5e-3, "quaternions": 1e-3}, means=1e-4, final=0.2, means_final=0.01,
        constant=0.3,
    )  # fmt: skip
    assert {name: row.rate.start for name, row in rows.items()} == {
        "scales_log": 5e-3, "quaternions": 1e-3, "means": 1e-4, "semantic_logits": 1e-2
    }  # fmt: skip
    ends = {name: row.rate.factor(NOMINAL_ITERATIONS) for name, row in rows.items()}
    assert ends == pytest.approx(dict.fromkeys(rows, 0.2) | {"means": 0.01})
    assert all(row.rate.constant == 0.3 for row in rows.values())
    windows = {name: row.window for name, row in rows.items()}
    always = (0.0, float("inf"))
    assert windows == dict.fromkeys(rows, always) | {"semantic_logits": (1_000.0, 12_000.0)}
