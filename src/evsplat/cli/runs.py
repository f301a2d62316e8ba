"""Verbs that make runs, measure them and show them; the table printed after an evaluation."""

import sys
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional

from evsplat.cli.captures import Poses
from evsplat.commands import command
from evsplat.options import BenchOptions, ExportOptions, Film, PoseSearch, TrainOptions
from evsplat.options.declare import (
    FLAT,
    CaptureFolder,
    Device,
    Flag,
    NewRun,
    Port,
    RunFolder,
    Threads,
    check_options,
    option,
)
from evsplat.options.inputs import Input, check_run_folder, check_run_or_training
from evsplat.options.runs import Kind, Split
from evsplat.shipped import demo_capture

if TYPE_CHECKING:
    from evsplat.training import Run


def demo(
    *,
    out: NewRun = None,
    max_minutes: Annotated[
        float, option("M", "Minutes of training; evaluation and report come on top.")
    ] = 2.5,
    find_poses: Annotated[
        Flag, option(help="Take its poses away and find them again, in captures/.")
    ] = False,
    device: Annotated[Device, option(help="Device that computes.")] = "auto",
    threads: Threads = None,
) -> None:
    """Train on the packaged capture, evaluate it and write a report.

    A synthetic dancer, 72 ms of blur per frame, with events and ground truth.
    """
    capture = demo_capture()
    options = TrainOptions(out=out, max_minutes=max_minutes, device=device, threads=threads)
    if find_poses:
        capture, given = Path("captures") / f"demo_{datetime.now():%Y-%m-%d_%H-%M-%S}", capture
        Poses(capture=given, out=capture, search=PoseSearch(), threads=threads)()
    _Demo(capture=capture, options=options)()


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Print every setting of a method with its meaning, range and default.

    This is a configuration: change it for 'evsplat train CAPTURE --config FILE'.
    """

    method: Annotated[str | None, option("NAME", default="evsplat")] = None
    """Name of the method."""

    def __call__(self) -> None:
        from evsplat.config_docs import explained_yaml
        from evsplat.methods import DEFAULT_METHOD, method_config

        method = self.method or DEFAULT_METHOD
        print(explained_yaml(method_config(method, {}, where="defaults"), method=method), end="")


@dataclass(frozen=True, kw_only=True)
class Train:
    """Train a method on a capture, then evaluate it and write report.html.

    Ctrl-C finishes the step, saves a checkpoint and says how to resume.
    """

    capture: CaptureFolder
    options: Annotated[TrainOptions, FLAT]
    evaluate: Flag = True
    """Skip the evaluation and the report at the end."""
    view: Flag = False
    """Show the run in the browser while it is trained, and afterwards until Ctrl-C."""
    port: Port = 8080

    def __post_init__(self) -> None:
        check_options(self)

    def __call__(self) -> None:
        from evsplat.cli.viewer_process import ViewerProcess
        from evsplat.training import Stopped, train

        viewer = ViewerProcess(self.port) if self.view else None
        try:
            run = train(self.capture, self.options, on_start=viewer.start if viewer else None)
            if self.evaluate:
                self._evaluate(run)
            else:
                print(f"run: {run}")
            if viewer:
                viewer.wait()
        except Stopped as stop:
            again = command("train", self.capture, "--out", stop.run, "--resume")
            raise KeyboardInterrupt(f"Stopped and saved. Go on with: {again}") from None
        finally:
            if viewer:
                viewer.close()

    def _evaluate(self, run: Path) -> None:
        try:
            self._finish(run)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                "Stopped; the training is finished and saved. Go on with: "
                f"{command('evaluate', run)}"
            ) from None

    def _finish(self, run: Path) -> None:
        _measure(run, device=self.options.device)


@dataclass(frozen=True, kw_only=True)
class _Demo(Train):
    """Training that is filmed before its report is written, which shows the films."""

    def _finish(self, run: Path) -> None:
        from evsplat.export import export_run, render_run
        from evsplat.training import load_run

        device = self.options.device
        loaded = load_run(run, device=device)
        for film in _DEMO_FILMS:
            render_run(loaded, film, threads=self.options.threads)
        export_run(loaded, "avatar", out=run / "exports" / "avatar.html")
        _measure(loaded, device=device)


_DEMO_FILMS = (
    Film(motion="spin", path="orbit", size=360, seconds=4.0, fps=25.0),
    Film(path="swing", at=1.0, size=360, seconds=3.0, fps=25.0),
)
"""Another motion from all sides, and one instant of the recording from both sides."""


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Measure a run on its test frames: metrics.json, tables, pictures, report.html."""

    run: RunFolder
    split: Annotated[Split, option("SPLIT")] = "test"
    """Frames to measure: test, or train (then metrics_train.json and so on)."""
    lpips_weights: Annotated[Path | None, option("FILE", default="torch hub cache")] = None
    """Backbone weights for LPIPS; without any it stays empty, with the reason."""
    device: Device = "auto"
    """Device that draws and compares."""

    def __call__(self) -> None:
        _measure(self.run, device=self.device, lpips_weights=self.lpips_weights, split=self.split)


@dataclass(frozen=True, kw_only=True)
class Report:
    """Write report.html of an evaluated run again."""

    run: Annotated[Positional[Path], option("RUN"), Input(check_run_folder)]
    """Run folder with metrics.json (made by 'evsplat evaluate')."""
    split: Annotated[Split, option("SPLIT")] = "test"
    """Frames whose figures it shows: test, or train ('evsplat evaluate --split train')."""

    def __call__(self) -> None:
        from evsplat.evaluation.run import write_report

        print(f"report: {write_report(self.run, split=self.split)}")


