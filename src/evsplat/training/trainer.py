"""The training loop: draw a frame, render what the objectives need, compare, step, densify."""

import logging
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from torch import Tensor

from evsplat.capture import Capture, Frame
from evsplat.errors import DataError
from evsplat.gaussians import ScreenStatistics, densify, flip_labels
from evsplat.gaussians.densify import reset_opacities
from evsplat.methods.composition import Composition
from evsplat.methods.config import weight_at
from evsplat.objectives import Step
from evsplat.render import Splats, render, split_channels
from evsplat.training.checkpoint import below, flatten, load_model
from evsplat.training.clock import Clock
from evsplat.training.optimiser import Optimiser

logger = logging.getLogger(__name__)

MAX_BAD_STEPS = 20
"""Consecutive steps with a non-finite loss or gradient after which training stops."""


@dataclass(frozen=True)
class StepReport:
    """What one step measured."""

    loss: float
    terms: dict[str, float]
    """Unweighted."""
    psnr: float
    """Of the drawn frame's render against the recorded, blurry picture, dB."""


class Trainer:
    """Order and time of a training run; all state that a resume needs is in `state`."""

    def __init__(self, composition: Composition, capture: Capture, clock: Clock) -> None:
        """Start at the beginning of the schedule."""
        self.composition, self.capture, self.clock = composition, capture, clock
        self.model = composition.model
        self.device = self.model.box_low.device
        self.optimiser = Optimiser(self.model, composition.optimisation)
        self.queue: list[int] = []
        self.bad_steps = 0
        self.skipped = 0
        self.previous_nominal = 0.0
        self.statistics = self._fresh_statistics()

    def step(self) -> StepReport | None:
        """One optimisation step; None when it was skipped because a value was not finite."""
        nominal = self.clock.nominal
        self.model.nominal.fill_(nominal)
        self.optimiser.set_progress(nominal)
        frame = self._draw_frame()
        generator = self.composition.generator
        times = sorted({t for o in self.composition.objectives for t in o.times(frame, nominal)})

        camera = self.capture.camera(frame).to(self.device)
        noise = self.model.draw_noise(len(times), generator)
        posed = self.model.at(times, camera.center(), noise=noise, share_skinning=True)
        moving, static = _with_centers(posed.moving()), _with_centers(posed.static())
        output = render(moving, camera, static=static)
        pictures = split_channels(output.image, (3, 1))
        rgb, semantic = pictures[0], tuple(picture[..., 0] for picture in pictures[1])
        step = Step(
            self.capture, self.model, frame, tuple(times), rgb, semantic, posed, nominal, generator
        )
        terms: dict[str, Tensor] = {}
        for objective in self.composition.objectives:
            terms |= objective.loss(step)
        weights = self.composition.weights
        loss = torch.stack(
            [weight_at(weights[name], nominal) * value for name, value in terms.items()]
        ).sum()

        self.optimiser.zero_grad()
        values = {name: float(value.detach()) for name, value in terms.items()}
        if not bool(loss.isfinite()):
            self._skip([name for name, value in values.items() if value != value] or ["loss"])
            return None
        loss.backward()
        if not self.optimiser.finite():
            self._skip(["gradient"])
            return None
        self.bad_steps = 0
        self.optimiser.step(nominal)
        height, width = output.alpha.shape[1:]
        gaussians = self.model.gaussians
        for rows, layer, radii in (
            (gaussians.human, moving, output.radii),
            (gaussians.scene, static, output.static_radii),
        ):
            assert layer.centers2d_offset is not None and layer.centers2d_offset.grad is not None
            self.statistics.add(rows, layer.centers2d_offset.grad, radii, width, height)
        self._edit(frame, nominal)
        drawn = rgb[step.index(frame.mid_us)].detach()
        error = (drawn.clamp(0, 1) - self.capture.image(frame).to(drawn)).square().mean()
        return StepReport(float(loss.detach()), values, float(-10 * torch.log10(error)))

    def counts(self) -> dict[str, int]:
        """Number of Gaussians per class."""
        gaussians = self.model.gaussians
        return {"human": gaussians.human_count, "scene": gaussians.scene_count}

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """All tensors and all numbers that a resume needs."""
        tensors = {f"model.{k}": v for k, v in self.model.state_dict().items()}
        tensors |= flatten("optimiser", self.optimiser.state())
        tensors |= flatten("statistics", vars(self.statistics))
        for number, objective in enumerate(self.composition.objectives):
            tensors |= flatten(f"objective{number}", objective.state())
        tensors |= flatten("skinning_turns", self.model.skinning_turns.state())
        tensors["generator"] = self.composition.generator.get_state()
        state = {
            "clock": asdict(self.clock),
            "queue": self.queue,
            "skipped": self.skipped,
            "previous_nominal": self.previous_nominal,
            "human_count": self.model.gaussians.human_count,
        }
        return tensors, state

    def load_state(self, tensors: dict[str, Tensor], state: dict[str, Any]) -> None:
        """Go back to the moment of `state`; the clock's limits stay those of this run."""
        load_model(self.model, tensors, state["human_count"])
        self.optimiser = Optimiser(self.model, self.composition.optimisation)
        self.optimiser.load_state(below("optimiser", tensors))
        self.statistics = ScreenStatistics(**below("statistics", tensors))
        for number, objective in enumerate(self.composition.objectives):
            objective.load_state(below(f"objective{number}", tensors))
        self.model.skinning_turns.load_state(below("skinning_turns", tensors))
        self.composition.generator.set_state(tensors["generator"])
        saved = state["clock"]
        for name in ("iteration", "fraction", "seconds", "step_seconds"):
            setattr(self.clock, name, saved[name])
        self.queue, self.skipped = list(state["queue"]), state["skipped"]
        self.previous_nominal = state["previous_nominal"]

    def _draw_frame(self) -> Frame:
        """The next training frame: each once in random order, then anew."""
        frames = self.capture.train_frames
        if not self.queue:
            order = torch.randperm(len(frames), generator=self.composition.generator)
            self.queue = order.tolist()
        return frames[self.queue.pop()]

    def _edit(self, frame: Frame, nominal: float) -> None:
        """Edit the set where the schedule crosses a densification step."""
        gaussians, rows = self.model.gaussians, self.optimiser.rows
        limits = self.composition.densify
        previous, self.previous_nominal = self.previous_nominal, nominal
        for part, limit in limits.items():
            if any(previous < reset <= nominal for reset in limit.opacity_reset):
                reset_opacities(gaussians, rows, gaussians.rows_of(part))
        every = limits["human"].every
        if nominal // every == previous // every:
            return
        densify(gaussians, rows, self.statistics, limits, nominal, self.composition.generator)
        if self.model.semantics != "fixed":
            drawn = self.capture.train_frames.index(frame)
            flip_labels(gaussians, rows, self.composition.body_frames, drawn)
        self.model.skinning_turns.rows_changed()
        for objective in self.composition.objectives:
            objective.rows_changed()
        self.statistics = self._fresh_statistics()

    def _fresh_statistics(self) -> ScreenStatistics:
        means = self.model.gaussians.means
        return ScreenStatistics.zeros(len(means), means.device)

    def _skip(self, culprits: list[str]) -> None:
        self.bad_steps += 1
        self.skipped += 1
        logger.warning(
            "step %d skipped: %s is not finite", self.clock.iteration, ", ".join(culprits)
        )
        if self.bad_steps >= MAX_BAD_STEPS:
            raise DataError(
                f"{self.capture.path}: {MAX_BAD_STEPS} steps in a row gave a non-finite "
                f"{culprits[0]}; the last good checkpoint is kept. Lower the weight of that term "
                "with --set, or check the poses with `evsplat inspect`."
            )


def _with_centers(layer: Splats) -> Splats:
    """Ready to tell the gradients of the projected centres."""
    shape = (*layer.means.shape[:2], 2)
    return replace(layer, centers2d_offset=layer.means.new_zeros(shape).requires_grad_())
