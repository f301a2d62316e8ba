"""What the report is made of: the run's files and its capture."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import UInt8
from PIL import Image

from evsplat.capture import Capture
from evsplat.errors import DataError
from evsplat.evaluation.people import People
from evsplat.evaluation.regions import CROP_MARGIN, Box
from evsplat.files import read_json
from evsplat.methods.reconstruction import Reconstruction


@dataclass(frozen=True)
class Source:
    """An evaluated run, read from its folder."""

    folder: Path
    capture: Capture
    reconstruction: Reconstruction
    metrics: dict[str, Any]
    log: list[dict[str, Any]]
    """Lines of log.jsonl; empty for methods that do not train."""
    config: dict[str, Any]
    versions: dict[str, Any]

    @classmethod
    def read(cls, folder: Path, capture: Capture, reconstruction: Reconstruction) -> "Source":
        """Read the files of an evaluated run; only metrics.json must be there."""
        metrics_file = folder / "metrics.json"
        if not metrics_file.is_file():
            raise DataError(
                f"{metrics_file}: file not found; run `evsplat evaluate {folder}` first."
            )
        versions = folder / "versions.json"
        return cls(
            folder,
            capture,
            reconstruction,
            read_json(metrics_file),
            _read_log(folder / "log.jsonl"),
            _read_config(folder / "config.yaml"),
            read_json(versions) if versions.is_file() else {},
        )

    def picture(self, path: str) -> UInt8[np.ndarray, "H W 3"]:
        """A picture that the evaluation wrote, by its path inside the run folder."""
        try:
            with Image.open(self.folder / path) as image:
                return np.asarray(image.convert("RGB"))
        except OSError as error:
            raise DataError(
                f"{self.folder / path}: not readable ({error}); evaluate the run again."
            ) from error

    def person(self, frame_name: str) -> Box | None:
        """The box of the person in a test frame, enlarged as person_crop is."""
        frame = self.capture.frame(frame_name)
        _, box = People(self.capture).in_mask(frame)
        if not isinstance(box, Box):
            return None
        camera = self.capture.camera(frame)
        return box.enlarged(CROP_MARGIN, camera.height, camera.width)


def _read_log(path: Path) -> list[dict[str, Any]]:
    """The lines that are whole: a run that was killed may end in the middle of one."""
    if not path.is_file():
        return []
    lines = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            entry = json.loads(line)
        except json.JSONDecodeError:
            continue
        if isinstance(entry, dict):
            lines.append(entry)
    return lines


def _read_config(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    try:
        config = yaml.safe_load(path.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        raise DataError(f"{path}: not valid YAML ({error}).") from None
    return config if isinstance(config, dict) else {}
