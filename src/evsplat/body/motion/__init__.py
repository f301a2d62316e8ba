"""Motion capture files as `SkeletonMotion`, which `evsplat.body.retarget` puts on any body."""

from pathlib import Path

from evsplat.body.motion.acclaim import read_acclaim
from evsplat.body.motion.bvh import read_bvh
from evsplat.body.motion.deepmimic import read_deepmimic
from evsplat.body.motion.limits import checked_motion
from evsplat.body.retarget import SkeletonMotion
from evsplat.errors import DataError

__all__ = ["load_motion"]


def load_motion(path: Path | str) -> SkeletonMotion:
    """The motion in a file: DeepMimic ``.txt``, Acclaim ``.amc``, or ``.bvh``.

    The skeleton of an ``.amc`` is the ``.asf`` beside it whose name begins it (``02.asf`` for
    ``02_05.amc``).

    Raises:
        DataError: the file is missing, of another kind or damaged.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".amc":
        return checked_motion(read_acclaim(path, _skeleton_beside(path)))
    if suffix == ".bvh":
        return checked_motion(read_bvh(path))
    if suffix in (".txt", ".json"):
        return checked_motion(read_deepmimic(path))
    raise DataError(
        f"{path}: motion files end in .bvh, .amc (with an .asf) or .txt (DeepMimic); convert it."
    )


def _skeleton_beside(path: Path) -> Path:
    names = [path.stem, path.stem.split("_")[0]]
    for name in names:
        if path.with_name(f"{name}.asf").is_file():
            return path.with_name(f"{name}.asf")
    raise DataError(
        f"{path}: its skeleton {' or '.join(f'{name}.asf' for name in dict.fromkeys(names))} is "
        "not beside it; put it there."
    )
