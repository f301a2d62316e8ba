"""Drawing a trained run: its test frames, or a film of the recording or of another motion."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image
from tqdm import tqdm

from evsplat.errors import ConfigError, DataError
from evsplat.events import PRESETS
from evsplat.film.events import copy_events, event_picture, event_pictures, simulate_film
from evsplat.film.kept import KeptPictures, Shot, plan_of
from evsplat.film.looks import Look, depth_colours
from evsplat.film.scene import Scene, recorded_by
from evsplat.methods.trivial import nearest_in_time
from evsplat.options import Film
from evsplat.options.declare import given
from evsplat.pictures import to_bytes
from evsplat.pictures.video import write_animation, write_pictures, write_video
from evsplat.training.run import load_run

_NEAREST = 0.6
"""Depth that gets the lightest colour, as a share of the distance to the person."""
_VIDEO, _ANIMATION = (".mp4",), (".gif", ".webp")

Picture = UInt8[np.ndarray, "H W C"]


def render_run(
    run: Path | str,
    film: Film | None = None,
    *,
    out: Path | str | None = None,
    events_out: Path | str | None = None,
    device: str = "auto",
    **changes: Any,
) -> Path:
    """Draw a run's reconstruction and return the file or folder that was written.

    What is drawn is a `Film`, whose fields can be given as ``changes``. An ``out`` that ends in
    .mp4, .webp or .gif becomes a video or animation, any other a folder of PNG files; without it
    ``run/renders/`` receives it. ``events_out`` takes the simulated events of ``show="events"``,
    in any format that `evsplat.events.write_events` knows.

    Pictures are kept beside the result in ``NAME.partial`` until it is complete: when stopped, the
    same call goes on from there.
    """
    film = given(Film, film, changes)
    out = Path(run) / "renders" / film.file_name() if out is None else Path(out)
    ours = out.parent == Path(run) / "renders"
    _check_output(film, out, events_out, ours=ours)
    loaded = load_run(Path(run), device=device)
    if film.camera is not None and film.camera not in loaded.capture.cameras:
        known = ", ".join(loaded.capture.cameras)
        raise ConfigError(f"--camera {film.camera}: the capture has no such camera, only {known}.")
    scene = Scene.of(film, loaded.capture, loaded.reconstruction)
    look = Look(film.show, film.parts, film.transparent)
    plan = plan_of(
        scene.shots, look, film, loaded.method, loaded.iteration, loaded.train_seconds, *scene.poses
    )
    kept = KeptPictures(out.with_name(out.name + ".partial"), plan)
    kept.fill(scene.reconstruction, look, scene.shots)
    _write(film, scene, kept, out, events_out, replace=ours)
    kept.remove()
    return out


def _check_output(film: Film, out: Path, events_out: Path | str | None, *, ours: bool) -> None:
    """Refuse before hours of drawing what could not be written after them."""
    suffix = out.suffix.lower()
    if film.transparent and suffix in _VIDEO:
        raise ConfigError(
            "--transparent: mp4 cannot hold it; give --out a name in .webp or .gif or a folder."
        )
    if events_out is not None and film.show != "events":
        raise ConfigError("--events: goes with --show events, which simulates them.")
    if suffix == ".gif" and film.fps > 50:
        raise ConfigError(f"--fps {film.fps:g}: a GIF plays at most 50 pictures a second.")
    if suffix not in (*_VIDEO, *_ANIMATION):
        if out.exists() and not out.is_dir():
            raise DataError(f"{out}: is a file; give a folder or a name in .mp4, .webp or .gif.")
        if not ours and out.is_dir() and any(out.iterdir()):
            raise DataError(f"{out}: the folder is not empty; give a new one to --out.")


def _write(
    film: Film,
    scene: Scene,
    kept: KeptPictures,
    out: Path,
    events_out: Path | str | None,
    *,
    replace: bool,
) -> None:
    """Make the result of the kept pictures."""
    suffix = out.suffix.lower()
    folder = suffix not in (*_VIDEO, *_ANIMATION)
    shots = scene.shots
    names = [shot.name for shot in shots]
    if film.show == "events":
        settings = PRESETS[film.sensor]
        store = simulate_film(kept, shots, settings)
        if events_out is not None:
            copy_events(store, events_out, shots, settings)
        shots = shots[: -1 : scene.step]
        names = [f"{index:05d}" for index in range(len(shots))]
        pictures: Iterator[Picture] = event_pictures(store, scene.edges_us())
    elif film.show == "depth" and not folder:
        nearest = _NEAREST * scene.person_m()
        pictures = (depth_colours(kept.read(shot), nearest) for shot in shots)
    else:
        pictures = (kept.read(shot) for shot in shots)
    if film.beside:
        pictures = _beside(film, scene, shots, pictures)
    told = tqdm(
        pictures, total=len(shots), unit="picture", desc="write", dynamic_ncols=True, leave=False
    )
    if folder:
        named = zip(names, told, strict=True)
        write_pictures(out, named, replace=replace)
    elif suffix in _VIDEO:
        write_video(out, told, fps=film.fps)
    else:
        write_animation(out, told, fps=film.fps)


def _beside(
    film: Film, scene: Scene, shots: Sequence[Shot], pictures: Iterator[Picture]
) -> Iterator[Picture]:
    """The recorded frame or recorded events at the left of each picture."""
    capture = scene.capture
    frames = recorded_by(capture, film.camera)
    windows = zip(scene.edges_us()[:-1], scene.edges_us()[1:], strict=True)
    for shot, picture in zip(shots, pictures, strict=True):
        if film.show == "events":
            assert capture.events is not None
            recorded = capture.events.between(*next(windows))
            left = event_picture(recorded, capture.events.height, capture.events.width)
        else:
            left = to_bytes(capture.image(nearest_in_time(frames, shot.time_us)))
        yield _side_by_side(left, picture)


def _side_by_side(left: Picture, right: Picture) -> Picture:
    """Join two pictures; the left one is scaled to the height of the right one."""
    if left.shape[0] != right.shape[0]:
        width = round(left.shape[1] * right.shape[0] / left.shape[0])
        left = np.asarray(Image.fromarray(left).resize((width, right.shape[0])))
    return np.concatenate([left, right], axis=1)
