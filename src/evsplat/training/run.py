"""The run folder: configuration, versions, log, checkpoints; and a trained run read back."""

import hashlib
import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.body import BodyTrack
from evsplat.capture import Camera, Capture, Policy, TrainingCapture, load_capture
from evsplat.capture.masked import MaskedCapture
from evsplat.config import load_yaml
from evsplat.devices import hardware
from evsplat.errors import ConfigError, DataError
from evsplat.files import write_json, write_text
from evsplat.masks import MASKERS
from evsplat.methods import DEFAULT_METHOD, TRAINABLE, MethodConfig, method_config
from evsplat.methods.reconstruction import Parts, Rendering
from evsplat.models.at_rest import Skinned, SkinnedGaussians, mean_at_rest, with_correctives
from evsplat.models.beyond import Beyond
from evsplat.models.drawing import SHADOW_STEP_PX, draw, draw_depth, shadowed_scene
from evsplat.models.layers import Layers
from evsplat.models.model import Model
from evsplat.models.seen import Seen, draw_values, roughness
from evsplat.options.inputs import check_run_folder
from evsplat.render import Backdrop, Splats, choose_device, render
from evsplat.training.checkpoint import (
    below,
    check_fits,
    counts,
    load_checkpoint,
    load_latest,
    load_model,
    misfits_of,
)
from evsplat.untrusted.faults import brief
from evsplat.untrusted.records import read_record
from evsplat.untrusted.text import parse_json, read_text

PACKAGES = ("torch", "numpy", "scipy", "h5py", "pillow", "safetensors")

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
    folder: RunFolder, seen: TrainingCapture, method: str, device: str, seed: int
) -> None:
    """Record what the run was made with; ``seen`` is what its training is given."""
    versions = {}
    for package in ("evsplat", *PACKAGES):
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = "not installed as a package"
    write_json(
        folder.facts,
        {
            "capture": str(seen.path.resolve()),
            "capture_name": seen.name,
            "training_frames": _frames_of(seen),
            "method": method,
            "device": device,
            "threads": torch.get_num_threads(),
            **hardware(),
            "seed": seed,
            "python": platform.python_version(),
            "machine": platform.machine(),
            "packages": versions,
        },
    )


