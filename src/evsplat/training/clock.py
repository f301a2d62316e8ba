"""Place of a training run in its schedule, by steps or by the time it was given."""

from dataclasses import dataclass

from evsplat.methods.settings import NOMINAL_ITERATIONS

SMOOTHING = 0.1
"""Weight of the newest step in the running mean of the step time."""


@dataclass
class Clock:
    """Progress of one run, 0 at the start and 1 at the end of every schedule.

    With a step count alone each step advances by ``1 / iterations``. With a time limit as well,
    steps advance faster when the measured step time says that the schedule would not be finished
    in time: a run that is given ten minutes goes through its whole schedule in ten minutes instead
    of stopping in the middle of it with high learning rates.
    """

    iterations: int
    max_seconds: float | None = None
    shrink: bool = False
    """Whether the schedule may be shortened to fit the time limit."""
    may_end_early: bool = False
    """Whether `end_in` may be asked for; part of the state, as a run that goes on ends likewise."""
    ends_at: int = 0
    """Step at which the schedule ends where its end was brought forward, otherwise 0."""
    iteration: int = 0
    fraction: float = 0.0
    seconds: float = 0.0
    """Time spent in training, over all resumes, the fits before the first step among it."""
    step_seconds: float = 0.0

    @property
    def nominal(self) -> float:
        """Progress in nominal iterations."""
        return self.fraction * NOMINAL_ITERATIONS

    @property
    def done(self) -> bool:
        """Whether the schedule is finished."""
        return self.fraction >= 1.0

    @property
    def out_of_time(self) -> bool:
        """Whether the time limit is reached."""
        return self.max_seconds is not None and self.seconds >= self.max_seconds

    @property
    def expected_iterations(self) -> int:
        """Steps at the end of the schedule, as things stand."""
        return max(self.iteration, round(self.iteration + self._steps_left()))

    @property
    def seconds_left(self) -> float:
        """Expected time to the end."""
        return self._steps_left() * self.step_seconds

    def advance(self, step_seconds: float) -> None:
        """Count one finished step that took ``step_seconds``."""
        first = self.step_seconds == 0.0
        share = 1.0 if first else SMOOTHING
        self.step_seconds += share * (step_seconds - self.step_seconds)
        self.seconds += step_seconds
        left = self._steps_left()
        # Steps of a time limit that holds no more went ahead: what they left is passed evenly.
        ahead = self.fraction > self.iteration / self.iterations
        self.iteration += 1
        if self.shrink or self.ends_at or ahead:
            self.fraction += (1 - self.fraction) / max(left, 1.0)
        else:
            # From the integer, so that a thousand additions leave no rounding behind.
            self.fraction = min(1.0, self.iteration / self.iterations)

    def end_in(self, steps: int) -> bool:
        """Pass what is left of the schedule in so many steps; false where that is no fewer."""
        if steps >= self._steps_left():
            return False
        self.ends_at = self.iteration + steps
        return True

    def go_by(self, iterations: int) -> None:
        """Stand where a schedule of so many steps is after those made, finished as this may be."""
        self.iterations, self.ends_at, self.may_end_early = iterations, 0, False
        self.fraction = min(1.0, self.iteration / iterations)

    def _steps_left(self) -> float:
        left = (1 - self.fraction) * self.iterations
        if self.ends_at:
            left = float(max(self.ends_at - self.iteration, 0))
        if self.shrink and self.max_seconds is not None and self.step_seconds > 0:
            left = min(left, max(self.max_seconds - self.seconds, 0.0) / self.step_seconds)
        return left