@dataclass(frozen=True, kw_only=True)
class Render:
    """Film a run, the recording or another motion, as video or pictures.

    When stopped, the same command goes on where it was. More: docs/render.md.
    """

    run: RunFolder
    out: Annotated[Path | None, option("PATH", default="in RUN/renders")] = None
    """NAME.mp4, .webp, .gif or a folder."""
    film: Annotated[Film, FLAT]
    events: Annotated[Path | None, option("FILE", default="no")] = None
    """Write its events as well, such as to events.h5."""
    device: Device = "auto"
    """Device that draws."""
    threads: Threads = None

    def __call__(self) -> None:
        from evsplat.export import render_run

        written = render_run(
            self.run,
            self.film,
            out=self.out,
            events_out=self.events,
            device=self.device,
            threads=self.threads,
        )
        print(f"written: {written}")


@dataclass(frozen=True, kw_only=True)
class View:
    """Show a run in the browser: any time, any viewpoint, beside its input or another."""

    run: Annotated[
        Positional[Path],
        option("RUN", "Run folder written by 'evsplat train', or of one that trains."),
        Input(check_run_or_training),
    ]
    other: Annotated[
        Positional[Path | None],
        option("[RUN2]", default="no comparison"),
        Input(check_run_or_training),
    ] = None
    """A second run of the same capture to compare with."""
    port: Port = 8080
    host: Annotated[str, option("ADDRESS", default="127.0.0.1, this machine alone")] = "127.0.0.1"
    """Network to listen at; 0.0.0.0 lets other machines in."""
    device: Device = "auto"
    """Device that draws."""
    threads: Threads = None

    def __post_init__(self) -> None:
        check_options(self)

    def __call__(self) -> None:
        from evsplat.view import view_run

        view_run(
            self.run,
            self.other,
            port=self.port,
            host=self.host,
            device=self.device,
            threads=self.threads,
        )


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write a run as a file for other programs, in metres: docs/export.md.

    ply, spz, splat and gltf hold the Gaussians of one instant.

    html is a page that plays the recording in 3D, avatar one with a person to pose.

    bvh and skeleton (glTF) hold the motion alone.
    """

    run: RunFolder
    kind: Annotated[Positional[Kind], option("KIND")]
    """ply, spz, splat, gltf, html, avatar, bvh or skeleton."""
    options: Annotated[ExportOptions, FLAT]

    def __call__(self) -> None:
        from evsplat.export import export_run

        print(f"written: {export_run(self.run, self.kind, self.options)}")


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Run a suite of captures x methods x seeds; write tables and a page.

    What is finished stays; the same command goes on after Ctrl-C, a crash or kill.
    """

    suite: Annotated[Positional[str], option("SUITE")]
    """ablation, grid, mmhpsd-blur, stage, zju-mocap-blur or a YAML file (docs/bench.md)."""
    options: Annotated[BenchOptions, FLAT]

    def __call__(self) -> None:
        from evsplat.benching.run import Stopped, bench

        try:
            folder = bench(self.suite, self.options)
        except Stopped as stop:
            raise KeyboardInterrupt(f"{stop} Go on with: {command(*sys.argv[1:])}") from None
        print(f"tables: {folder / 'tables.md'}\npage:   {folder / 'index.html'}")


def _measure(
    run: "Run | Path",
    *,
    device: Device,
    lpips_weights: Path | None = None,
    split: Split = "test",
) -> None:
    """Measure a run and report it; print its figures, where the report is and how to view it."""
    from evsplat.evaluation.run import evaluate_and_report

    metrics, report = evaluate_and_report(
        run, lpips_weights=lpips_weights, device=device, split=split
    )
    print(summary_table(metrics))
    print(f"run:    {report.parent}\nreport: {report}\nview:   {command('view', report.parent)}")


def summary_table(metrics: dict[str, Any]) -> str:
    """Format PSNR (dB) / SSIM of protocol 'standard' per region: the run and the trivial rows.

    The last row is what the camera itself took at those times, which no method sees.
    """
    from evsplat.evaluation.protocols import REGIONS
    from evsplat.evaluation.splits import count_of, words_of
    from evsplat.evaluation.tables import (
        composited,
        input_is_truth,
        standard_gaps,
        terms,
        without_truth,
    )

    if not count_of(metrics):
        return f"No test figures. {terms(metrics)}"
    if why := without_truth(metrics):
        return f"No figures. {why} Look at the pictures of the report. {terms(metrics)}"
    rows = {
        metrics["method"]: metrics["protocols"]["standard"],
        **composited(metrics),
        **metrics["trivial"],
    }
    if not input_is_truth(metrics):
        rows["own blurry picture"] = metrics["blurry_input"]
    width = max(map(len, rows))
    head = "".join(f"{region.replace('_', ' '):>18}" for region in REGIONS)
    frames = words_of(metrics).title.lower()
    lines = [f"PSNR dB / SSIM on the {frames}, protocol 'standard'\n{'':{width}}{head}"]
    for name, regions in rows.items():
        cells = "".join(f"{_cell(regions[region]):>18}" for region in REGIONS)
        lines.append(f"{name:{width}}{cells}")
    return "\n".join([*lines, *standard_gaps(metrics), terms(metrics)])


def _cell(values: dict[str, float | None] | None) -> str:
    """Format one region; a figure that could not be measured is a dash."""
    values = values or {}
    psnr, ssim = values.get("psnr"), values.get("ssim")
    return f"{'-' if psnr is None else f'{psnr:.2f}'} / {'-' if ssim is None else f'{ssim:.3f}'}"