@dataclass(frozen=True)
class GaussianReconstruction:
    """A trained model, drawn from any camera at any time of the recording."""

    name: str
    model: Skinned
    seen: Seen | None = None
    """What training saw of the person; None in checkpoints from before its end."""
    backdrop: Backdrop | None = None
    """What the scene looked like to the picture before, for a camera that mostly stands still."""
    shadow_step_px: int = SHADOW_STEP_PX
    """Shadows are looked up so far apart."""
    changes: tuple[Callable[[Layers, Camera], Layers], ...] = ()
    """What a film makes of the posed Gaussians before they are drawn."""
    beyond: Beyond | None = None
    """What pictures of person and scene show where nothing is; black without."""

    def render(self, camera: Camera, times_us: Sequence[int], *, parts: Parts = "all") -> Rendering:
        """Pictures at the given times; see `Reconstruction`."""
        with torch.no_grad():
            camera, layers = self._posed(camera, times_us)
            if parts == "all":
                drawing = draw(
                    layers, camera, backdrop=self.backdrop, shadow_step_px=self.shadow_step_px
                )
                rgb, human = _stacked(drawing.rgb), _stacked(drawing.semantic)
                alpha = drawing.output.alpha
                if self.beyond is not None:
                    rgb = self.beyond.fill(rgb, alpha, camera)
            else:
                layer = layers.human if parts == "human" else layers.scene
                output = render(layer, camera, low_pass=layers.low_pass)
                rgb, human, alpha = output.image[..., :3], output.image[..., 3], output.alpha
        # The scene alone is drawn once.
        shape = len(times_us), camera.height, camera.width
        return Rendering(
            rgb=rgb.cpu().clamp(0, 1).expand(*shape, 3),
            alpha=alpha.cpu().expand(shape),
            human=human.cpu().clamp(0, 1).expand(shape),
        )

    def depth(
        self, camera: Camera, times_us: Sequence[int], *, parts: Parts = "all"
    ) -> Float[Tensor, "T H W"]:
        """Mean of z in the camera over what a pixel shows, metres; 0 where it shows nothing."""
        with torch.no_grad():
            camera, layers = self._posed(camera, times_us)
            depth = draw_depth(layers, camera, parts=parts).cpu()
        return depth.expand(len(times_us), *depth.shape[1:])

    def certainties(self) -> Float[Tensor, " H"] | None:
        """How well training saw each Gaussian of the person, 0 to 1; None where nothing tells."""
        return None if self.seen is None else self.seen.certainty()

    @torch.no_grad()
    def certainty(
        self, camera: Camera, times_us: Sequence[int], *, parts: Parts = "all"
    ) -> Float[Tensor, "T H W"]:
        """How well training saw what a pixel shows of the person, 0 to 1; the scene counts as 1.

        Raises:
            DataError: The checkpoint does not tell.
        """
        if self.seen is None:
            raise DataError(
                "--show certainty: the run's checkpoint does not say what training saw, being from "
                "before its end or from an older version; go on with 'evsplat train CAPTURE --out "
                "RUN --resume', which adds it."
            )
        camera, layers = self._posed(camera, times_us)
        human = (
            self.seen.certainty().to(self.model.device)[None, :, None].expand(len(times_us), -1, -1)
        )
        scene = layers.scene.means.new_ones(1, layers.scene.means.shape[1], 1)
        if parts == "all":
            return draw_values(layers, camera, human, scene)[..., 0].cpu().clamp(0, 1)
        layer = replace(layers.human, channels=human)
        if parts == "scene":
            layer = replace(layers.scene, channels=scene)
        picture = render(layer, camera, low_pass=layers.low_pass).image[..., 0].cpu().clamp(0, 1)
        return picture.expand(len(times_us), *picture.shape[1:])

    def _posed(self, camera: Camera, times_us: Sequence[int]) -> tuple[Camera, Layers]:
        camera = camera.to(self.model.device)
        layers = self.model.at(list(times_us), camera.center(), hard_semantics=True)
        for change in self.changes:
            layers = change(layers, camera)
        return camera, layers

    @property
    def track(self) -> BodyTrack:
        """The recorded motion and its body."""
        return self.model.track

    def following(self, track: BodyTrack) -> "GaussianReconstruction":
        """The same person and scene with the motion ``track`` (same body, own times) instead."""
        return GaussianReconstruction(self.name, self.model.following(track), self.seen)

    def in_new_motion(self, track: BodyTrack) -> "GaussianReconstruction":
        """As `following`, for poses that were not recorded: neighbours on the skin stay together.

        What was learned fits the recorded poses without that, by 0.2 dB of the person's pixels.
        """
        moving = self.following(track)
        moving.model.stay_together()
        return moving

    def changed_by(self, *changes: Callable[[Layers, Camera], Layers]) -> "GaussianReconstruction":
        """The same, with the posed Gaussians changed by each in turn before they are drawn."""
        return replace(self, changes=changes)

    @property
    def low_pass(self) -> float:
        """Variance of the filter of a pixel in its pictures, px^2; viewers of others take 0.3."""
        return self.model.low_pass

    @torch.no_grad()
    def splats(
        self, camera: Camera, times_us: Sequence[int], *, parts: Parts = "all"
    ) -> list[Splats]:
        """Gaussians that `render` draws, world metres; the person first.

        Channels are R, G, B (sRGB) and the semantic attribute (1 = person). Colours that depend on
        the direction are those seen from ``camera``.
        """
        _, layers = self._posed(camera, times_us)
        if parts == "all":
            return [layers.human, shadowed_scene(layers)]
        return [layers.human if parts == "human" else layers.scene]

    def at_rest(self, views: Sequence[tuple[int, Camera]]) -> SkinnedGaussians:
        """The person's mean over ``views`` (times in us and their cameras), in canonical space."""
        return mean_at_rest(self.model, views)

    def with_correctives(
        self, rest: SkinnedGaussians, views: Sequence[tuple[int, Camera]]
    ) -> SkinnedGaussians:
        """A person at rest and what the poses at ``views`` change beyond skinning."""
        return with_correctives(rest, self.model, views)

    @torch.no_grad()
    def pose(
        self, times_us: Sequence[int]
    ) -> tuple[Float[Tensor, "T J 3 3"], Float[Tensor, "T J 4 4"]]:
        """The recorded motion with what the method corrected of it.

        Rotations of joints against their parents, and bone transforms canonical to world.
        """
        rotations, bones = self.model.pose(list(times_us))
        return rotations.cpu(), bones.cpu()


def _stacked(pictures: tuple[Tensor, ...]) -> Tensor:
    """With an axis of times; one picture is not copied."""
    return pictures[0][None] if len(pictures) == 1 else torch.stack(pictures)


