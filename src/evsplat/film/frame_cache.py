"""Frames cached on disk while a film is made: one that was stopped goes on where it was."""

import hashlib
import logging
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import groupby, islice
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from tqdm import tqdm

from evsplat.camera import Camera
from evsplat.errors import DataError
from evsplat.files import atomic_path, held_folder, remove_file, remove_folder, write_json
from evsplat.film.looks import Exposure, Look
from evsplat.meanwhile import meanwhile
from evsplat.names import checked_name
from evsplat.training.reconstruction import GaussianReconstruction
from evsplat.untrusted.pictures import read_picture
from evsplat.untrusted.text import read_json

logger = logging.getLogger(__name__)

_TIMES_AT_ONCE = 8
_KEPT_BYTES = 64 << 20
"""Of a film's first frames, which are not read back from the disk."""
_PLAN = "plan.json"
_SIGN = ".filming"
"""File in the folder that is there while a film is made of it, and whose lock is held then."""


@dataclass(frozen=True, eq=False)
class FilmFrame:
    """One picture of a film to draw."""

    name: str
    """File name without ending."""
    time_us: int
    """The person's time: the camera's clock, or the time since a motion's start."""
    clock_us: int
    """The film's time: since its start, or the camera's clock; it goes on where the person is
    held."""
    camera: Camera


class FrameCache:
    """A folder of drawn frames beside the film that is being made.

    It belongs to one digest: frames of another one (other options, a run that was trained further)
    are thrown away, which is logged.
    """

    def __init__(self, path: Path, digest: str) -> None:
        """Only for who holds the folder: see `held`."""
        self.path = path
        self._drawn: dict[Path, Exposure] = {}
        self._left_bytes = _KEPT_BYTES
        plan = path / _PLAN
        if plan.is_file() and read_json(plan) != {"plan": digest}:
            logger.info("%s: kept pictures belong to other options; starting over.", path)
            for file in path.iterdir():
                if file.name not in (_PLAN, _SIGN):
                    remove_file(file)
        write_json(plan, {"plan": digest})

    @classmethod
    @contextmanager
    def held(cls, path: Path, digest: str) -> "Iterator[FrameCache]":
        """The cache at ``path`` to the end of the block.

        Raises:
            ConfigError: Another process makes a film of it.
            DataError: Something else is there.
        """
        plan = path / _PLAN
        if path.is_file() or (path.is_dir() and not plan.is_file() and _holds_others(path)):
            raise DataError(f"{path}: is in the way of pictures to be kept; move it elsewhere.")
        busy = "makes this film; wait for its end or give another name to --out."
        with held_folder(path, _SIGN, busy):
            yield cls(path, digest)

    def __len__(self) -> int:
        """Number of frames drawn so far."""
        return sum(1 for _ in self.path.glob("*.png"))

    def file(self, frame: FilmFrame) -> Path:
        """Path of a frame's picture, drawn or not."""
        return self.path / f"{checked_name(frame.name, 'a picture')}.png"

    def read(self, frame: FilmFrame) -> Exposure:
        """The picture of a frame that was drawn; not to be written to."""
        file = self.file(frame)
        if file in self._drawn:
            return self._drawn[file]
        return read_picture(file, np.asarray, remedy="remove it")

    def remove(self) -> None:
        """Delete the folder with all frames."""
        remove_folder(self.path)

    @torch.no_grad()
    def fill(
        self, reconstruction: GaussianReconstruction, look: Look, frames: Sequence[FilmFrame]
    ) -> None:
        """Draw what is missing, several times at once where the camera stands still.

        While some are drawn those before are written. What was drawn is kept where it is stopped.
        A film that goes on is, bit for bit, the one that was never stopped.
        """
        missing = {frame for frame in frames if not self.file(frame).is_file()}
        try:
            with (
                tqdm(
                    total=len(frames),
                    initial=len(frames) - len(missing),
                    unit="picture",
                    desc="render",
                    dynamic_ncols=True,
                ) as progress,
                meanwhile() as do,
            ):
                for batch in _of_one_camera(frames):
                    if not any(frame in missing for frame in batch):
                        continue
                    # All of them: one drawn beside fewer others differs in its last bits.
                    times = [frame.time_us for frame in batch]
                    exposures = look.expose(reconstruction, batch[0].camera, times)
                    for frame, exposure in zip(batch, exposures, strict=True):
                        if frame in missing:
                            do(self._write, frame, exposure)
                            progress.update()
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"Stopped; {len(self)} of {len(frames)} pictures are kept in {self.path}. "
                "The same command goes on from there."
            ) from None

    def _write(self, frame: FilmFrame, exposure: Exposure) -> None:
        file = self.file(frame)
        with atomic_path(file) as temporary:
            Image.fromarray(exposure).save(temporary, compress_level=1)
        if exposure.nbytes <= self._left_bytes:
            self._left_bytes -= exposure.nbytes
            self._drawn[file] = exposure


def film_digest(frames: Iterable[FilmFrame], *rest: object) -> str:
    """A digest of a film's frames and options: equal exactly where all pictures are."""
    digest = hashlib.sha256()
    for frame in frames:
        digest.update(f"{frame.name} {frame.time_us} {frame.clock_us}".encode())
        camera = frame.camera
        digest.update(f"{camera.width} {camera.height}".encode())
        digest.update(camera.K.cpu().numpy().tobytes())
        digest.update(camera.world_to_camera.cpu().numpy().tobytes())
    for value in rest:
        digest.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
    return digest.hexdigest()


def _holds_others(folder: Path) -> bool:
    """Whether there is more in a folder than the sign of who has just begun, or was killed."""
    return any(file.name != _SIGN for file in folder.iterdir())


def _of_one_camera(frames: Sequence[FilmFrame]) -> Iterable[list[FilmFrame]]:
    """Batches of neighbouring frames that one camera sees."""
    for _, neighbours in groupby(frames, key=lambda frame: id(frame.camera)):
        while batch := list(islice(neighbours, _TIMES_AT_ONCE)):
            yield batch
