"""A training step: draw a frame, render what the objectives need, compare, step, densify."""

import logging
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.capture import Camera, Frame, TrainingCapture
from evsplat.compiled import keep_freed_memory
from evsplat.devices import DeviceCache, default_cache_bytes, send
from evsplat.gaussians import GaussianSet, Part, Rows, ScreenStatistics, densify, flip_labels
from evsplat.gaussians.depth_order import depths_kept
from evsplat.methods.base import Composition
from evsplat.methods.settings import weight_at
from evsplat.models.drawing import Drawing
from evsplat.models.seen import seen_by
from evsplat.objectives import Objective, Step
from evsplat.training.bad_steps import BadSteps
from evsplat.training.checkpoint import (
    ENDING,
    below,
    check_progress,
    counts,
    flatten,
    load_model,
    require_finite,
    require_shape,
)
from evsplat.training.clock import Clock
from evsplat.training.optimiser import Optimiser
from evsplat.training.outlook import REST, SETTLED, Outlook

logger = logging.getLogger(__name__)

PARTS: tuple[Part, Part] = ("human", "scene")
"""In the order of a drawing's layers."""


@dataclass(frozen=True)
class StepReport:
    """Measures of one step. Reading a number waits for the device that computes it."""

    losses: tuple[Float[Tensor, ""], ...]
    """What was minimised, and its terms, unweighted."""
    names: tuple[str, ...]
    """Of the terms."""
    drawn: Float[Tensor, "H W 3"]
    recorded: Float[Tensor, "H W 3"]
    """The drawn frame's render and its blurry picture, compared only if somebody asks."""

    @cached_property
    def measured(self) -> Float[Tensor, " K"]:
        """Loss, PSNR and the terms."""
        error = (self.drawn.clamp(0, 1) - self.recorded).square().mean()
        loss, *terms = self.losses
        return torch.stack([loss, -10 * torch.log10(error), *terms])

    @cached_property
    def _numbers(self) -> list[float]:
        return self.measured.tolist()

    @property
    def loss(self) -> float:
        """Value that was minimised."""
        return self._numbers[0]

    @property
    def psnr(self) -> float:
        """PSNR of the drawn frame's render against the recorded, blurry picture, dB."""
        return self._numbers[1]

    @property
    def terms(self) -> dict[str, float]:
        """Terms of the loss, unweighted."""
        return dict(zip(self.names, self._numbers[2:], strict=True))


