"""Drawing a trained run: test frames, or a film of the recording or of another motion."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image
from tqdm import tqdm

from evsplat.devices import use_threads
from evsplat.errors import ConfigError, DataError
from evsplat.events import (
    PRESETS,
    EventStore,
    SensorSettings,
    count_map,
    simulate_events,
    write_events,
)
from evsplat.events.write import written_format
from evsplat.files import try_target
from evsplat.film.camera_path import check_camera
from evsplat.film.frame_cache import FilmFrame, FrameCache, film_digest
from evsplat.film.looks import Look, depth_colours, linear_luma
from evsplat.film.plan import FilmPlan, recorded_by
from evsplat.methods.trivial import nearest_in_time
from evsplat.options import Film
from evsplat.options.declare import given
from evsplat.pictures import signed_map, to_bytes
from evsplat.pictures.video import write_animation, write_pictures, write_video
from evsplat.training.run import Run, folder_of, opened

FILM_HEIGHT = 720
"""Least height of videos where none is asked for."""
_NEAREST = 0.6
"""Depth that gets the lightest colour, as a share of the distance to the person."""
_VIDEO, _ANIMATION = (".mp4",), (".gif", ".webp")
_WIDEST_PX = {".mp4": 16_384, ".webp": 16_382, ".gif": 65_534}
"""Even widths that x264, WebP and GIF can hold at most."""
_OTHERS = (".avi", ".mov", ".mkv", ".webm", ".m4v", ".png", ".jpg", ".jpeg")
"""Endings of what is asked for as a file and not written."""
_FULL_SCALE = 3.0
"""Events of a pixel in one picture that get the strongest colour."""
_PIECE_US = 100_000
"""Events are copied in pieces of this length."""

Picture = UInt8[np.ndarray, "H W C"]


def render_run(
    run: Run | Path | str,
    film: Film | None = None,
    *,
    out: Path | str | None = None,
    events_out: Path | str | None = None,
    device: str = "auto",
    threads: int | None = None,
    **changes: Any,
) -> Path:
    """Draw a run's reconstruction and return the file or folder that was written.

    ``run``: its folder, or what `load_run` read of it, on whose device it is then drawn.
    The `Film` to draw can be given by its fields, as ``changes``. An ``out`` that ends in
    .mp4, .webp or .gif becomes a video or animation, any other a folder of PNG files; without it
    ``run/renders/`` receives it. ``events_out`` takes the simulated events of ``show="events"``,
    in any format that `evsplat.events.write_events` knows. ``threads`` is the number of CPU threads
    that draw; None takes all cores.

    Pictures are kept beside the result in ``NAME.partial`` until it is complete: when stopped, the
    same call goes on from there. While another process makes it there is a `ConfigError`.
    """
    film = given(Film, film, changes)
    ours_at = folder_of(run) / "renders"
    out = ours_at / film.file_name() if out is None else Path(out)
    ours = out.parent == ours_at
    _check_output(film, out, events_out, ours=ours)
    for target in (out, events_out):
        if target is not None:
            try_target(target)
    use_threads(threads)
    loaded = opened(run, device=device)
    if film.camera is not None:
        check_camera(loaded.capture, film.camera)
    if _is_made_larger(film, out):
        height = max(camera.height for camera in loaded.capture.cameras.values())
        film = replace(film, size=max(FILM_HEIGHT, height))
    plan = FilmPlan.of(film, loaded.capture, loaded.reconstruction)
    _check_width(film, plan, out)
    transfer = loaded.capture.transfer(loaded.capture.frames[0])
    look = Look(film.show, film.parts, film.transparent, transfer, plan.surroundings)
    trained = loaded.method, loaded.iteration, loaded.train_seconds
    digest = film_digest(plan.frames, look, film, *trained, *plan.from_files)
    with FrameCache.held(out.with_name(out.name + ".partial"), digest) as cache:
        cache.fill(plan.reconstruction, look, plan.frames)
        _write(film, plan, cache, out, events_out, anew=ours)
        cache.remove()
    return out


def _is_made_larger(film: Film, out: Path) -> bool:
    """Whether the film is a video to look at, of which nobody says how large it shall be."""
    measured = film.what == "test" or film.show == "events"
    return film.size is None and not measured and out.suffix.lower() in (*_VIDEO, *_ANIMATION)


def _check_output(film: Film, out: Path, events_out: Path | str | None, *, ours: bool) -> None:
    """Refuse before hours of drawing what could not be written after them."""
    if not out.name:
        raise ConfigError(f"--out {out}: has no name of its own; give that of a folder or a file.")
    suffix = out.suffix.lower()
    if suffix in _OTHERS:
        raise ConfigError(
            f"--out {out}: a film is an .mp4, .webp or .gif, or a folder of PNG files; name one of "
            "these."
        )
    if film.transparent and suffix in _VIDEO:
        raise ConfigError(
            "--transparent: mp4 cannot hold it; give --out a name in .webp or .gif or a folder."
        )
    if events_out is not None:
        if film.show != "events":
            raise ConfigError("--events: goes with --show events, which simulates them.")
        written_format(Path(events_out))
    if suffix == ".gif" and film.fps > 50:
        raise ConfigError(f"--fps {film.fps:g}: a GIF plays at most 50 pictures a second.")
    if suffix not in (*_VIDEO, *_ANIMATION):
        if film.beside and film.show == "depth":
            raise ConfigError(
                "--beside: a folder holds depth in millimetres, which no picture fits beside; give "
                "--out a name in .mp4, .webp or .gif."
            )
        if out.exists() and not out.is_dir():
            raise DataError(f"{out}: is a file; give a folder or a name in .mp4, .webp or .gif.")
        if not ours and out.is_dir() and any(out.iterdir()):
            raise DataError(f"{out}: the folder is not empty; give a new one to --out.")


def _check_width(film: Film, plan: FilmPlan, out: Path) -> None:
    """Refuse before hours of drawing a film that is wider than its format."""
    most = _WIDEST_PX.get(out.suffix.lower())
    drawn = plan.frames[0].camera
    width = drawn.width
    if film.beside:
        if film.show == "events":
            recorded = drawn
        else:
            first = recorded_by(plan.capture, film.camera)[0]
            recorded = plan.capture.cameras[first.camera]
        width += _width_beside((recorded.width, recorded.height), drawn.height)
    if most is not None and width > most:
        raise ConfigError(
            f"--out {out}: the film would be {width} pixels wide, expected {most} at most; give a "
            "smaller --size, or a folder."
        )


def _write(
    film: Film,
    plan: FilmPlan,
    cache: FrameCache,
    out: Path,
    events_out: Path | str | None,
    *,
    anew: bool,
) -> None:
    """Make the result of the cached frames."""
    suffix = out.suffix.lower()
    folder = suffix not in (*_VIDEO, *_ANIMATION)
    frames = plan.frames
    names = [frame.name for frame in frames]
    if film.show == "events":
        settings = PRESETS[film.sensor]
        store = _simulate(cache, frames, settings)
        if events_out is not None:
            _copy_events(store, events_out, frames, settings)
        frames = frames[: -1 : plan.oversampling]
        names = [f"{index:05d}" for index in range(len(frames))]
        pictures: Iterator[Picture] = _event_pictures(store, plan)
    elif film.show == "depth" and not folder:
        nearest = _NEAREST * plan.human_distance_m
        pictures = (depth_colours(cache.read(frame), nearest) for frame in frames)
    else:
        pictures = (cache.read(frame) for frame in frames)
    if film.beside:
        pictures = _beside(film, plan, frames, pictures)
    counted = tqdm(
        pictures, total=len(frames), unit="picture", desc="write", dynamic_ncols=True, leave=False
    )
    if folder:
        write_pictures(out, zip(names, counted, strict=True), replace=anew)
    elif suffix in _VIDEO:
        write_video(out, counted, fps=film.fps)
    else:
        write_animation(out, counted, fps=film.fps)


def _simulate(
    cache: FrameCache, frames: Sequence[FilmFrame], settings: SensorSettings
) -> EventStore:
    """Show the cached light to a sensor and put its events into a store beside it."""
    path, camera = cache.path / "events.h5", frames[0].camera
    light = ((frame.clock_us, linear_luma(cache.read(frame))) for frame in frames)
    events = simulate_events(light, settings, 0)
    write_events(path, events, width=camera.width, height=camera.height)
    return EventStore(path, camera.width, camera.height)


def _copy_events(
    store: EventStore, out: Path | str, frames: Sequence[FilmFrame], settings: SensorSettings
) -> None:
    """Write the events to a file of any format that `write_events` knows."""
    start, end = frames[0].clock_us, frames[-1].clock_us + 1
    pieces = (store.between(at, min(at + _PIECE_US, end)) for at in range(start, end, _PIECE_US))
    sensor = {f"sensor_{name}": value for name, value in settings.to_dict().items()}
    attributes = {"simulated": True, "source": "evsplat render", **sensor}
    write_events(out, pieces, width=store.width, height=store.height, attributes=attributes)


def _event_pictures(store: EventStore, plan: FilmPlan) -> Iterator[Picture]:
    """One picture per window of the plan: red brighter, blue darker, white neither."""
    edges = plan.edges_us()
    for window in zip(edges[:-1], edges[1:], strict=True):
        counts = count_map(store.between(*window), store.height, store.width)
        yield signed_map(counts, _FULL_SCALE)


def _beside(
    film: Film, plan: FilmPlan, frames: Sequence[FilmFrame], pictures: Iterator[Picture]
) -> Iterator[Picture]:
    """The recorded frame or recorded events at the left of each picture."""
    capture = plan.capture
    if film.show == "events":
        assert capture.events is not None
        recorded: Iterator[Picture] = _event_pictures(capture.events, plan)
    else:
        frames_recorded = recorded_by(capture, film.camera)
        nearest = (nearest_in_time(frames_recorded, frame.time_us) for frame in frames)
        recorded = (to_bytes(capture.shown(capture.image(frame))) for frame in nearest)
    for left, right in zip(recorded, pictures, strict=True):
        yield _side_by_side(left, right)


def _side_by_side(left: Picture, right: Picture) -> Picture:
    """Join two pictures; the left one is scaled to the height of the right one."""
    height = right.shape[0]
    if left.shape[0] != height:
        width = _width_beside((left.shape[1], left.shape[0]), height)
        left = np.asarray(Image.fromarray(left).resize((width, height)))
    return np.concatenate([left, right], axis=1)


def _width_beside(size: tuple[int, int], height: int) -> int:
    """Width of a picture of (width, height) beside another, scaled to the height of that one."""
    return size[0] if size[1] == height else 2 * round(size[0] * height / size[1] / 2)
