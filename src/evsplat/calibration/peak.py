"""Where a sampled curve is highest, between its samples."""

import numpy as np
from jaxtyping import Float

_NEAR = 5


def top_near(values: Float[np.ndarray, "N"], best: int) -> float:
    """Place of the top, in samples, by a parabola through the five values about the largest.

    ``best``, the place of the largest, where the parabola has no top or a value is NaN. Of at least
    five ``values`` at even steps.
    """
    first = min(max(best - _NEAR // 2, 0), len(values) - _NEAR)
    near = values[first : first + _NEAR]
    if np.isnan(near).any():
        return float(best)
    a, b, _ = np.polyfit(np.arange(first, first + _NEAR) - best, near, 2)
    if a >= 0:
        return float(best)
    return float(best + np.clip(-b / (2 * a), -2, 2))
