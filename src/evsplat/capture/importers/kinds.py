"""The kinds of sources by name, and the one function that imports any of them."""

import logging
from dataclasses import fields
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from evsplat.capture.importers.base import Importer
from evsplat.capture.importers.mmhpsd import Mmhpsd
from evsplat.capture.importers.neuman import Neuman
from evsplat.capture.importers.people_snapshot import PeopleSnapshot
from evsplat.capture.importers.zju_mocap import ZjuMocap
from evsplat.capture.importers.zju_mocap_blur import ZjuMocapBlur
from evsplat.capture.write import CaptureWriter
from evsplat.errors import ConfigError

logger = logging.getLogger(__name__)

KINDS: dict[str, type[Importer]] = {
    "zju-mocap": ZjuMocap,
    "mmhpsd": Mmhpsd,
    "neuman": Neuman,
    "people-snapshot": PeopleSnapshot,
    "zju-mocap-blur": ZjuMocapBlur,
}


def import_capture(
    kind: str,
    source: Path | str,
    out: Path | str,
    *,
    smpl: Path | str | None = None,
    overwrite: bool = False,
    **options: Any,
) -> Path:
    """Turn a data set's sequence into a capture and give its folder (docs/import.md).

    Args:
        kind: One of `KINDS`.
        source: The folder of one sequence.
        out: The capture to write; it appears when it is whole and valid.
        smpl: The user's SMPL file, or the folder that holds it; by default what the environment
            variable EVSPLAT_BODY_MODELS leads to. Without a model the free body is used.
        overwrite: Replace a capture that is there already.
        options: Fields of the kind's class in `KINDS`.

    Raises:
        DataError: The source is not what the kind says it is.
        ConfigError: An unknown kind or option, or a value out of range.
    """
    if kind not in KINDS:
        near = get_close_matches(kind, KINDS, 1, cutoff=0.0)[0]
        raise ConfigError(f"{kind!r} is no kind of source; did you mean {near!r}?")
    known = [field.name for field in fields(KINDS[kind])]
    for name in options:
        if name not in known:
            near = get_close_matches(name, known, 1, cutoff=0.0)[0]
            raise ConfigError(f"{name!r} is no option of {kind}; did you mean {near!r}?")
    return run_importer(KINDS[kind](**options), source, out, smpl=smpl, overwrite=overwrite)


def run_importer(
    importer: Importer,
    source: Path | str,
    out: Path | str,
    *,
    smpl: Path | str | None = None,
    overwrite: bool = False,
) -> Path:
    """`import_capture` with the options as a checked object."""
    out = Path(out)
    with CaptureWriter(out, overwrite=overwrite) as writer:
        notes = importer.write(Path(source), writer, None if smpl is None else Path(smpl))
    for note in notes:
        logger.info("%s", note)
    return out
