"""Policy of a training: its view of what is held out from it, stated beside every figure."""

from dataclasses import dataclass
from typing import Any, Literal

from evsplat.errors import ConfigError
from evsplat.options.declare import Use, check_options

Masks = Literal["given", "estimated", "none"]
EventUse = Literal["amounts", "direction", "nothing"]
"""Of what events tell a method takes how much changed, which needs contrast thresholds; which way,
from which they cancel; or nothing."""


@dataclass(frozen=True)
class Policy:
    """The data that a method may see; written to config.yaml, and as `Terms` beside figures.

    A held-out interval runs from the end of the last training exposure before a held-out frame to
    the start of the next training exposure after it. Of it nothing is seen but the frame's camera,
    its time and, with ``held_out_poses=given``, its key pose.
    """

    use: Use = "training"
    """``everything``: all frames train, whatever their split, and nothing is held out, so that
    there are no test figures (`evsplat train --use everything`)."""
    held_out_events: bool = False
    """Events inside held-out intervals are seen as well: interpolation between frames by events,
    a task of its own."""
    thresholds: Literal["given", "estimated"] = "given"
    """``given``: the capture's contrast thresholds, where it has any. ``estimated``: none, a method
    finds them from training frames and events."""
    masks: Masks = "none"
    """``given``: the capture's masks of training frames. ``estimated``: `evsplat masks` finds them
    by what differs from the static background. ``none``: no mask is seen."""
    held_out_poses: Literal["given", "interpolated"] = "given"
    """``interpolated``: key poses inside held-out intervals are not seen either, and the person's
    pose there is interpolated from those of training frames."""

    def __post_init__(self) -> None:
        check_options(self)

    def require_held_out_events(self, setting: str) -> None:
        """A `ConfigError` where a ``setting`` that wants them is on and they are hidden."""
        if not self.held_out_events:
            raise ConfigError(
                f"{setting} is true, and policy.held_out_events is false, which hides the events "
                "that it wants; pass --set policy.held_out_events=true as well."
            )


@dataclass(frozen=True)
class Terms(Policy):
    """A policy as a recording meets it, in words: what it does not give is estimated, or missing.

    Written to metrics.json, reports and tables.
    """

    events: bool = True
    """False: it has none, so that there is nothing to say of thresholds and held-out events."""
    event_use: EventUse = "amounts"
    """Of the events, what the method takes."""
    thresholds_found: bool = True
    """False: neither given nor found from training frames, so that a usual one was taken."""

    @property
    def sees_events(self) -> bool:
        """Whether the method had any to learn from."""
        return self.events and self.event_use != "nothing"

    @property
    def departures(self) -> tuple[str, ...]:
        """Differences from `STRICT_TERMS`, in words for the title of a row."""
        intervals = "events of held-out intervals seen"
        found = "estimated" if self.thresholds_found else "unknown"
        thresholds = {
            "amounts": f"contrast thresholds {found}",
            "direction": "contrast thresholds not used",
            "nothing": "no events used",
        }[self.event_use]
        said = {
            "use": "trained on everything",
            **({"held_out_events": intervals} if self.sees_events else {}),
            **({"thresholds": thresholds} if self.events else {}),
            "masks": f"masks {self.masks}",
            "held_out_poses": "poses at test times interpolated",
        }
        strict = Policy()
        names = [name for name in said if getattr(self, name) != getattr(strict, name)]
        return tuple(said[name] for name in names)

    def sentence(self, held_out: int) -> str:
        """All of them with ``held_out`` test frames, for a reader of figures."""
        if self.use == "everything":
            events = " and every event" if self.sees_events else ""
            return f"Every frame{events} trained; nothing was held out."
        masks = {
            "given": "masks of training frames given",
            "estimated": "masks of training frames estimated",
            "none": "no masks",
        }[self.masks]
        poses = {
            "given": "poses at test times given",
            "interpolated": "poses at test times interpolated",
        }[self.held_out_poses]
        seen = [self._thresholds, masks]
        if not held_out:
            return f"No frame is a test frame, so nothing was held out; {', '.join(seen)}."
        events = ""
        if self.sees_events:
            events = (
                ", events of held-out intervals were seen"
                if self.held_out_events
                else ", no event of a held-out interval was seen"
            )
        return f"Held-out pictures were hidden from training{events}; {', '.join([*seen, poses])}."

    @property
    def _thresholds(self) -> str:
        if not self.events:
            return "the recording has no events"
        if self.event_use == "nothing":
            return "the method uses no events"
        if self.event_use == "direction":
            return "no contrast thresholds used"
        if not self.thresholds_found:
            return "contrast thresholds neither given nor found, so that a usual one was taken"
        return {
            "given": "contrast thresholds as the capture gives them",
            "estimated": "contrast thresholds estimated from training frames",
        }[self.thresholds]


STRICT_TERMS = (
    "Where a row says nothing else, training saw no picture, mask or event of a held-out interval, "
    "contrast thresholds and poses were given, and no masks."
)
"""Terms that all rows of a table share."""


def terms_of(metrics: dict[str, Any]) -> Terms | None:
    """The terms in a metrics.json or a bench record; None where it has none."""
    values = metrics.get("policy")
    try:
        return None if values is None else Terms(**values)
    except ConfigError as error:  # no option of the reader's: what a file holds
        raise ValueError(str(error)) from None
