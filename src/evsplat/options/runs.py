"""Options of the verbs that make runs and show them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from evsplat.errors import ConfigError
from evsplat.options.declare import (
    Device,
    Flag,
    NewRun,
    Parts,
    Sensor,
    Threads,
    Use,
    check_options,
    check_twins,
    option,
)
from evsplat.ranges import SEEDS, Above, AtLeast, AtMost, Within


@dataclass(frozen=True)
class TrainOptions:
    """Training of a method on a capture, and the place of the run."""

    out: NewRun = None
    method: Annotated[str | None, option("NAME", default="that of --config, or evsplat")] = None
    """Name of the method."""
    max_minutes: Annotated[float | None, Above(0), option("M", default="no limit")] = None
    """Minutes of training after which to stop gracefully, save and evaluate."""
    iterations: Annotated[int | None, AtLeast(1), option("N", default="the method's")] = None
    """Exactly so many training steps; every schedule is scaled to it."""
    config: Annotated[Path | None, option("FILE", default="the method's")] = None
    """A config.yaml of an earlier run to start from."""
    overrides: Annotated[
        tuple[str, ...], option("[KEY=VALUE ...]", default="none", name="set")
    ] = ()
    """Settings to change, such as event_weight=0.2; see docs/settings.md."""
    resume: Flag = False
    """Go on from the last checkpoint in --out."""
    seed: Annotated[int | None, SEEDS, option("S", default="0")] = None
    """Seed of every random number."""
    use: Annotated[Use | None, option("{training,everything}", default="training")] = None
    """everything trains on all that was recorded and holds nothing out for test figures."""
    any_body: Flag = False
    """Train even with a body that follows nothing that moves in the recording."""
    device: Device = "auto"
    """Device; auto takes what the installed rasterisers can use."""
    threads: Threads = None
    device_memory_gb: Annotated[
        float | None, AtLeast(0), option("GB", default="a quarter of the free")
    ] = None
    """GPU memory for recorded pictures and event maps."""

    def __post_init__(self) -> None:
        check_options(self)
        check_twins(self, self.overrides, {"iterations": "iterations", "policy.use": "use"})
        if not self.resume:
            return
        if self.out is None:
            raise ConfigError("--resume needs --out RUN, the run to go on with.")
        own = (self.config, self.seed, self.use)
        if self.overrides or any(value is not None for value in own):
            raise ConfigError(
                "--resume takes the run's own settings; leave out --config, --set, --seed and "
                "--use."
            )


MotionRate = Annotated[float | None, Within(0.01, 100_000), option("HZ", default="the file's")]
Shown = Literal["rgb", "semantic", "depth", "events", "certainty"]

_EVENT_HZ = 1000.0


@dataclass(frozen=True)
class Film:
    """Film of a run, as `render_run` draws it."""

    what: Literal["sequence", "test"] = "sequence"
    """The whole recording, or the held-out frames."""
    show: Shown = "rgb"
    """Events are those of a simulated sensor; certainty is what training saw of the person."""
    parts: Parts = "all"
    """The person and the scene, or one of them."""
    camera: Annotated[str | None, option("NAME", default="that of the frames")] = None
    """One of the capture's cameras."""
    path: Annotated[str | None, option("PATH", default="it stays")] = None
    """orbit, swing, interpolate or a JSON file."""
    motion: Annotated[str | None, option("NAME", default="none")] = None
    """Another motion: walk, run, spin, dance_a ... or a motion or pose file."""
    motion_fps: MotionRate = None
    """Poses per second of a pose file."""
    in_place: Flag = False
    """Leave out the motion's travel along the floor."""
    at: Annotated[float | None, option("S", default="no")] = None
    """Hold the person, from the first mid-exposure."""
    seconds: Annotated[
        float | None, Above(0), AtMost(86_400), option("S", default="all; 4 with --at")
    ] = None
    """Film so much of it."""
    fps: Annotated[float, Within(0.01, 1000), option("HZ")] = 30.0
    """Pictures per second that the video plays."""
    slow: Annotated[float, Above(0), AtMost(10_000), option("FACTOR")] = 1.0
    """Times slower than life."""
    size: Annotated[
        int | None, Within(16, 4320), option("PX", default="720 for videos, or the camera's")
    ] = None
    """Picture height."""
    background: Annotated[str | None, option("LOOK", default="a calm room")] = None
    """Colour (white, #202830) or picture."""
    beside: Flag = False
    """Put the blurry input frame (or recorded events) at the left."""
    transparent: Flag = False
    """Transparent where nothing is (.webp, .gif, PNG)."""
    sensor: Annotated[Sensor, option("NAME")] = "clean"
    """Event camera of --show events."""
    event_hz: Annotated[float, Above(0), AtMost(100_000), option("HZ")] = _EVENT_HZ
    """Pictures per second that it is shown."""

    def __post_init__(self) -> None:
        check_options(self)
        changed = [f for f in ("path", "motion", "at", "seconds") if getattr(self, f) is not None]
        if self.slow != 1:
            changed.append("slow")
        if self.show == "events":
            changed.append("show events")
        elif self.sensor != "clean" or self.event_hz != _EVENT_HZ:
            option = "sensor" if self.sensor != "clean" else "event-hz"
            raise ConfigError(
                f"--{option}: goes with --show events, which simulates them; give it or leave "
                f"--{option} out."
            )
        if self.what == "test" and changed:
            raise ConfigError(
                f"--{changed[0]}: films the sequence, not --what test; leave one out."
            )
        if self.background is not None and (self.transparent or self.show != "rgb"):
            other = "--transparent" if self.transparent else f"--show {self.show}"
            raise ConfigError(f"--background: nothing of it shows with {other}; leave one out.")
        if self.what == "test" and (self.size is not None or self.background is not None):
            raise ConfigError(
                "--what test: held-out frames are drawn as they are measured; leave out --size, "
                "--background."
            )
        if self.path is not None and self.camera is not None and self.path == "interpolate":
            raise ConfigError("--camera: --path interpolate goes through all; leave one out.")
        if self.at is not None and self.slow != 1:
            raise ConfigError("--slow: with --at the time stands still; leave one out.")
        if self.beside and (self.motion is not None or self.transparent):
            other = "motion" if self.motion is not None else "transparent"
            raise ConfigError(f"--beside: the input does not fit --{other}; leave one out.")
        if self.beside and self.at is not None and self.show == "events":
            raise ConfigError("--beside: no events were recorded while --at holds; leave one out.")
        if self.motion is None and (self.motion_fps is not None or self.in_place):
            option = "in-place" if self.in_place else "motion-fps"
            raise ConfigError(f"--{option}: goes with --motion; name one or leave it out.")

    def file_name(self) -> str:
        """Name of the film in a run's ``renders/``."""
        words: list[str] = [self.what]
        words += [] if self.parts == "all" else [self.parts]
        # No path and taken whole: there may be cam.1 and cam.2, or one that is called rgb.
        words += [] if self.camera is None else [self.camera]
        words += [Path(path).stem for path in (self.path, self.motion) if path is not None]
        words += [] if self.show == "rgb" else [self.show]
        words += [] if self.at is None else [f"at-{self.at:g}s"]
        words += [name for name in ("transparent", "beside") if getattr(self, name)]
        ending = {"test": ""}.get(self.what, ".webp" if self.transparent else ".mp4")
        return "-".join(words) + ending


