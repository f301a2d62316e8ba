"""``evsplat import``: turn a data set, or your own recording, into a capture."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union

import tyro

from evsplat.cli.options import Flag, option

if TYPE_CHECKING:
    from evsplat.importers import Blur, Importer

_Source = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SOURCE")]
_Capture = Annotated[Path, tyro.conf.arg(metavar="CAPTURE")]
_Smpl = Annotated[Path | None, option("PATH", default="EVSPLAT_BODY_MODELS")]
_ARGUMENTS = """
Args:
    source: Folder of the data (docs/import.md shows each tree).
    out: Capture to write.
    smpl: Your SMPL model file, or the folder that holds it.
    blur: Go on to the paper's version: blurry frames and simulated events. The sharp capture stays
        beside it, with _sharp at the end of its name.
    interpolation: How pictures between the frames are made for --blur.
    weights: Checkpoint of Super SloMo for --blur.
    overwrite: Replace a capture that is there.
"""


def import_() -> None:
    """Turn a data set, or your own recording, into a capture.

    'evsplat import KIND --help' tells the options of a kind; docs/import.md has the trees.
    """


def import_with_kinds() -> Callable[..., Any]:
    """`import_` with the kinds as subcommands; loading them takes seconds, so only when asked."""
    from evsplat.importers import KINDS

    kinds = tuple(
        Annotated[type(name, (_Done,), {}), tyro.conf.subcommand(name, constructor=_verb(kind))]
        for name, kind in KINDS.items()
    )

    def verb(*, kind: Any) -> None:
        pass

    chosen = Union[kinds]  # type: ignore[valid-type] # noqa: UP007 - of a tuple
    verb.__annotations__["kind"] = Annotated[chosen, tyro.conf.arg(name="")]
    verb.__doc__ = import_.__doc__
    prefixes = tyro.conf.OmitSubcommandPrefixes, tyro.conf.OmitArgPrefixes
    return tyro.conf.configure(*prefixes)(verb)


class _Done:
    """What the function of a kind gives to the parser: its work is done."""


def _verb(kind: "type[Importer]") -> Callable[..., _Done]:
    """The import of one kind as a function whose signature is its command line."""

    def plain(
        source: _Source,
        /,
        *,
        out: _Capture,
        options: Any,
        smpl: _Smpl = None,
        overwrite: Flag = False,
    ) -> _Done:
        return _run(options, source, out, smpl, overwrite, None)

    def with_blur(
        source: _Source,
        /,
        *,
        out: _Capture,
        options: Any,
        smpl: _Smpl = None,
        blur: Flag = False,
        interpolation: Annotated[
            Literal["super-slomo", "flow"] | None, option("KIND", default="the recipe's")
        ] = None,
        weights: Annotated[Path | None, option("FILE", default="in torch's hub folder")] = None,
        overwrite: Flag = False,
    ) -> _Done:
        from evsplat.importers import Blur

        going_on = Blur(interpolation, weights) if blur else None
        return _run(options, source, out, smpl, overwrite, going_on)

    chosen: Callable[..., _Done] = with_blur if kind.blur_recipe else plain
    chosen.__annotations__["options"] = Annotated[kind, tyro.conf.arg(name="")]
    chosen.__doc__ = f"{kind.__doc__}\n{_ARGUMENTS}"
    return chosen


def _run(
    importer: "Importer",
    source: Path,
    out: Path,
    smpl: Path | None,
    overwrite: bool,
    blur: "Blur | None",
) -> _Done:
    from evsplat.importers import run_importer

    path = run_importer(importer, source, out, smpl=smpl, overwrite=overwrite, blur=blur)
    print(f"written: {path}\nlook at it with: evsplat inspect {path}")
    return _Done()
