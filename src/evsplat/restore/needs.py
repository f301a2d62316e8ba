"""What restorers that look at events ask of a capture."""

from evsplat.capture import TrainingCapture
from evsplat.errors import DataError


def require_signed_events(capture: TrainingCapture, restorer: str) -> None:
    """Raises `DataError` where the capture has no events, or they have no polarity."""
    if capture.events is None:
        raise DataError(
            f"{capture.path}: has no events, which {restorer} needs; record or simulate them first."
        )
    if not capture.events.has_polarity:
        raise DataError(
            f"{capture.events.path}: no event has a polarity (events/p is 0 throughout), which "
            f"{restorer} needs; record or simulate them with it."
        )
