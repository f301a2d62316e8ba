"""Pictures kept while a film is made, so that one that was stopped goes on where it was."""

import hashlib
import json
import logging
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from tqdm import tqdm

from evsplat.capture import Camera
from evsplat.errors import DataError
from evsplat.files import atomic_path, write_json
from evsplat.film.looks import Exposure, Look
from evsplat.methods.reconstruction import Reconstruction
from evsplat.names import checked_name

logger = logging.getLogger(__name__)

_TIMES_AT_ONCE = 8
_PLAN = "plan.json"


@dataclass(frozen=True, eq=False)
class Shot:
    """One exposure."""

    name: str
    """File name without ending."""
    time_us: int
    """Of the person: the camera's clock, or the time since a motion's start."""
    clock_us: int
    """Since the film's start, or the camera's clock; it goes on where the person is held."""
    camera: Camera


class KeptPictures:
    """A folder of exposures beside the film that is being made.

    It belongs to one plan: pictures of another one (other options, a run that was trained further)
    are thrown away, which is logged.
    """

    def __init__(self, path: Path, plan: str) -> None:
        self.path = path
        told = path / _PLAN
        if path.exists() and not told.is_file():
            raise DataError(f"{path}: is in the way of pictures to be kept; move it elsewhere.")
        if told.is_file() and json.loads(told.read_text(encoding="utf-8"))["plan"] != plan:
            logger.info("%s: kept pictures belong to other options; starting over.", path)
            shutil.rmtree(path)
        path.mkdir(parents=True, exist_ok=True)
        write_json(told, {"plan": plan})

    def __len__(self) -> int:
        """Count of pictures."""
        return sum(1 for _ in self.path.glob("*.png"))

    def file(self, shot: Shot) -> Path:
        """Where the picture of a shot is or will be."""
        return self.path / f"{checked_name(shot.name, 'a picture')}.png"

    def read(self, shot: Shot) -> Exposure:
        """A kept picture."""
        with Image.open(self.file(shot)) as image:
            return np.asarray(image)

    def remove(self) -> None:
        """Throw all away."""
        shutil.rmtree(self.path)

    @torch.no_grad()
    def fill(self, reconstruction: Reconstruction, look: Look, shots: Sequence[Shot]) -> None:
        """Expose what is missing, several times at once where the camera stands still."""
        missing = [shot for shot in shots if not self.file(shot).is_file()]
        try:
            with tqdm(
                total=len(shots),
                initial=len(shots) - len(missing),
                unit="picture",
                desc="render",
                dynamic_ncols=True,
            ) as progress:
                for batch in _of_one_camera(missing):
                    times = [shot.time_us for shot in batch]
                    exposures = look.expose(reconstruction, batch[0].camera, times)
                    for shot, exposure in zip(batch, exposures, strict=True):
                        with atomic_path(self.file(shot)) as temporary:
                            Image.fromarray(exposure).save(temporary, compress_level=1)
                        progress.update()
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"Stopped; {len(self)} of {len(shots)} pictures are kept in {self.path}. "
                "The same command goes on from there."
            ) from None


def plan_of(shots: Iterable[Shot], *rest: object) -> str:
    """A digest of what is filmed: equal exactly where all pictures are."""
    digest = hashlib.sha256()
    for shot in shots:
        digest.update(f"{shot.name} {shot.time_us} {shot.clock_us}".encode())
        camera = shot.camera
        digest.update(f"{camera.width} {camera.height}".encode())
        digest.update(camera.K.cpu().numpy().tobytes())
        digest.update(camera.world_to_camera.cpu().numpy().tobytes())
    for value in rest:
        digest.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
    return digest.hexdigest()


def _of_one_camera(shots: Sequence[Shot]) -> Iterable[list[Shot]]:
    batch: list[Shot] = []
    for shot in shots:
        if batch and (shot.camera is not batch[0].camera or len(batch) == _TIMES_AT_ONCE):
            yield batch
            batch = []
        batch.append(shot)
    if batch:
        yield batch
