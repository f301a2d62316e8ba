"""Verbs that make captures and event recordings, or look at them; ``import`` is in `import_`."""

import os
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional

from evsplat.commands import command
from evsplat.errors import ConfigError, DataError
from evsplat.options import PoseSearch, ReadOptions, StageSettings, SynthesisSettings
from evsplat.options.declare import (
    FLAT,
    CaptureFolder,
    Device,
    Flag,
    Sensor,
    Threads,
    Transfer,
    Use,
    check_twins,
    option,
)
from evsplat.options.inputs import Input, check_capture_or_recording, check_file, check_footage


@dataclass(frozen=True, kw_only=True)
class Convert:
    """Read any event recording and write it as HDF5, .npz, .csv or EVT 2 (.raw).

    What is read: docs/event-formats.md.
    """

    recording: Annotated[Positional[Path], option("IN"), Input(check_file)]
    """AEDAT4, AEDAT2, RAW, DAT, HDF5, .npz, text, .es or a ROS bag."""
    out: Annotated[Positional[Path | None], option("OUT", default="")] = None
    """The file to write."""
    in_place: Flag = False
    """Replace IN, instead of OUT, once all is written."""
    from_zero: Flag = False
    """Let the first event be at 0."""
    to: Annotated[
        Literal["hdf5", "npz", "csv", "evt2"] | None, option("FORMAT", default="by OUT's suffix")
    ] = None
    """Format to write."""
    homography: Annotated[Path | None, option("FILE", default="none")] = None
    """Move events into the pixels of pictures: 3 lines of 3 numbers, or .npy."""
    size: Annotated[tuple[int, int] | None, option("WIDTH HEIGHT", default="none")] = None
    """For --homography: pixels of the pictures."""
    invert: Flag = False
    """Exchange brighter and darker."""
    reading: Annotated[ReadOptions, FLAT]

    def __call__(self) -> None:
        from evsplat.events.convert import convert_recording

        if self.in_place == (self.out is not None):
            raise ConfigError("convert: give OUT, the file to write, or --in-place to replace IN.")
        conversion = convert_recording(
            self.recording,
            self.out,
            self.reading,
            from_zero=self.from_zero,
            to=self.to,
            homography=self.homography,
            size=self.size,
            invert=self.invert,
        )
        print(conversion.summary)


@dataclass(frozen=True, kw_only=True)
class Simulate:
    """Write the events that an event camera would have sent, seeing a video."""

    source: Annotated[Positional[Path], option("SOURCE"), Input(check_footage)]
    """A video, or a folder of pictures in the order of their names; 200 a second or more, as light
    is taken to change evenly between two."""
    out: Annotated[Path, option("FILE")]
    """Event file to write, such as events.h5."""
    preset: Sensor = "clean"
    """Event camera; clean has no noise (docs/simulator.md)."""
    contrast: Annotated[float | None, option("C", default="the preset's")] = None
    """Threshold of both polarities, in natural logarithm of light."""
    overrides: Annotated[
        tuple[str, ...], option("[KEY=VALUE ...]", default="none", name="set")
    ] = ()
    """Sensor settings to change, such as shot_hz=5 or contrast_off=0.3."""
    source_fps: Annotated[float | None, option("HZ", default="the video's own")] = None
    """Rate at which the pictures were taken; a folder needs it."""
    transfer: Transfer = "power"
    """From coded values to light: exponent 2.2, sRGB's curve, or as they are."""
    seed: Annotated[int, option("S")] = 0
    """Seed of everything random in the sensor."""

    def __call__(self) -> None:
        from evsplat.config import from_dict, override, to_dict
        from evsplat.events import SensorSettings, sensor_settings
        from evsplat.footage.simulate import simulate

        twins = dict.fromkeys(("contrast_on", "contrast_off"), "contrast")
        check_twins(self, self.overrides, twins)
        preset = sensor_settings(self.preset, contrast_on=self.contrast, contrast_off=self.contrast)
        values = override(to_dict(preset), self.overrides)
        count = simulate(
            self.source,
            self.out,
            settings=from_dict(SensorSettings, values, where="--set"),
            source_fps=self.source_fps,
            transfer=self.transfer,
            seed=self.seed,
        )
        print(f"written: {self.out} ({count:,} events)")