class Trainer:
    """Order and time of a training run; all state that a resume needs is in `state`."""

    def __init__(
        self,
        composition: Composition,
        capture: TrainingCapture,
        clock: Clock,
        *,
        cache_bytes: int | None = None,
    ) -> None:
        """Start at the beginning of the schedule.

        ``cache_bytes`` bounds the recorded data kept on a GPU; None: a quarter of what is free.
        """
        keep_freed_memory()
        self.composition, self.capture, self.clock = composition, capture, clock
        self.model = composition.model
        self.device = self.model.device
        self.optimiser = Optimiser(self.model, composition.learning)
        self.data = DeviceCache(
            self.device, default_cache_bytes(self.device) if cache_bytes is None else cache_bytes
        )
        recording = composition.recording
        self._recording = None if recording is None else recording.to(self.device)
        self._sent: dict[str, tuple[Camera, Camera]] = {}
        self.queue: list[int] = []
        self.outlook = Outlook({name: composition.weights[name] for name in composition.watched})
        self.bad = BadSteps(self.device, str(capture.path))
        self.previous_nominal = 0.0
        self.statistics = {name: _fresh(rows) for name, rows in self.model.sets.items()}

    def step(self) -> StepReport | None:
        """One optimisation step; None when it was skipped because a value was not finite."""
        nominal = self.clock.nominal
        self.model.nominal.fill_(nominal)
        self.optimiser.set_progress(nominal)
        frame = self._draw_frame()
        step = self._drawn(frame, self.composition.objectives, nominal)
        terms: dict[str, Tensor] = {}
        for objective in self.composition.objectives:
            terms |= objective.loss(step)
        loss = self._weighted(terms, nominal)

        self.optimiser.zero_grad()
        iteration = self.clock.iteration
        if self.bad.refuse(loss.isfinite, lambda: _not_numbers(terms) or ["loss"], iteration):
            return None
        loss.backward()
        sound = self.optimiser.finite(loss.detach())
        if self.bad.refuse(lambda: sound, lambda: ["gradient"], iteration):
            return None
        # None where the host knows that the step is sound; else a GPU will know it.
        unsound = self.bad.count(sound)
        with depths_kept(self.model.sets.values(), self._recording):
            self.optimiser.step(nominal, unsound)
        self._count(step.drawing, nominal, None if unsound is None else sound)
        self._edit(nominal)
        self._learn_held_out(nominal)
        drawn = step.drawing.rgb[step.index(frame.mid_us)].detach()
        losses = tuple(number.detach() for number in (loss, *terms.values()))
        return StepReport(losses, tuple(terms), drawn, step.observed(frame))

    def advance(self, report: StepReport | None, step_seconds: float) -> None:
        """Count a step; bring the end of the schedule forward where little more is to come."""
        clock, before = self.clock, self.clock.fraction
        if report is not None and clock.may_end_early:
            self.outlook.note(before, dict(zip(report.names, report.losses[1:], strict=True)))
        clock.advance(step_seconds)
        if not clock.may_end_early or clock.ends_at:
            return
        fall = self.outlook.fall(before, clock.fraction)
        if fall is None or fall >= SETTLED:
            return
        planned = clock.expected_iterations
        if clock.end_in(round(REST * clock.iterations)):
            logger.info(
                "the pictures' loss fell by %.0f %% in the last tenth of the schedule: what is "
                "left of it ends with step %d, not %d (--iterations %d makes them all)",
                100 * fall, clock.ends_at, planned, clock.iterations,
            )  # fmt: skip

    def _drawn(self, frame: Frame, objectives: Sequence[Objective], nominal: float) -> Step:
        """Pictures of a frame at all times that objectives ask for."""
        times = sorted({t for o in objectives for t in o.times(frame, nominal)})
        cameras = self._cameras(frame, times)
        generator = self.composition.generator
        drawing = self.model.training_drawing(times, frame, cameras, generator)
        return Step(
            self.capture,
            self.model,
            frame,
            tuple(times),
            drawing,
            nominal,
            generator,
            self.data,
        )

    def _cameras(self, frame: Frame, times_us: Sequence[int]) -> list[Camera]:
        """On the device, at each time; the same object at every visit of a camera at rest."""
        cameras = self.capture.cameras_at(frame.camera, times_us)
        first = cameras[0]
        if frame.camera not in self._sent or self._sent[frame.camera][0] is not first:
            self._sent[frame.camera] = first, first.to(self.device)
        sent = self._sent[frame.camera][1]
        return [sent if camera is first else camera.to(self.device) for camera in cameras]

    def _weighted(self, terms: dict[str, Tensor], nominal: float) -> Tensor:
        values = torch.stack(list(terms.values()))
        weights = [weight_at(self.composition.weights[name], nominal) for name in terms]
        return values.dot(send(values.new_tensor(weights, device="cpu"), values.device))

    def _learn_held_out(self, nominal: float) -> None:
        """Now and then a step of what frames teach whose pictures stay unseen."""
        held_out = self.composition.held_out
        if held_out is None or nominal < held_out.start:
            return
        if self.clock.iteration % held_out.every:
            return
        drawn = torch.randint(len(held_out.frames), (), generator=self.composition.generator)
        step = self._drawn(held_out.frames[int(drawn)], [held_out.objective], nominal)
        terms = held_out.objective.loss(step)
        if terms:
            loss = self._weighted(terms, nominal)
            gradients = torch.autograd.grad(loss, held_out.parameters, allow_unused=True)
            self.optimiser.step_only(held_out.parameters, gradients)

    def counts(self) -> dict[str, int]:
        """Number of Gaussians per class."""
        return counts(self.model)

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """All tensors and all numbers that a resume needs."""
        tensors, state = self.snapshot()
        tensors |= flatten("optimiser", self.optimiser.state())
        for name, statistics in self.statistics.items():
            tensors |= flatten(f"statistics.{name}", vars(statistics))
        for number, objective in enumerate(self.composition.objectives):
            tensors |= flatten(f"objective{number}", objective.state())
        for name, cache in self.model.row_caches.items():
            tensors |= flatten(name, cache.state())
        tensors["generator"] = self.composition.generator.get_state()
        tensors["outlook"] = self.outlook.state()
        state |= {
            "queue": self.queue,
            "skipped": self.bad.settle(),
            "previous_nominal": self.previous_nominal,
        }
        return tensors, state

    def snapshot(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Part of `state` that is needed to draw the model."""
        tensors = {f"model.{k}": v for k, v in self.model.state_dict().items()}
        return tensors, {"clock": asdict(self.clock), "human_count": self.counts()["human"]}

    def ending(self) -> dict[str, Tensor]:
        """What the end of training adds to `state`: what was seen, and what a prior then decides.

        The second replaces parameters where the model is drawn, and the third the scene where it
        is seen from elsewhere. Those that were learned stay as they are, for a training that goes
        on.
        """
        seen = seen_by(self.model, self.capture)
        tensors = flatten("seen", vars(seen))
        if self.composition.fill is not None:
            filled, solid = self.composition.fill(seen)
            tensors |= flatten("filled", filled)
            if solid is not None:
                tensors |= flatten("solid", vars(solid))
        return tensors

    def load_state(self, tensors: dict[str, Tensor], state: dict[str, Any]) -> None:
        """Go back to the moment of `state`; the clock's limits stay those of this run.

        Raises:
            ValueError: The state is not that of this model and its frames.
        """
        check_progress(state, len(self.capture.train_frames))
        require_finite(tensors)
        load_model(self.model, tensors, state["human_count"])
        self.optimiser = Optimiser(self.model, self.composition.learning)
        self.optimiser.load_state(below("optimiser", tensors))
        for name, rows in self.model.sets.items():
            statistics = below(f"statistics.{name}", tensors)
            for key, value in statistics.items():
                require_shape(f"statistics.{name}.{key}", value, (len(rows.means),))
            self.statistics[name] = ScreenStatistics(**statistics).to(self.device)
        for number, objective in enumerate(self.composition.objectives):
            objective.load_state(below(f"objective{number}", tensors))
        for name, cache in self.model.row_caches.items():
            cache.load_state(below(name, tensors))
        self.composition.generator.set_state(tensors["generator"])
        saved = state["clock"]
        self.outlook.load_state(tensors["outlook"])
        for name in ("iteration", "fraction", "seconds", "step_seconds", *ENDING):
            setattr(self.clock, name, saved[name])
        self.queue = list(state["queue"])
        self.bad.skipped = state["skipped"]
        self.previous_nominal = state["previous_nominal"]

    def _draw_frame(self) -> Frame:
        """The next training frame: each once in random order, then anew."""
        frames = self.capture.train_frames
        if not self.queue:
            order = torch.randperm(len(frames), generator=self.composition.generator)
            self.queue = order.tolist()
        frame = frames[self.queue.pop()]
        for objective in self.composition.objectives if self.queue else ():
            objective.prefetch(frames[self.queue[-1]], self.clock.nominal, self.data)
        return frame

    def _count(self, drawing: Drawing, nominal: float, if_sound: Tensor | None) -> None:
        """Add the step to the statistics of those that will be densified yet.

        Nothing where ``if_sound`` is false.
        """
        limits = self.composition.densify
        height, width = drawing.output.alpha.shape[1:]
        gradients = drawing.center_gradients()
        radii = drawing.radii()
        for name, rows in self.model.sets.items():
            for part, gradient, radius in zip(PARTS, gradients, radii, strict=True):
                place = rows.rows_of(part)
                if place.start == place.stop or part not in limits or nominal >= limits[part].end:
                    continue
                if if_sound is not None:
                    radius = radius.masked_fill(~if_sound, 0)  # nothing is drawn
                self.statistics[name].add(place, gradient, radius, width, height)

    def _edit(self, nominal: float) -> None:
        """Edit the sets where the schedule crosses a densification step."""
        generator, edited = self.composition.generator, False
        previous, self.previous_nominal = self.previous_nominal, nominal
        for name, rows in self.model.sets.items():
            optimiser = self.optimiser.rows[name]
            limits = {
                part: limit for part, limit in self.composition.densify.items() if rows.holds(part)
            }
            every = next((limit.every for limit in limits.values()), math.inf)
            if nominal // every == previous // every:
                continue
            if not edited:
                self.bad.settle()
            edited = True
            densify(rows, optimiser, self.statistics[name], limits, nominal, generator)
            if self.composition.body_frames is not None:
                assert isinstance(rows, GaussianSet)  # only there classes share a set
                flip_labels(rows, optimiser, self.composition.body_frames)
            self.statistics[name] = _fresh(rows)
        if edited:
            for keeper in (*self.model.row_caches.values(), *self.composition.objectives):
                keeper.rows_changed()


def _fresh(rows: Rows) -> ScreenStatistics:
    return ScreenStatistics.zeros(len(rows), rows.means.device)


def _not_numbers(terms: dict[str, Tensor]) -> list[str]:
    return [name for name, value in terms.items() if bool(value.isnan())]
