"""The run folder: configuration, versions, log, checkpoints; and a trained run read back."""

import hashlib
import json
import os
import platform
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch

from evsplat.body import nearest_axis
from evsplat.camera import spread_over
from evsplat.capture import Camera, Capture, TrainingCapture, load_capture
from evsplat.capture.masked import MaskedCapture
from evsplat.capture.policy import Terms
from evsplat.commands import command
from evsplat.config import load_yaml, to_dict
from evsplat.devices import hardware
from evsplat.errors import ConfigError, DataError
from evsplat.files import write_json, write_text
from evsplat.masks import MASKERS
from evsplat.methods import DEFAULT_METHOD, TRAINABLE, MethodConfig, event_use, method_config
from evsplat.models.beyond import Beyond
from evsplat.models.kept import Kept
from evsplat.models.model import Model
from evsplat.models.seen import roughness
from evsplat.options.inputs import check_run_folder
from evsplat.render import Backdrop, choose_device
from evsplat.training.checkpoint import (
    check_fits,
    counts,
    load_checkpoint,
    load_latest,
    misfits_of,
)
from evsplat.training.reconstruction import GaussianReconstruction
from evsplat.training.shown import load_shown
from evsplat.untrusted.faults import brief
from evsplat.untrusted.records import read_record
from evsplat.untrusted.text import parse_json, read_text

PACKAGES = ("numpy", "scipy", "h5py", "pillow", "safetensors")

_FACTS = {"capture": str, "capture_name": str, "device": str, "seed": int}
"""What versions.json must hold."""