@dataclass(frozen=True)
class Run:
    """A trained run, ready to be drawn."""

    path: Path
    config: MethodConfig
    method: str
    policy: Policy
    """What training saw, as the capture could meet it."""
    capture: Capture
    """All of it, for evaluation and looking; without test frames where everything trained."""
    reconstruction: GaussianReconstruction
    iteration: int
    train_seconds: float
    device: str
    gaussians: dict[str, int]
    """Number of Gaussians, ``human`` and ``scene``."""
    human_only: bool
    """Whether the method learned nothing but the person and draws it on black."""
    recording: Camera | None = None
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
        beyond = Beyond.of(self.recording, drawn.track, scene.rgb[0], scene.alpha[0], depth)
        return replace(drawn.changed_by(beyond.uncovered), beyond=beyond)

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
    """Method, configuration and facts of a run folder."""
    check_run_folder(folder.path)
    values = load_yaml(folder.config)
    method = values.pop("method", DEFAULT_METHOD)
    try:
        config = method_config(method, values, where=str(folder.config))
    except ConfigError as error:
        raise ConfigError(
            f"{error}\nIf another version of evsplat wrote this run (versions.json beside it names "
            "it), open it with that one, or train again."
        ) from None
    facts = read_record(folder.facts, _FACTS, "restore the file, or train again")
    return method, config, facts


def check_frames(facts: dict[str, Any], seen: TrainingCapture, folder: RunFolder) -> None:
    """Refuse a capture whose frames of split `train` are others than those that were trained on.

    What is held out now may have been seen then: figures of it would say nothing. Runs of before do
    not tell.
    """
    then, now = facts.get("training_frames"), _frames_of(seen)
    if then is not None and then != now:
        raise DataError(
            f"{folder.facts}: training_frames is {brief(then)}, and those of {seen.path} are "
            f"{now!r} now: what is held out may have been trained on; give the frames of "
            "capture.json the splits that they had, or train again."
        )


def _frames_of(seen: TrainingCapture) -> str:
    """Number of the training frames, and a digest of their names."""
    names = [frame.name for frame in seen.train_frames]
    digest = hashlib.sha256("\0".join(names).encode("utf-8", "surrogatepass")).hexdigest()
    return f"{len(names)}, digest {digest[:16]}"


def seen_by_training(capture: Capture, config: MethodConfig) -> TrainingCapture:
    """The part of a capture that a method with this configuration is given."""
    return capture.for_training(config.policy, MASKERS["background"])


def load_run(run_dir: Path | str, *, device: str = "auto", state: Path | None = None) -> Run:
    """Read a run at its last checkpoint; a folder without one is a `DataError`.

    ``state`` is another checkpoint or snapshot of it.
    """
    device = choose_device(device)
    folder = RunFolder(Path(run_dir))
    method, config, facts = read_config(folder)
    loaded = (state, *load_checkpoint(state)) if state else load_latest(folder.checkpoints)
    if loaded is None:
        raise DataError(f"{folder.checkpoints}: no checkpoint; train the run first.")
    path, tensors, progress = loaded
    capture = load_capture(Path(facts["capture"]))
    if config.policy.use == "everything":
        capture = capture.with_nothing_held_out()
    shown = seen_by_training(capture, config)
    check_frames(facts, shown, folder)
    composition = TRAINABLE[method].build(
        config, shown, facts["seed"], device=device, purpose="draw"
    )
    check_fits(composition.model, tensors, path)
    with misfits_of(path):
        load_model(composition.model, tensors, progress["human_count"], filled=True)
        seen = _seen(tensors, progress)
    composition.model.requires_grad_(False)
    return Run(
        path=folder.path,
        config=config,
        method=method,
        policy=shown.terms,
        capture=capture,
        reconstruction=GaussianReconstruction(method, composition.model, seen, Backdrop()),
        device=facts["device"],
        human_only=isinstance(composition.capture, MaskedCapture),
        recording=composition.recording,
        **_progress(composition.model, progress),
    )


def reload_run(run: Run, state: Path) -> Run:
    """The run at another checkpoint or snapshot of it; its model gets other parameters in place."""
    model = run.reconstruction.model
    tensors, progress = load_checkpoint(state)
    with misfits_of(state):
        load_model(model, tensors, progress["human_count"], filled=True)
        seen = _seen(tensors, progress)
    model.requires_grad_(False)
    reconstruction = replace(run.reconstruction, seen=seen)
    return replace(run, reconstruction=reconstruction, **_progress(model, progress))


def _seen(tensors: dict[str, Tensor], progress: dict[str, Any]) -> Seen | None:
    """What training saw, where the checkpoint is that of its end."""
    return Seen.of(below("seen", tensors), progress["human_count"])


def _progress(model: Model, progress: dict[str, Any]) -> dict[str, Any]:
    """The fields of `Run` that change while it is trained."""
    return {
        "iteration": progress["clock"]["iteration"],
        "train_seconds": progress["clock"]["seconds"],
        "gaussians": counts(model),
    }