@dataclass(frozen=True, kw_only=True)
class Synthesize:
    """Make a capture of sharp footage: blur and events (docs/synthesize.md)."""

    source: Annotated[Positional[Path], option("SOURCE"), Input(check_footage)]
    """Video, folder of pictures, or capture with sharp frames."""
    out: Annotated[Path, option("CAPTURE")]
    """New capture folder."""
    settings: Annotated[SynthesisSettings, FLAT]
    weights: Annotated[Path | None, option("FILE", default="in torch's hub")] = None
    """Super SloMo's checkpoint."""
    source_fps: Annotated[float | None, option("HZ", default="the video's")] = None
    """Rate at which footage was shot."""
    body: Annotated[Path | None, option("NPZ", default="none")] = None
    """Poses as in body.npz."""
    pose_source: Annotated[
        Literal["exact", "markers", "estimated"] | None, option("KIND", default="unknown")
    ] = None
    """Where the poses of --body come from."""
    camera: Annotated[Path | None, option("JSON", default="a nominal one")] = None
    """Camera as in capture.json."""
    overwrite: Flag = False
    """Replace a capture at CAPTURE."""

    def __call__(self) -> None:
        from evsplat.synthesis import synthesize

        path = synthesize(
            self.source,
            self.out,
            self.settings,
            weights=self.weights,
            source_fps=self.source_fps,
            body=self.body,
            pose_source=self.pose_source,
            camera=self.camera,
            overwrite=self.overwrite,
        )
        print(f"written: {path}\nlook at it with: {command('inspect', path)}")


@dataclass(frozen=True, kw_only=True)
class Stage:
    """Film a synthetic person in a room, with complete ground truth.

    Blur and events are made from at least 1000 pictures per second.
    """

    out: Annotated[Positional[Path | None], option("[CAPTURE]", default="")] = None
    """New capture folder; only --list needs none."""
    list: Flag = False
    """Say which characters and motions ship."""
    settings: Annotated[StageSettings, FLAT]
    threads: Threads = None

    def __call__(self) -> None:
        from evsplat import staging

        if self.list:
            print(f"characters: {', '.join(staging.characters())}")
            print(f"motions: {', '.join(staging.motions())}")
        elif self.out is None:
            raise ConfigError("stage needs a folder for the capture: evsplat stage my_capture.")
        else:
            print(f"capture: {staging.stage(self.out, self.settings, threads=self.threads)}")


@dataclass(frozen=True, kw_only=True)
class Inspect:
    """Validate a capture, or look into an event recording; sum it up and draw it.

    Draws frames, events, posed body, time and clocks, where there are any.
    """

    capture: Annotated[Positional[Path], option("CAPTURE"), Input(check_capture_or_recording)]
    """Capture folder (docs/capture-format.md), or an event file of any format."""
    out: Annotated[Path | None, option("FOLDER", default="inspect/CAPTURE")] = None
    """Folder for the pictures; by default with a number where that shows another capture."""
    repair: Flag = False
    """Read on where an event file is damaged."""

    def __call__(self) -> None:
        from evsplat.inspection import default_folder, inspect

        with nullcontext(self.out) if self.out else default_folder(self.capture) as out:
            report = inspect(self.capture, out, repair=self.repair)
        if not report.usable:
            raise DataError(report.summary)
        print(report.summary)


