"""Drawing a trained run: its test frames, or the whole recording at any frame rate."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor
from tqdm import tqdm

from evsplat.capture import Camera, Capture, Frame
from evsplat.errors import ConfigError, DataError
from evsplat.export.video import write_pictures, write_video
from evsplat.methods.reconstruction import Parts, Reconstruction
from evsplat.training.run import load_run

_TIMES_AT_ONCE = 8


@dataclass(frozen=True)
class Instant:
    """One picture to draw."""

    name: str
    """File name without ending, where pictures are written one by one."""
    time_us: int
    frame: Frame
    """The recorded frame nearest in time: the picture for ``beside``."""


def rendered_instants(
    capture: Capture,
    what: Literal["sequence", "test"],
    *,
    rate_hz: float = 30.0,
    camera: str | None = None,
) -> list[Instant]:
    """Say which instants are drawn.

    ``test``: mid-exposure of each held-out frame. ``sequence``: from the first to the last
    mid-exposure (poses are known between them), ``rate_hz`` instants per second of the recording.
    Frames are those of ``camera`` where it recorded any, else those of the first camera.
    """
    frames = _recorded_by(capture, camera)
    if what == "test":
        frames = [frame for frame in frames if frame.split == "test"]
        if not frames:
            raise DataError(f"{capture.path}: no frame has split 'test'; render the sequence.")
        return [Instant(frame.name, frame.mid_us, frame) for frame in frames]
    mids = np.array([frame.mid_us for frame in frames])
    count = 1 + int((mids[-1] - mids[0]) * rate_hz / 1e6)
    times = mids[0] + np.rint(np.arange(count) * (1e6 / rate_hz)).astype(np.int64)
    nearest = np.searchsorted((mids[1:] + mids[:-1]) / 2, times)
    return [
        Instant(f"{index:05d}", int(time), frames[near])
        for index, (time, near) in enumerate(zip(times, nearest, strict=True))
    ]


def render_run(
    run: Path | str,
    *,
    what: Literal["sequence", "test"] = "sequence",
    out: Path | str | None = None,
    fps: float = 30.0,
    slow: float = 1.0,
    parts: Parts = "all",
    camera: str | None = None,
    beside: bool = False,
    device: str = "auto",
) -> Path:
    """Draw a run's reconstruction and return the file or folder that was written.

    An ``out`` that ends in .mp4 becomes a video, any other a folder of PNG files; without it
    ``run/renders/`` receives ``sequence*.mp4`` or ``test*/``. ``slow`` is how many times slower
    than life the sequence plays: ``fps * slow`` instants per second are drawn. ``beside`` puts
    the blurry frame nearest in time at the left. Nothing is left behind when it is interrupted.
    """
    if not 0 < fps <= 1000:
        raise ConfigError(f"--fps {fps:g}: expected a frame rate above 0 and at most 1000 Hz.")
    if not 0 < slow <= 10_000:
        raise ConfigError(f"--slow {slow:g}: expected a factor above 0 and at most 10000.")
    loaded = load_run(Path(run), device=device)
    capture = loaded.capture
    if camera is not None and camera not in capture.cameras:
        known = ", ".join(capture.cameras)
        raise ConfigError(f"--camera {camera}: the capture has no such camera, only {known}.")
    instants = rendered_instants(capture, what, rate_hz=fps * slow, camera=camera)
    pictures = _pictures(
        loaded.reconstruction, capture, instants, camera=camera, parts=parts, beside=beside
    )
    named = zip((instant.name for instant in instants), pictures, strict=True)
    if out is None:
        suffix = "".join(f"-{part}" for part in (parts, camera) if part not in (None, "all"))
        name = f"{what}{suffix}{'-beside' if beside else ''}"
        path = Path(run) / "renders" / (f"{name}.mp4" if what == "sequence" else name)
    else:
        path = Path(out)
    if path.suffix.lower() == ".mp4":
        write_video(path, pictures, fps=fps)
    else:
        write_pictures(path, named, replace=out is None)
    return path


def _recorded_by(capture: Capture, camera: str | None) -> list[Frame]:
    """Return the frames of one camera in the order of time."""
    recording = {frame.camera for frame in capture.frames}
    name = camera if camera in recording else capture.frames[0].camera
    return sorted((f for f in capture.frames if f.camera == name), key=lambda f: f.mid_us)


def camera_at(capture: Capture, name: str, time_us: int) -> Camera:
    """Return a camera of the capture at any time.

    A moving one is interpolated between the mid-exposures of its frames, where its poses are
    known: centre linearly, orientation along the shortest rotation; beyond the ends it stands.
    """
    frames = [frame for frame in capture.frames if frame.camera == name]
    if all(frame.world_to_camera is None for frame in frames):
        return capture.cameras[name]
    frames.sort(key=lambda frame: frame.mid_us)
    mids = np.array([frame.mid_us for frame in frames])
    after = int(np.clip(np.searchsorted(mids, time_us), 1, max(len(frames) - 1, 1)))
    ends = [capture.camera(frame) for frame in frames[after - 1 : after + 1]]
    if len(ends) == 1:
        return ends[0]
    share = float(np.clip((time_us - mids[after - 1]) / (mids[after] - mids[after - 1]), 0, 1))
    rotations = np.stack([end.world_to_camera[:3, :3].double().numpy() for end in ends])
    rotation = Slerp([0, 1], Rotation.from_matrix(rotations))(share).as_matrix()
    center = torch.lerp(ends[0].center().double(), ends[1].center().double(), share).numpy()
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3], world_to_camera[:3, 3] = rotation, -rotation @ center
    return replace(ends[0], world_to_camera=torch.from_numpy(world_to_camera).float())


@torch.no_grad()
def _pictures(
    reconstruction: Reconstruction,
    capture: Capture,
    instants: Sequence[Instant],
    *,
    camera: str | None,
    parts: Parts,
    beside: bool,
) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    """Draw the instants in order, several at once where the camera stands still."""
    at_once = _TIMES_AT_ONCE if capture.is_static_camera else 1
    with tqdm(total=len(instants), unit="picture", desc="render", dynamic_ncols=True) as progress:
        for start in range(0, len(instants), at_once):
            batch = instants[start : start + at_once]
            view = camera_at(capture, camera or batch[0].frame.camera, batch[0].time_us)
            rgb = reconstruction.render(view, [i.time_us for i in batch], parts=parts).rgb
            for instant, image in zip(batch, rgb, strict=True):
                picture = _to_bytes(image)
                if beside:
                    picture = _side_by_side(_to_bytes(capture.image(instant.frame)), picture)
                yield picture
                progress.update()


def _to_bytes(image: Float[Tensor, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    return (image.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def _side_by_side(
    left: UInt8[np.ndarray, "H W 3"], right: UInt8[np.ndarray, "H2 W2 3"]
) -> UInt8[np.ndarray, "H2 W3 3"]:
    """Join two pictures; the left one is scaled to the height of the right one."""
    if left.shape[0] != right.shape[0]:
        width = round(left.shape[1] * right.shape[0] / left.shape[0])
        left = np.asarray(Image.fromarray(left).resize((width, right.shape[0])))
    return np.concatenate([left, right], axis=1)