Split = Literal["test", "train"]
UpAxis = Literal["y", "z"]
FileKind = Literal["ply", "spz", "splat", "gltf"]
MotionKind = Literal["bvh", "skeleton"]
Kind = Literal["ply", "spz", "splat", "gltf", "html", "avatar", "bvh", "skeleton"]


@dataclass(frozen=True)
class ExportOptions:
    """Part of a run that a file for other programs holds."""

    out: Annotated[Path | None, option("PATH", default="in RUN/exports")] = None
    """The file to write; avatar: a page NAME.html, or a new folder."""
    time_s: Annotated[float | None, option("S", default="the middle", name="time")] = None
    """Seconds from the first mid-exposure."""
    frame: Annotated[str | None, option("NAME", default="see --time")] = None
    """The mid-exposure of this frame."""
    canonical: Flag = False
    """The person at rest instead of an instant."""
    parts: Annotated[Parts | None, option("{all,human,scene}", default="all; human for avatar")] = (
        None
    )
    """The person and the scene, or one of them."""
    camera: Annotated[str | None, option("NAME", default="the recording one")] = None
    """The camera that sees the colours, which depend on the direction of view."""
    up: Annotated[UpAxis | None, option("{y,z}", default="the capture's axes; y for spz, gltf")] = (
        None
    )
    """Turn the world so that this axis points up."""
    low_pass: Annotated[
        float | None, Within(0, 1), option("PX2", default="0.05, for those in browsers")
    ] = None
    """For viewers that add so many px^2 to Gaussians, at the recording's size (docs/export.md)."""
    motion: Annotated[str | None, option("NAME", default="the recorded one alone")] = None
    """Another motion for avatar, bvh or skeleton, as 'evsplat render' takes it."""
    motion_fps: MotionRate = None
    """Poses per second of a pose file."""
    fps: Annotated[float | None, Within(1, 120), option("HZ", default="24")] = None
    """Pictures per second of html."""
    device: Device = "auto"
    """Device that computes."""

    def __post_init__(self) -> None:
        check_options(self)
        if self.time_s is not None and self.frame is not None:
            raise ConfigError("--time and --frame both say when; give one of them.")
        if self.motion is None and self.motion_fps is not None:
            raise ConfigError("--motion-fps: goes with --motion; name one or leave it out.")
        if self.canonical and self.low_pass is not None:
            raise ConfigError(
                "--low-pass: depends on how far the person is, which --canonical is from no "
                "camera; leave one out."
            )
        if self.canonical and (self.time_s is not None or self.frame is not None):
            raise ConfigError(
                "--canonical is the person at rest, at no time; leave out --time, --frame."
            )