class RunFolder:
    """Paths of the parts of a run."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.config = path / "config.yaml"
        """Method and its full configuration, YAML."""
        self.facts = path / "versions.json"
        """Capture, versions, device and threads, JSON."""
        self.log = path / "log.jsonl"
        """One JSON object per logged step."""
        self.checkpoints = path / "checkpoints"
        """Folder of checkpoints."""

    def truncate_log(self, iteration: int) -> None:
        """Drop log lines after ``iteration``, which a resumed run is going to write again."""
        if not self.log.exists():
            return
        kept = []
        for line in read_text(self.log).splitlines():
            try:
                if parse_json(line)["iteration"] <= iteration:
                    kept.append(line)
            except (ValueError, KeyError, TypeError):
                continue  # the last line of a killed process may be half written
        write_text(self.log, "".join(line + "\n" for line in kept))


def new_run_folder(capture: Capture, method: str) -> RunFolder:
    """``runs/<capture>/<method>/<time>`` below the working directory."""
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    return RunFolder(Path("runs") / capture.name / method / stamp)


def write_facts(
    folder: RunFolder,
    seen: TrainingCapture,
    method: str,
    config: MethodConfig,
    device: str,
    seed: int,
    *,
    thresholds_found: bool,
) -> None:
    """Record what the run was made with; ``seen`` is what its training is given.

    ``thresholds_found`` is as of `Composition`.
    """
    write_json(
        folder.facts,
        {
            "capture": _place_of(seen),
            "capture_name": seen.name,
            "training_frames": _frames_of(seen),
            "up": _up_of(seen),
            **_drawn_by(seen),
            "thresholds_found": thresholds_found,
            "method": method,
            "settings": _settings_of({"method": method, **to_dict(config)}),
            "device": device,
            "threads": torch.get_num_threads(),
            **hardware(),
            "seed": seed,
            "python": platform.python_version(),
            "machine": platform.machine(),
            "packages": {
                # With the build, +cpu or a CUDA's, which an installation need not name.
                "torch": torch.__version__,
                **{package: _version_of(package) for package in ("evsplat", *PACKAGES)},
            },
        },
    )


def keep_place(folder: RunFolder, facts: dict[str, Any], seen: TrainingCapture) -> None:
    """Record where the capture is that a run goes on with: it is drawn from there as well."""
    if facts["capture"] != _place_of(seen):
        write_json(folder.facts, {**facts, "capture": _place_of(seen)})


def _place_of(seen: TrainingCapture) -> str:
    return str(seen.path.resolve())


@cache
def _version_of(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed as a package"


@dataclass(frozen=True)
class Run:
    """A trained run, ready to be drawn."""

    path: Path
    config: MethodConfig = field(repr=False)
    method: str
    policy: Terms
    """What training saw, as the capture could meet it."""
    capture: Capture
    """All of it, for evaluation and looking; without test frames where everything trained."""
    reconstruction: GaussianReconstruction = field(repr=False)
    iteration: int
    train_seconds: float
    device: str
    gaussians: dict[str, int]
    """Number of Gaussians, ``human`` and ``scene``."""
    human_only: bool
    """Whether the method learned nothing but the person and draws it on black."""
    recording: Camera | None = field(default=None, repr=False)
    """The camera at rest beside which the scene goes on, of methods whose scene does."""

    def beside(self) -> GaussianReconstruction:
        """The reconstruction as cameras beside the recording one are to see it; see `Beyond`.

        That is `reconstruction` itself where the scene ends with what was recorded.
        """
        drawn = self.reconstruction
        if self.recording is None:
            return drawn
        time = [int(drawn.track.times_us[0])]
        scene = drawn.render(self.recording, time, parts="scene")
        depth = drawn.depth(self.recording, time, parts="scene")[0]
        beyond = Beyond.of(self.recording, drawn.track, scene.rgb[0], depth)
        return replace(drawn.elsewhere(beyond.uncovered), beyond=beyond)

    def what_was_seen(self) -> dict[str, float | None] | None:
        """Share of the person's Gaussians that were little seen, and how rough; see `roughness`.

        None where the checkpoint does not tell.
        """
        seen = self.reconstruction.seen
        if seen is None:
            return None
        frame = self.capture.train_frames[0]
        rest = self.reconstruction.at_rest([(frame.mid_us, self.capture.camera(frame))])
        return roughness(rest, seen)


def read_config(folder: RunFolder) -> tuple[str, MethodConfig, dict[str, Any]]:
    """Method, configuration and facts of a run folder.

    Settings that were edited after the start are a `ConfigError`: no step was made with them, and a
    policy would claim what is not so.
    """
    check_run_folder(folder.path)
    values = load_yaml(folder.config)
    digest = _settings_of(values)
    method = values.pop("method", DEFAULT_METHOD)
    try:
        config = method_config(method, values, where=str(folder.config))
    except ConfigError as error:
        raise ConfigError(
            f"{error}\nIf another version of evsplat wrote this run (versions.json beside it names "
            "it), open it with that one, or train again."
        ) from None
    facts = read_record(folder.facts, _FACTS, "restore the file, or train again")
    if facts.get("settings", digest) != digest:
        again = command("train", "CAPTURE", "--config", folder.config, "--out", "NEW")
        raise ConfigError(
            f"{folder.config}: its settings are others than those that the run was started with, "
            f"by their digest in {folder.facts.name}; put them back, or train a new run with them: "
            f"{again}"
        )
    return method, config, facts


def check_capture(
    facts: dict[str, Any], seen: TrainingCapture, folder: RunFolder, method: str
) -> None:
    """Refuse a capture whose training frames, cameras, body or up are others than when it trained.

    What is held out now may have been seen then: figures of it would say nothing. Person and scene
    fit the cameras and poses that they were learned by. Floor and light were learned by what was
    up, of methods that draw them by it. Runs of before do not tell.
    """
    then, now = facts.get("training_frames"), _frames_of(seen)
    if then is not None and then != now:
        raise DataError(
            f"{folder.facts}: training_frames is {brief(then)}, and those of {seen.path} are "
            f"{now!r} now: what is held out may have been trained on; give the frames of "
            "capture.json the splits that they had, or train again."
        )
    if TRAINABLE[method].drawn_by_up and "up" in facts and facts["up"] != _up_of(seen):
        raise DataError(
            f"{folder.facts}: up is {brief(facts['up'])}, and {seen.path / 'capture.json'} has "
            f"{brief(_up_of(seen))} now: floor and light were learned by it; put it back, or train "
            "again."
        )
    for name, digest in _drawn_by(seen).items():
        if facts.get(name, digest) != digest:
            raise DataError(
                f"{folder.facts}: {name} has the digest {brief(facts[name])}, and in {seen.path} "
                f"it is {digest!r} now: person and scene were learned by other "
                f"{_DRAWN_BY[name]}; put them back, or train again."
            )


_DRAWN_BY = {
    "cameras": "cameras or exposure times (capture.json)",
    "body": "poses or another body (body.npz)",
}
"""What `_drawn_by` names, in words."""


def _drawn_by(seen: TrainingCapture) -> dict[str, str]:
    """Digests of all but pictures and events that training frames are drawn by."""
    cameras = [seen.camera(frame) for frame in seen.train_frames]
    body = vars(seen.body_file)
    return {
        "cameras": _digest_of(
            *((frame.exposure_us, seen.transfer(frame)) for frame in seen.train_frames),
            *(value for camera in cameras for value in vars(camera).values()),
        ),
        "body": _digest_of(*(value for name, value in body.items() if name != "path")),
    }


def _up_of(seen: TrainingCapture) -> list[float] | None:
    """The axis that capture.json says is up; None where it says nothing."""
    return None if seen.up is None else nearest_axis(torch.tensor(seen.up)).tolist()


def _frames_of(seen: TrainingCapture) -> str:
    """Number of the training frames, and a digest of their names."""
    names = [frame.name for frame in seen.train_frames]
    digest = _digest("\0".join(names))
    return f"{len(names)}, digest {digest}"


def _settings_of(values: dict[str, Any]) -> str:
    """A digest of a method and its settings, as config.yaml gives them."""
    return _digest(json.dumps(values, sort_keys=True, default=str))


def _digest_of(*values: Any) -> str:
    """A digest of arrays, whatever their types, and of what else there is as it is written."""
    arrays = (np.ndarray, torch.Tensor)
    parts = (
        np.asarray(value, np.float64).tobytes() if isinstance(value, arrays) else repr(value)
        for value in values
    )
    return _digest("\0".join(_digest(part) for part in parts))


def _digest(content: str | bytes) -> str:
    if isinstance(content, str):
        content = content.encode("utf-8", "surrogatepass")
    return hashlib.sha256(content).hexdigest()[:16]


def seen_by_training(capture: Capture, config: MethodConfig) -> TrainingCapture:
    """The part of a capture that a method with this configuration is given."""
    return capture.for_training(config.policy, MASKERS["background"])


def load_run(run_dir: Path | str, *, device: str = "auto", state: Path | None = None) -> Run:
    """Read a run at its last checkpoint; ``state`` is another checkpoint or snapshot of it.

    ``device`` is as of `evsplat.render.choose_device`.

    Raises:
        DataError: no run, no sound checkpoint in it, or its capture is gone or another one.
        ConfigError: settings of the run that are unknown or out of range.
    """
    device = choose_device(device)
    folder = RunFolder(Path(run_dir))
    method, config, facts = read_config(folder)
    loaded = (state, *load_checkpoint(state)) if state else load_latest(folder.checkpoints)
    if loaded is None:
        raise DataError(f"{folder.checkpoints}: no checkpoint; train the run first.")
    path, tensors, progress = loaded
    place = Path(facts["capture"])
    if not os.path.isdir(place):  # unlike `Path.is_dir` False of a name that no file may have
        raise DataError(
            f"{str(place)[:1000]}: not found, expected the capture that {folder.path} was trained "
            f"on; put it back, or write its new place under 'capture' in {folder.facts}."
        )
    capture = load_capture(place, warn=False)  # its training has
    if config.policy.use == "everything":
        capture = capture.with_nothing_held_out()
    shown = seen_by_training(capture, config)
    check_capture(facts, shown, folder, method)
    composition = TRAINABLE[method].build(
        config, shown, facts["seed"], device=device, purpose="draw"
    )
    check_fits(composition.model, tensors, path)
    with misfits_of(path):
        seen, solid = load_shown(composition.model, tensors, progress["human_count"])
    composition.model.requires_grad_(False)
    return Run(
        path=folder.path,
        config=config,
        method=method,
        policy=shown.terms(
            event_use(config),
            # Runs of before do not tell.
            thresholds_found=facts.get("thresholds_found") is not False,
        ),
        capture=capture,
        reconstruction=GaussianReconstruction(
            method,
            composition.model,
            seen,
            Backdrop(),
            Kept(),
            solid=solid,
            recorders=tuple(camera.to(device) for camera in spread_over(shown.recorders())),
        ),
        device=facts["device"],
        human_only=isinstance(composition.capture, MaskedCapture),
        recording=composition.recording,
        **_progress(composition.model, progress),
    )


def opened(run: Run | Path | str, *, device: str) -> Run:
    """A run that was read already as it is, on its device; else what `load_run` reads."""
    return run if isinstance(run, Run) else load_run(run, device=device)


def folder_of(run: Run | Path | str) -> Path:
    """The folder of a run, read already or not."""
    return run.path if isinstance(run, Run) else Path(run)


def reload_run(run: Run, state: Path) -> Run:
    """The run at another checkpoint or snapshot of it; its model gets other parameters in place."""
    model = run.reconstruction.model
    tensors, progress = load_checkpoint(state)
    with misfits_of(state):
        seen, solid = load_shown(model, tensors, progress["human_count"])
    model.requires_grad_(False)
    reconstruction = replace(run.reconstruction, seen=seen, solid=solid)
    return replace(run, reconstruction=reconstruction, **_progress(model, progress))


def _progress(model: Model, progress: dict[str, Any]) -> dict[str, Any]:
    """The fields of `Run` that change while it is trained."""
    return {
        "iteration": progress["clock"]["iteration"],
        "train_seconds": progress["clock"]["seconds"],
        "gaussians": counts(model),
    }
