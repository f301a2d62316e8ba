"""The verb ``train``: a run folder from a capture, with progress, checkpoints and resume."""

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch import Tensor

from evsplat.capture import Capture, TrainingCapture, load_capture, shared_pairs
from evsplat.commands import command
from evsplat.config import load_yaml, override
from evsplat.config_docs import save_yaml
from evsplat.devices import use_threads
from evsplat.errors import ConfigError, DataError, machine_error
from evsplat.files import try_target
from evsplat.inspection import (
    Belonging,
    check_body,
    save_fit_sheet,
    warn_of_events,
    warn_of_pictures,
)
from evsplat.methods import (
    DEFAULT_METHOD,
    TRAINABLE,
    MethodConfig,
    Purpose,
    event_use,
    method_config,
)
from evsplat.methods.base import Composition
from evsplat.methods.settings import Weight
from evsplat.options import TrainOptions
from evsplat.options.declare import given
from evsplat.render import choose_device
from evsplat.training.checkpoint import (
    KEEP,
    RESUMED,
    check_fits,
    kept_sentence,
    load_latest,
    misfits_of,
)
from evsplat.training.clock import Clock
from evsplat.training.loop import run_steps
from evsplat.training.run import (
    RunFolder,
    check_capture,
    keep_place,
    new_run_folder,
    read_config,
    seen_by_training,
    write_facts,
)
from evsplat.training.sound import check_events_reach
from evsplat.training.trainer import Trainer
from evsplat.training.watching import is_unused
from evsplat.training_sign import training_in
from evsplat.untrusted.records import misfit

logger = logging.getLogger(__name__)

_LEAST_BYTES = 1 << 20
"""A checkpoint of the smallest model, more or less; how large one is comes out after the start."""
_KEPT_AND_NEW = KEEP + 1
_WITH_OPTIMISER = 3
"""Of a checkpoint and its parameters, which have two moments each."""


@dataclass(frozen=True)
class _Start:
    """Beginning of a training: its run folder and all that follows from it."""

    folder: RunFolder
    method: str
    settings: MethodConfig
    seed: int
    facts: dict[str, Any] = field(default_factory=dict)
    """Of a run that goes on, what versions.json says."""


def train(
    capture_path: Path | str,
    options: TrainOptions | None = None,
    *,
    on_start: Callable[[Path], None] | None = None,
    **changes: Any,
) -> Path:
    """Train a method on a capture and return the run folder.

    ``changes`` are fields of `TrainOptions`: ``train("my_capture", max_minutes=10)``. Without
    ``iterations`` the schedule is shortened to be finished within ``max_minutes``, and without
    either where the loss of the pictures says that little more is to come (method `evsplat`, poses
    that are exact). The cheap fits before the first step count as training. ``use="everything"``
    is short for the setting ``policy.use=everything``. ``on_start`` is called with the run folder
    before the first step.

    Raises:
        Stopped: Ctrl-C; the step is finished and saved.
        ConfigError: An option or a setting is unknown or out of range, or ``out`` is not empty.
        DataError: The capture, or the run to go on with, is not what it should be; or the body is
            that of another recording, and ``any_body`` is not set.
    """
    options = given(TrainOptions, options, changes)
    device = choose_device(options.device)
    use_threads(options.threads)
    capture = load_capture(Path(capture_path))
    start = _resumed(capture, options) if options.resume else _new(capture, options)
    folder = start.folder
    try_target(folder.path, _KEPT_AND_NEW * _LEAST_BYTES)
    with training_in(folder.path), _faults_said(folder):
        if not options.resume and not is_unused(folder.path):
            raise ConfigError(
                f"{folder.path}: the folder is not empty; pass --resume to go on with that run, or "
                "another --out."
            )
        trainer = _trainer(capture, start, options, device)
        if on_start is not None:
            on_start(folder.path)
        run_steps(trainer, folder)
    logger.info("%s", _ended(trainer.clock, capture.path, folder.path))
    return folder.path


def _trainer(capture: Capture, start: _Start, options: TrainOptions, device: str) -> Trainer:
    """All that steps need, at its beginning or where the last checkpoint was; the run's files."""
    iterations, max_minutes = options.iterations, options.max_minutes
    started = time.perf_counter()
    folder = start.folder
    seen = seen_by_training(capture, start.settings)
    check_capture(start.facts, seen, folder, start.method)
    loaded = load_latest(folder.checkpoints) if options.resume else None
    purpose: Purpose = "train" if loaded is None else "resume"
    composition, fitting = _composed(seen, start, device, purpose, any_body=options.any_body)
    clock = Clock(
        iterations or start.settings.iterations,
        None if max_minutes is None else 60 * max_minutes,
        shrink=max_minutes is not None and iterations is None,
        may_end_early=iterations is None and max_minutes is None and bool(composition.watched),
        seconds=time.perf_counter() - started,
    )
    cache_gb = options.device_memory_gb
    cache_bytes = None if cache_gb is None else int(1e9 * cache_gb)
    trainer = Trainer(composition, composition.capture or seen, clock, cache_bytes=cache_bytes)
    if loaded is not None:
        _put_back(trainer, *loaded)
        if iterations is not None:
            clock.go_by(iterations)
        elif max_minutes is None:
            clock.iterations = loaded[2]["clock"]["iterations"]
    folder.truncate_log(clock.iteration)
    state_bytes = sum(value.nbytes for value in trainer.model.state_dict().values())
    try_target(folder.path, _KEPT_AND_NEW * _WITH_OPTIMISER * state_bytes)
    if options.resume:
        keep_place(folder, start.facts, seen)
    if loaded is None:
        found = composition.thresholds_found
        if not options.resume:
            settings = start.settings
            write_facts(
                folder, seen, start.method, settings, device, start.seed, thresholds_found=found
            )
            # The last of what resuming needs.
            save_yaml(folder.config, settings, method=start.method)
        if fitting is not None and fitting.is_odd:
            logger.warning("body over what moves: %s", save_fit_sheet(seen, fitting, folder.path))
        logger.debug("%s", schedule_table(start.settings, composition.weights))
        terms = seen.terms(event_use(start.settings), thresholds_found=found)
        logger.info("%s", terms.sentence(len(seen.held_out_frames)))
    return trainer