@dataclass(frozen=True)
class BenchOptions:
    """Part of a suite that is run, and where; what is given replaces what the suite says."""

    out: Annotated[Path | None, option("FOLDER", default="bench/SUITE")] = None
    """Results folder: tables.md, tables.tex, index.html, one JSON per cell."""
    records: Annotated[Path | None, option("FOLDER", default="none")] = None
    """Kept records, a few KB each: cells there count as done, finished cells are kept there."""
    captures: Annotated[tuple[Path, ...], option("[CAPTURE ...]", default="the suite's")] = ()
    """Captures in place of the suite's, or names of some of the suite's."""
    draw_seed: Annotated[
        int | None, AtLeast(0), option("S", default="the suite's", name="seed")
    ] = None
    """Draw other captures at random, for suites that draw them (grid)."""
    add: Annotated[tuple[str, ...], option("[NAME=FOLDER ...]", default="none")] = ()
    """Rows of pictures made elsewhere: FOLDER/CAPTURE/FRAME.png for every test frame."""
    iterations: Annotated[int | None, AtLeast(1), option("N", default="the suite's")] = None
    """Training steps of every cell."""
    max_minutes: Annotated[float | None, Above(0), option("M", default="the suite's")] = None
    """Minutes of training of every cell; schedules are shortened to fit."""
    seeds: Annotated[tuple[int, ...], SEEDS, option("[S ...]", default="the suite's")] = ()
    """Seeds of training in place of the suite's."""
    only: Annotated[tuple[str, ...], option("[ROW ...]", default="all rows")] = ()
    """Rows of the suite to run."""
    jobs: Annotated[int | None, AtLeast(1), option("N", default="one per core or GPU")] = None
    """Cells at a time on this machine; they share its cores."""
    ray: Annotated[str | None, option("ADDRESS|local", default="this machine, no Ray")] = None
    """Ray cluster to run on; local starts one on this machine."""
    cpus_per_cell: Annotated[
        int | None, AtLeast(1), option("N", default="an even share; 1 on Ray")
    ] = None
    """CPU threads of a cell."""
    gpus_per_cell: Annotated[float | None, AtLeast(0), option("G", default="0 on Ray")] = None
    """GPUs of a cell, on Ray."""
    device: Device = "auto"
    """Device that computes."""
    retry: Flag = False
    """Run cells again that failed."""

    def __post_init__(self) -> None:
        check_options(self)
        if self.ray is not None and self.jobs is not None:
            raise ConfigError("--jobs is for this machine; on Ray --cpus-per-cell decides.")
        if self.ray is None and self.gpus_per_cell is not None:
            raise ConfigError("--gpus-per-cell is for --ray; here every process has one GPU.")
