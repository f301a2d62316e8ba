"""Which instant is shown, as wall-clock time goes by."""

from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Playback:
    """A place in time that stands or moves, and loops."""

    start_us: float
    end_us: float
    """Playing goes on at the start when it has come here."""
    place_us: float
    """Where it stands, or stood at ``since``."""
    speed: float = 1.0
    """Recorded seconds per second; 0.01 is a hundred times slower than life."""
    since: float | None = None
    """When playing began, seconds of the wall clock; None: it stands."""

    def at(self, now: float) -> float:
        """The place at wall-clock second ``now``, microseconds."""
        if self.since is None:
            return self.place_us
        gone = (now - self.since) * self.speed * 1e6
        length = self.end_us - self.start_us
        if length <= 0:
            return self.start_us
        return self.start_us + (self.place_us - self.start_us + gone) % length

    def playing(self, on: bool, now: float) -> "Playback":
        """Begin to play, or stand where it is."""
        return replace(self, place_us=self.at(now), since=now if on else None)

    def moved(self, place_us: float, now: float) -> "Playback":
        """Go to a place; a loop that does not hold it is left to `within`."""
        return replace(self, place_us=place_us, since=None if self.since is None else now)

    def at_speed(self, speed: float, now: float) -> "Playback":
        """Go on from the same place at another speed."""
        return replace(self.moved(self.at(now), now), speed=speed)

    def within(self, start_us: float, end_us: float, now: float) -> "Playback":
        """Loop between other ends; a place outside of them goes to the nearer one."""
        place = min(max(self.at(now), start_us), end_us)
        return replace(self.moved(place, now), start_us=start_us, end_us=end_us)
