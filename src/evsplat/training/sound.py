"""Trainings that could not learn, or did not learn, anything: said instead of saved."""

from evsplat.capture import TrainingCapture
from evsplat.errors import DataError
from evsplat.training.trainer import Trainer


def check_events_reach(capture: TrainingCapture) -> None:
    """A `DataError` where a recording has no event from the first training exposure to the last."""
    events = capture.events
    if events is None:
        return
    if not len(events):
        raise DataError(
            f"{events.path}: holds no event that training may see (those of held-out frames are "
            "hidden); record or export it again, or train by the blur alone: --set event_weight=0."
        )
    frames = capture.train_frames
    exposures = [frame.exposure_us for frame in frames]
    first, last = min(start for start, _ in exposures), max(end for _, end in exposures)
    if any(len(events.between(*exposure)) for exposure in exposures):
        return
    for low, high in {events.readable_around(frame.mid_us) for frame in frames}:
        if len(events.between(max(low, first), min(high, last))):
            return
    start, end = events.time_range_us
    raise DataError(
        f"{events.path}: none of {len(events)} events from {start} to {end} us lies in the time "
        f"of the training frames, {first} to {last} us, so that none would be learned from; "
        "correct events.clock_offset_us, or train without them: --set event_weight=0."
    )


def check_learned(trainer: Trainer, steps: int) -> None:
    """A `DataError` where ``steps`` were made and none had a finite loss and gradient."""
    if steps and trainer.bad.in_a_row() >= steps:
        raise DataError(
            f"{trainer.capture.path}: none of {steps} steps gave a finite loss and gradient, so "
            "that nothing was learned; look at camera and poses with evsplat inspect."
        )
