"""When the rest of a schedule is worth its steps: told by means of the pictures' loss alone."""

import io
import logging
import shutil
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from evsplat.training import load_run, loop, train
from evsplat.training.checkpoint import latest_checkpoint, load_checkpoint
from evsplat.training.clock import Clock
from evsplat.training.outlook import FIRST, PARTS, REST, SETTLED, SPAN, Outlook
from evsplat.training.trainer import Trainer

from ..conftest import write_tiny_capture
from ..small_model import few_descent_steps, small

STEPS = 2 * PARTS
"""Of a whole training."""
WEIGHTS = {"l1": 2.0, "dssim": ((0.0, 1.0), (7_500.0, 3.0))}


class Killed(Exception):
    """What ends a process here."""


@dataclass(frozen=True)
class Ended:
    """A training that was asked for no number of steps, which no test changes."""

    capture: Path
    settings: tuple[str, ...]
    out: Path
    said: str


@pytest.fixture(scope="module")
def ended(tmp_path_factory: pytest.TempPathFactory) -> Ended:
    place, said = tmp_path_factory.mktemp("ended"), io.StringIO()
    capture, settings = write_tiny_capture(place / "tiny"), small("evsplat", f"iterations={STEPS}")
    logger, handler = logging.getLogger("evsplat"), logging.StreamHandler(said)
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        out = train(capture, out=place / "run", overrides=settings)
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)
    return Ended(capture, settings, out, said.getvalue())


def told(losses: list[float], *, weights=WEIGHTS, resumed_at: int | None = None) -> dict:
    """What an outlook says after each part of a schedule of ten steps a part."""
    outlook, steps, said = Outlook(weights), 10 * PARTS, {}
    for step in range(steps):
        if step == resumed_at:
            state, outlook = outlook.state(), Outlook(weights)
            outlook.load_state(state)
        loss = torch.tensor(losses[step * len(losses) // steps])
        outlook.note(step / steps, {"l1": loss, "dssim": loss, "other": torch.tensor(7.0)})
        fall = outlook.fall(step / steps, (step + 1) / steps)
        if fall is not None:
            said[step + 1] = fall
    return said


def test_the_fall_is_that_of_weighted_means_over_parts():
    halves = [0.4 * 0.9**part for part in range(PARTS)]
    said = told(halves, weights={"l1": 2.0})
    assert list(said) == [10 * part for part in range(FIRST, PARTS)]
    assert list(said.values()) == pytest.approx([1 - 0.9**SPAN] * len(said), rel=1e-6)


def test_a_weight_that_changes_counts_from_where_it_does():
    said = told([0.4] * PARTS)
    # 3 a step before the middle of the schedule, 5 behind it
    assert said[10 * FIRST] == pytest.approx(0.0)
    assert said[10 * (FIRST + SPAN)] == pytest.approx(1 - 5 / 3)


def test_a_resumed_outlook_says_the_same_to_the_last_bit():
    losses = torch.rand(10 * PARTS, generator=torch.Generator().manual_seed(0)).tolist()
    assert told(losses, resumed_at=137) == told(losses)


def test_steps_without_a_finite_loss_do_not_count():
    losses = [0.4] * (10 * PARTS)
    losses[93] = float("nan")
    assert all(fall == pytest.approx(0.0) for fall in told(losses, weights={"l1": 1.0}).values())


def test_a_method_that_names_no_terms_is_never_told_anything():
    assert told([0.4] * PARTS, weights={}) == {}


def test_a_run_without_a_number_of_steps_ends_earlier_and_says_so(ended, tmp_path):
    capture, settings = ended.capture, ended.settings
    _, state = load_checkpoint(latest_checkpoint(ended.out / "checkpoints"))
    clock = state["clock"]
    assert clock["fraction"] == 1.0 and clock["ends_at"] == clock["iteration"] < STEPS
    assert "of the schedule: what is left of it ends with step" in ended.said
    assert "whose end was brought forward" in ended.said
    again = shutil.copytree(ended.out, tmp_path / "again")
    train(capture, out=again, resume=True)
    assert load_run(again).iteration == clock["iteration"]
    # Adding shares of what is left may take one step more within minutes.
    small_model = small("evsplat")
    steps = train(capture, out=tmp_path / "steps", overrides=small_model, iterations=STEPS)
    minutes = train(capture, out=tmp_path / "minutes", overrides=settings, max_minutes=30.0)
    assert load_run(steps).iteration == STEPS and load_run(minutes).iteration in {STEPS, STEPS + 1}


def test_a_run_on_poses_that_err_makes_all_its_steps(tiny_capture, tmp_path, monkeypatch):
    few_descent_steps(monkeypatch)
    settings = small("evsplat", f"iterations={STEPS}", "pose.refine=always")
    out = train(tiny_capture(frames=10), out=tmp_path / "run", overrides=settings)
    assert load_run(out).iteration == STEPS


def test_a_run_killed_behind_its_turn_ends_as_one_that_was_not(ended, tmp_path, monkeypatch):
    step, usual = Trainer.step, loop.CHECKPOINT_SECONDS
    turn = load_run(ended.out).iteration - round(STEPS * REST)
    for kill_at in (turn - 1, turn + 3):

        def killed(self: Trainer, kill_at: int = kill_at):
            if self.clock.iteration == kill_at:
                raise Killed
            if self.clock.iteration == kill_at - 1:  # saved behind the last step, not behind each
                monkeypatch.setattr(loop, "CHECKPOINT_SECONDS", 0.0)
            return step(self)

        out = tmp_path / f"killed{kill_at}"
        monkeypatch.setattr(Trainer, "step", killed)
        with pytest.raises(Killed):
            train(ended.capture, out=out, overrides=ended.settings)
        monkeypatch.setattr(Trainer, "step", step)
        monkeypatch.setattr(loop, "CHECKPOINT_SECONDS", usual)
        assert int(latest_checkpoint(out / "checkpoints").stem) == kill_at
        train(ended.capture, out=out, resume=True)
        ends = [load_checkpoint(latest_checkpoint(run / "checkpoints")) for run in (ended.out, out)]
        (expected, state), (found, again) = ends
        assert again["clock"]["ends_at"] == state["clock"]["ends_at"] == state["clock"]["iteration"]
        assert [name for name in expected if not torch.equal(expected[name], found[name])] == []


@pytest.mark.parametrize(
    ("fall", "ends"),
    [(None, False), (1.2 * SETTLED, False), (SETTLED, False), (0.8 * SETTLED, True), (-1.0, True)],
)
@pytest.mark.parametrize("may", [True, False])
def test_the_end_is_brought_forward_where_the_loss_falls_by_little_alone(fall, ends, may):
    clock = Clock(200, may_end_early=may, iteration=99, fraction=99 / 200)
    outlook = SimpleNamespace(fall=lambda before, after: fall)
    trainer = SimpleNamespace(clock=clock, outlook=outlook)
    Trainer.advance(trainer, None, 0.1)
    assert clock.iteration == 100
    assert clock.ends_at == (100 + round(REST * 200) if ends and may else 0)
