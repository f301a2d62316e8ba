"""A suite: captures x rows x seeds, read from a YAML file or from those that ship."""

import re
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Annotated

from evsplat.benching.cell import UNTRAINED
from evsplat.benching.drawn import Draw
from evsplat.benching.given_pictures import PICTURES
from evsplat.config import from_dict, load_yaml
from evsplat.errors import ConfigError
from evsplat.ranges import SEEDS, Above, AtLeast
from evsplat.staging import StageSettings

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]{0,99}")


@dataclass(frozen=True)
class SuiteCapture:
    """A capture of a suite: one on the disk, the packaged one, or one that is staged."""

    name: str
    """The capture's name in tables and folders."""
    path: str | None = None
    """Capture folder, relative to the working directory; ``demo`` is the one that ships."""
    stage: StageSettings | None = None
    """Settings of `evsplat stage`; the capture is made in the results folder when it is needed."""
    get: str | None = None
    """The command that makes the capture, for the message that it is missing."""


@dataclass(frozen=True)
class Published:
    """Figures of a publication for a row: means over `PublishedTable.captures`."""

    psnr: float
    """PSNR, dB."""
    ssim: float
    lpips: float


@dataclass(frozen=True)
class SuiteRow:
    """One line of the table."""

    name: str
    """The row's name in files and for ``--only``."""
    method: str
    """A method that is trained, ``median_background``, ``nearest_frame``, ``pictures`` or
    ``own_picture``: what the camera itself recorded of a test frame."""
    title: str | None = None
    """The row's title in tables; the name where it is not given."""
    restore: str | None = None
    """Restoration of the training frames before (`evsplat restore --with`)."""
    backdrop: bool = False
    """Measure it before the median of the training frames: for a person without a scene, of whom
    black says nothing on a full frame."""
    settings: tuple[str, ...] = ()
    """Settings of the method as for ``--set``: ``event_weight=0``."""
    iterations: Annotated[int | None, AtLeast(1)] = None
    """Training steps of this row in place of the suite's: methods need different numbers."""
    published: Published | None = None
    pictures: str | None = None
    """Folder with pictures that were made elsewhere, for method ``pictures``: one folder per
    capture, in it ``FRAME.png`` for every test frame (`evsplat bench --add`)."""

    added: bool = False
    """Whether ``--add`` brought the row, and no suite names it."""

    @property
    def label(self) -> str:
        """Title of the row, or its name."""
        return self.title or self.name


@dataclass(frozen=True)
class PublishedTable:
    """The table of a publication that published figures come from."""

    title: str
    captures: tuple[str, ...]
    """Names of the captures that they are means over."""


@dataclass(frozen=True)
class Suite:
    """Captures x rows x seeds that are compared."""

    name: str
    rows: tuple[SuiteRow, ...]
    captures: tuple[SuiteCapture, ...] = ()
    draw: Draw | None = None
    """Captures drawn at random in place of named ones."""
    title: str = ""
    seeds: Annotated[tuple[int, ...], SEEDS] = (0,)
    iterations: Annotated[int | None, AtLeast(1)] = None
    """Training steps of every row that names none itself; None: the method's own."""
    max_minutes: Annotated[float | None, Above(0)] = None
    """Minutes of training of every cell; the schedule is shortened to be finished by then."""
    published: PublishedTable | None = field(default=None)


def shipped_suites() -> dict[str, Path]:
    """Suites inside the package, by name."""
    folder = Path(str(resources.files("evsplat") / "benching" / "suites"))
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def read_suite(suite: Path | str) -> Suite:
    """A suite by the name of a shipped one or by the path of a YAML file.

    Raises:
        ConfigError: There is no such suite, a key is unknown (the nearest is named), a name occurs
            twice or is no file name.
    """
    shipped = shipped_suites()
    path = shipped.get(str(suite), Path(suite))
    if not path.is_file():
        raise ConfigError(
            f"{suite}: no such suite; give the path of a YAML file or one of {', '.join(shipped)}."
        )
    read = from_dict(Suite, load_yaml(path), where=str(path))
    for kind, names in (
        ("suite", [read.name]),
        ("row", [row.name for row in read.rows]),
        ("capture", [capture.name for capture in read.captures]),
    ):
        check_names(kind, names, str(path))
    for capture in read.captures:
        if (capture.path is None) == (capture.stage is None):
            raise ConfigError(f"{path}: capture {capture.name}: expected either path or stage.")
    if read.captures and read.draw is not None:
        raise ConfigError(f"{path}: captures and draw both say what to run on; keep one of them.")
    for row in read.rows:
        if (row.method == PICTURES) != bool(row.pictures):
            raise ConfigError(
                f"{path}: row {row.name}: method {PICTURES} and the folder 'pictures' belong "
                "together."
            )
        if row.method in UNTRAINED and row.settings:
            raise ConfigError(
                f"{path}: row {row.name}: settings are those of a method that is trained, and "
                f"{row.method} is not; leave them out."
            )
        if any(setting.partition("=")[0] == "iterations" for setting in row.settings):
            raise ConfigError(
                f"{path}: row {row.name}: iterations is no setting here; give it as the row's own "
                "key 'iterations'."
            )
    if not read.rows:
        raise ConfigError(f"{path}: rows is empty, expected at least one.")
    return replace(read, seeds=tuple(dict.fromkeys(read.seeds)))


def check_names(kind: str, names: list[str], where: str) -> None:
    """Names become files: refuse those that cannot, and those that occur twice."""
    for name in names:
        if not _NAME.fullmatch(name):
            raise ConfigError(
                f"{where}: {kind} {name!r}: expected up to 100 letters, digits, '.', '_', '+' and "
                "'-'."
            )
        if names.count(name) > 1:
            raise ConfigError(f"{where}: two {kind}s are named {name}; give each its own name.")