def _composed(
    seen: TrainingCapture, start: _Start, device: str, purpose: Purpose, *, any_body: bool
) -> tuple[Composition, Belonging | None]:
    """The method put together; before a training the capture is looked over, and its body judged.

    Raises:
        DataError: the body is that of another recording, and ``any_body`` is not set.
    """
    fitting, uses = None, event_use(start.settings)
    if purpose == "train":
        warn_of_pictures(seen)
    if purpose == "train" and seen.has_body:
        fitting = check_body(seen, refuse=not any_body)
    # The check of the events and the estimate of their sensor compare the same frames.
    with shared_pairs(seen):
        if purpose == "train" and uses != "nothing":
            check_events_reach(seen)
            warn_of_events(seen, thresholds=uses == "amounts")
        composition = TRAINABLE[start.method].build(
            start.settings, seen, start.seed, device=device, purpose=purpose
        )
    return composition, fitting


def _put_back(
    trainer: Trainer, checkpoint: Path, tensors: dict[str, Tensor], state: dict[str, Any]
) -> None:
    """Let a trainer go on where it was when the checkpoint was written."""
    check_fits(trainer.model, tensors, checkpoint)
    wrong = misfit(state, RESUMED, "state")
    if wrong:
        raise DataError(f"{checkpoint}: {wrong}; train again, without --resume.")
    with misfits_of(checkpoint):
        trainer.load_state(tensors, state)


@contextmanager
def _faults_said(folder: RunFolder) -> Iterator[None]:
    """Failures of memory, disk or system say what is kept of the run."""
    try:
        yield
    except Exception as error:
        fault = machine_error(error, kept_sentence(folder.checkpoints), folder.path)
        if fault is None:
            raise
        raise fault from error


def _resumed(capture: Capture, options: TrainOptions) -> _Start:
    """The run of ``options.out``, with its own settings."""
    assert options.out is not None
    folder = RunFolder(Path(options.out))
    method, settings, facts = read_config(folder)
    if facts["capture_name"] != capture.name:
        raise ConfigError(
            f"{folder.path}: was trained on the capture {facts['capture_name']!r}, and is to go on "
            f"with {capture.name!r}; give the one of {facts['capture']}, or another --out."
        )
    return _Start(folder, method, settings, facts["seed"], facts)


def _new(capture: Capture, options: TrainOptions) -> _Start:
    """A new run with the settings that are asked for."""
    config = options.config
    values = {} if config is None else load_yaml(config)
    named = values.pop("method", None)
    method = options.method or named or DEFAULT_METHOD
    out = options.out
    folder = new_run_folder(capture, method) if out is None else RunFolder(Path(out))
    values = override(values, options.overrides)
    if options.use is not None:
        policy = values.setdefault("policy", {})
        if isinstance(policy, dict):  # else it is refused below
            policy["use"] = options.use
    where = "--set" if config is None else str(config)
    settings = method_config(method, values, where=where)
    return _Start(folder, method, settings, options.seed or 0)


def schedule_table(settings: MethodConfig, weights: dict[str, Weight]) -> str:
    """Every weight over nominal iterations, one line each."""
    lines = [f"schedule of {settings.iterations} iterations (nominal units):"]
    for name, weight in weights.items():
        if isinstance(weight, tuple):
            text = ", ".join(f"{value:g} from {start:g}" for start, value in weight)
        else:
            text = f"{weight:g}"
        lines.append(f"  {name:22s} {text}")
    return "\n".join(lines)


def _ended(clock: Clock, capture: Path, run: Path) -> str:
    """After how many steps a training ended, why there, and how it goes on."""
    why = "its schedule is finished" if clock.done else "the time that it was given is over"
    if clock.done and clock.ends_at:
        why += ", whose end was brought forward since little more was to come"
    more = "--resume", "--iterations", str(2 * clock.iteration)
    longer = command("train", capture, "--out", run, *more)
    return f"training ended after {clock.iteration:,} steps: {why}. To go on: {longer}"
