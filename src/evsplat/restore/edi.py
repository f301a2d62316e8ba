"""Event double integral as a restorer (`evsplat.events.edi`)."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

from jaxtyping import Float
from torch import Tensor

from evsplat.capture import Frame, TrainingCapture, estimate_sensor, warn_of_contrast
from evsplat.errors import ConfigError, DataError
from evsplat.events import deblur
from evsplat.pictures import Transfer
from evsplat.restore.network import require_signed_events


class Edi:
    """Sharp pictures at mid-exposure from each frame and the events of its exposure."""

    name = "edi"

    def __init__(
        self,
        capture: TrainingCapture,
        *,
        contrast_threshold: tuple[float, float] | None = None,
        transfer: Transfer | None = None,
    ) -> None:
        """``contrast_threshold``: C+ and C-; without them the capture's, or else estimated ones.
        ``transfer``: the curve from values to light, by default the capture's own.

        Raises:
            DataError: The capture has no events or no polarity, or no thresholds and none can be
                estimated.
            ConfigError: A threshold is not above 0 and finite.
        """
        require_signed_events(capture, "the event double integral (edi)")
        self._transfer: Transfer = transfer or capture.transfer(capture.frames[0])
        given = contrast_threshold or ()
        if not all(0 < threshold < math.inf for threshold in given):
            raise ConfigError(
                f"contrast threshold {contrast_threshold}: expected two numbers above 0, C+ and C-."
            )
        self._origin = "given"
        if contrast_threshold is None and capture.contrast_threshold is not None:
            contrast_threshold, self._origin = capture.contrast_threshold, "from the capture"
        if contrast_threshold is None:
            contrast_threshold, self._origin = _estimated(capture), "estimated from the capture"
        self.contrast_threshold = contrast_threshold

    def restore(
        self, capture: TrainingCapture, frames: Sequence[Frame]
    ) -> Iterator[tuple[Frame, Float[Tensor, "H W 3"]]]:
        """See `Restorer`."""
        assert capture.events is not None
        for frame in frames:
            yield (
                frame,
                deblur(
                    capture.image(frame),
                    capture.events.between(*frame.exposure_us),
                    frame.exposure_us,
                    [frame.mid_us],
                    self.contrast_threshold,
                    transfer=self._transfer,
                )[0],
            )

    def provenance(self) -> dict[str, Any]:
        """The thresholds and where they come from."""
        return {
            "contrast_threshold": [round(value, 4) for value in self.contrast_threshold],
            "contrast_threshold_origin": self._origin,
            "transfer": self._transfer,
        }


def _estimated(capture: TrainingCapture) -> tuple[float, float]:
    estimate = estimate_sensor(capture)
    warn_of_contrast(capture, estimate)
    if estimate is None or estimate.thresholds is None:
        raise DataError(
            f"{capture.path}: its contrast thresholds are unknown and cannot be estimated from its "
            "training frames and events; give them with --contrast-threshold C+ C-."
        )
    return estimate.thresholds.plus, estimate.thresholds.minus
