"""``evsplat import``: turn a data set, or your own recording, into a capture."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, make_dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal, Union

import tyro

from evsplat.commands import command
from evsplat.errors import ConfigError
from evsplat.options import PoseOptions
from evsplat.options.declare import FLAT, CaptureFolder, Flag, option


def import_() -> None:
    """Turn a data set, or your own recording, into a capture.

    See 'evsplat import KIND --help' for the options of a kind, docs/import.md for the trees.
    """


@dataclass(frozen=True, kw_only=True)
class _Import:
    """The import of a kind of source."""

    source: Annotated[tyro.conf.Positional[Path], option("SOURCE")]
    """Folder, video or recording (docs/import.md shows each)."""
    out: Annotated[Path, option("CAPTURE")]
    """Capture to write."""
    options: Any
    """The `Importer` of the kind."""
    smpl: Annotated[Path | None, option("PATH", default="EVSPLAT_BODY_MODELS")] = None
    """Your SMPL model file, or the folder that holds it."""
    overwrite: Flag = False
    """Replace a capture that is there."""

    def __call__(self) -> None:
        from evsplat.importers import run_importer

        path = run_importer(
            self.options,
            self.source,
            self.out,
            smpl=self.smpl,
            overwrite=self.overwrite,
            **self.going_on(),
        )
        print(f"written: {path}\nlook at it with: {command('inspect', path)}")
        if (path / "poses.html").is_file():
            print(f"and at its poses: {path / 'poses.html'}\nthen: {command('train', path)}")

    def going_on(self) -> dict[str, Any]:
        """What follows the import, as arguments of `run_importer`."""
        return {}


@dataclass(frozen=True, kw_only=True)
class _ImportToPose(_Import):
    """The import of a recording whose poses may have to be found."""

    find_poses: Flag = False
    """Go on to find the person's poses: evsplat poses, whose options follow."""
    search: Annotated[PoseOptions, FLAT]
    keypoints: Annotated[Path | None, option("FILE", default="found by the network")] = None
    """Key points of COCO (17, 133), OpenPose (25) or BlazePose (33)."""

    def going_on(self) -> dict[str, Any]:
        if self.find_poses:
            return {"poses": self.search, "keypoints": self.keypoints}
        if self.search != PoseOptions() or self.keypoints is not None:
            raise ConfigError(
                "--body, --height, --refine, --use, --held-out-events and --keypoints belong to "
                "--find-poses; leave them out, or give it as well."
            )
        return {}


@dataclass(frozen=True, kw_only=True)
class _ImportToBlur(_Import):
    """The import of a data set that the paper makes blurry."""

    blur: Flag = False
    """Go on to the paper's version: blurry frames and simulated events. The sharp capture stays
    beside it, with _sharp at the end of its name."""
    interpolation: Annotated[
        Literal["super-slomo", "flow"] | None, option("KIND", default="the recipe's")
    ] = None
    """Kind of pictures between the frames for --blur."""
    weights: Annotated[Path | None, option("FILE", default="in torch's hub folder")] = None
    """Checkpoint of Super SloMo for --blur."""

    def going_on(self) -> dict[str, Any]:
        from evsplat.importers import Blur

        return {"blur": Blur(self.interpolation, self.weights)} if self.blur else {}


@dataclass(frozen=True, kw_only=True)
class _Poses:
    """Give a capture the poses of a tool's file, or of another capture's body.npz."""

    capture: CaptureFolder
    file: Annotated[tyro.conf.Positional[Path], option("FILE")]
    """Pose file or folder (docs/poses.md); its poses belong to the frames by index."""
    out: Annotated[Path, option("CAPTURE")]
    """The new capture; its cameras are those of the old one."""
    person: Annotated[str | None, option("NAME", default="the only one")] = None
    """Choice among several people in the file."""
    pose_source: Annotated[
        Literal["exact", "markers", "estimated"] | None,
        option("SOURCE", default="what the tool is known for"),
    ] = None
    """Where the poses come from: exact, markers or estimated."""
    smpl: Annotated[Path | None, option("PATH", default="EVSPLAT_BODY_MODELS")] = None
    """Your SMPL model file, or the folder that holds it."""
    overwrite: Flag = False
    """Replace a capture that is there."""

    def __call__(self) -> None:
        from evsplat.importers import attach_poses

        path = attach_poses(
            self.capture,
            self.file,
            self.out,
            person=self.person,
            pose_source=self.pose_source,
            smpl=self.smpl,
            overwrite=self.overwrite,
        )
        print(f"written: {path}\nlook at it with: {command('inspect', path)}")


def check_kind(arguments: Sequence[str]) -> None:
    """Raise a `ConfigError` where the word after ``import`` is missing or no kind of source."""
    from evsplat.importers import KINDS

    kinds = [*KINDS, "poses"]
    if not arguments:
        such = command("import", "video", "clip.mp4", "...")
        raise ConfigError(
            f"import needs a kind of source, such as {such}; there are {', '.join(kinds)}."
        )
    if arguments[0].startswith("-") or arguments[0] in kinds:
        return
    asked = arguments[0]
    if Path(asked).exists():
        raise ConfigError(
            f"{asked}: the kind of source stands before it: "
            f"{command('import', 'KIND', asked, '...')}, with one of {', '.join(kinds)}."
        )
    near = get_close_matches(asked, kinds, 1, cutoff=0.0)[0]
    raise ConfigError(
        f"{asked}: no such kind of source; did you mean {near}? There are {', '.join(kinds)}."
    )


def import_with_kinds() -> Callable[..., Any]:
    """`import_` with the kinds as subcommands; loading them takes seconds, so only when asked."""
    from evsplat.importers import KINDS

    verbs = []
    for name, kind in KINDS.items():
        base = _ImportToBlur if kind.blur_recipe else _ImportToPose
        options = ("options", Annotated[kind, FLAT])
        verb = make_dataclass(kind.__name__, [options], bases=(base,), frozen=True, kw_only=True)
        verb.__doc__ = kind.__doc__
        verbs.append(Annotated[verb, tyro.conf.subcommand(name)])
    verbs.append(Annotated[_Poses, tyro.conf.subcommand("poses")])

    def import_kind(*, kind: Any) -> None:
        kind()

    chosen = Union[tuple(verbs)]  # type: ignore[valid-type] # noqa: UP007 - of a tuple
    import_kind.__annotations__["kind"] = Annotated[chosen, FLAT]
    import_kind.__doc__ = import_.__doc__
    prefixes = tyro.conf.OmitSubcommandPrefixes, tyro.conf.OmitArgPrefixes
    return tyro.conf.configure(*prefixes)(import_kind)