@dataclass(frozen=True, kw_only=True)
class Masks:
    """Find the person in each frame: soft masks for baselines and evaluation.

    Training of this project's own methods needs none.
    """

    capture: CaptureFolder
    out: Annotated[Path | None, option("FOLDER", default="CAPTURE-masked")] = None
    """The new capture, with these masks in place of any it had."""
    in_place: Flag = False
    """Add the masks to the capture itself, if it has no others."""
    method: Annotated[Literal["background", "silhouette", "rvm"], option(name="with")] = (
        "background"
    )
    """Difference to a static background, posed body, or RobustVideoMatting."""
    threshold: Annotated[float | None, option("T", default="from the noise")] = None
    """For background: least difference, 0 to 1."""
    margin: Annotated[float | None, option("PIXELS", default="0")] = None
    """For silhouette: widen the body for clothes and hair."""
    weights: Annotated[Path | None, option("FILE", default="EVSPLAT_RVM, or torch's cache")] = None
    """For rvm: the network's TorchScript file, which you bring."""
    use: Use = "training"
    """Source of the masks of training frames; everything looks at held-out ones too."""

    def __call__(self) -> None:
        from evsplat.capture import Policy
        from evsplat.masks import mask_capture

        options: dict[str, Any] = {}
        for name, keyword, owner in (
            ("threshold", "threshold", "background"),
            ("margin", "margin_px", "silhouette"),
            ("weights", "weights", "rvm"),
        ):
            value = getattr(self, name)
            if value is None:
                continue
            if owner != self.method:
                raise ConfigError(
                    f"--{name} belongs to --with {owner}, not to {self.method}; leave it out."
                )
            options[keyword] = value
        if self.in_place and self.out is not None:
            raise ConfigError("give --out or --in-place, not both.")
        out = None if self.in_place else self.out or _beside(self.capture, "masked")
        policy = Policy(use=self.use)
        written = mask_capture(self.capture, out, method=self.method, policy=policy, **options)
        print(f"written: {written}")


@dataclass(frozen=True, kw_only=True)
class Poses:
    """Find the person's poses in a capture; write one with them.

    They are found in its pictures and events, offline (docs/poses.md).

    What is held out is neither looked at nor followed, unless told so.
    """

    capture: CaptureFolder
    out: Annotated[Path, option("FOLDER")]
    """The new capture; poses.html in it shows what was found."""
    search: Annotated[PoseSearch, FLAT]
    keypoints: Annotated[Path | None, option("FILE", default="found by the network")] = None
    """Key points of COCO (17, 133), OpenPose (25) or BlazePose (33)."""
    threads: Threads = None

    def __call__(self) -> None:
        from evsplat.devices import use_threads
        from evsplat.posing import find_poses

        use_threads(self.threads)
        found = find_poses(self.capture, self.out, self.search, keypoints=self.keypoints)
        print(found.summary)


@dataclass(frozen=True, kw_only=True)
class Restore:
    """Write a new capture whose frames are sharp at mid-exposure.

    For methods that do not model blur. All but the frames stays as it is.
    """

    capture: CaptureFolder
    out: Annotated[Path | None, option("FOLDER", default="CAPTURE-NAME")] = None
    """The new capture."""
    method: Annotated[
        Literal["edi", "nafnet", "mprnet", "efnet", "d2net", "e2vid", "pienet"],
        option("NAME", name="with"),
    ] = "edi"
    """edi (event double integral), or a network: of pictures (nafnet, mprnet), of events (e2vid,
    pienet) or of both (efnet, d2net); docs/restore.md."""
    contrast_threshold: Annotated[
        tuple[float, float] | None, option("C+ C-", default="the capture's, or estimated")
    ] = None
    """For edi: log-intensity change per brighter and darker event."""
    weights: Annotated[Path | None, option("FILE", default="EVSPLAT_NAME, or torch's cache")] = None
    """For networks but pienet: the published checkpoint, which you bring."""
    device: Device = "auto"
    """For networks: where they run."""
    use: Use = "training"
    """Source of restored training frames; everything looks at held-out frames too."""

    def __call__(self) -> None:
        from evsplat.capture import Policy
        from evsplat.restore import restore_capture

        is_network = self.method != "edi"
        options: dict[str, Any] = {}
        for name, fits in (
            ("contrast_threshold", not is_network),
            ("weights", is_network and self.method != "pienet"),
            ("device", is_network),
        ):
            value = getattr(self, name)
            if value is None or (value == "auto" and not fits):
                continue
            if not fits:
                raise ConfigError(
                    f"--{name.replace('_', '-')} means nothing to --with {self.method}; "
                    "leave it out."
                )
            options[name] = value
        out = self.out or _beside(self.capture, self.method)
        policy = Policy(use=self.use)
        written = restore_capture(self.capture, out, method=self.method, policy=policy, **options)
        print(f"written: {written}")


def _beside(capture: Path, ending: str) -> Path:
    """Folder beside a capture, named after it; beside the link where a link leads to it."""
    folder = Path(os.path.abspath(capture))
    return folder.with_name(f"{folder.name}-{ending}")
