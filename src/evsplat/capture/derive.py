"""A capture made of another one: some pictures new, everything else as it was."""

import functools
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from torch import Tensor

from evsplat.capture.body_file import write_body
from evsplat.capture.capture import Capture
from evsplat.capture.finding import refuse_errors
from evsplat.capture.metadata import Frame
from evsplat.capture.policy import Policy
from evsplat.capture.training_capture import TrainingCapture
from evsplat.capture.validate import check_capture
from evsplat.events import EventStream, write_events
from evsplat.files import copy_file, make_folder, new_folder, remove_file, write_json
from evsplat.pictures.files import holds_16_bits, write_image
from evsplat.untrusted.text import read_json

Frames = Sequence[Frame]
Made = Iterator[tuple[Frame, Float[Tensor, "..."]]]

_PICTURES = ("image", "sharp", "mask")
_FOLDERS = {"image": "images", "sharp": "sharp", "mask": "masks"}
_EVENT_PIECE_US = 1_000_000


class Derivation:
    """The capture in the making: its description and where its files go."""

    def __init__(self, source: Capture, folder: Path, document: dict[str, Any]) -> None:
        self.source = source
        self.folder = folder
        self.document = document
        """capture.json, to be changed in place."""
        self._entries = {entry["name"]: entry for entry in document["frames"]}
        self._stems = {name: _stem(entry["image"]) for name, entry in self._entries.items()}

    def entry(self, frame: Frame) -> dict[str, Any]:
        """Entry of a frame in capture.json, to be changed in place."""
        return self._entries[frame.name]

    def set_picture(self, frame: Frame, key: str, picture: Float[Tensor, "..."]) -> None:
        """Write an ``image``, ``sharp`` or ``mask`` in [0, 1] of a frame, seen without lens.

        Pictures have as many bits as the frame's in the source, masks 8.
        """
        entry = self.entry(frame)
        if key != "mask" and entry.pop("gain", None) is not None:
            # What is read is evened out, and so is what is made of it: the other one has to be too.
            for other in {"image", "sharp"} - {key}:
                if entry.get(other):
                    self.set_as_read(frame, other)
        self.drop(entry, key)
        entry[key] = self.free(f"{_FOLDERS[key]}/{self._stems[frame.name]}")
        like = None if key == "mask" else self.source.frame(frame.name).image
        write_picture(self.folder / entry[key], picture, like=like)

    def drop(self, entry: dict[str, Any], key: str) -> None:
        """Take a picture out of a frame's or a view's entry; its file stays if others name it."""
        name = entry.get(key)
        if name is not None:
            self._uses[name] -= 1
            if not self._uses[name]:
                # It may be a hard link, and what it is linked to must stay.
                remove_file(self.folder / name)
        entry.pop(key, None)

    def free(self, stem: str) -> str:
        """Name of a new picture that no entry has, such as that of a frame's own sharp one."""
        name, number = f"{stem}.png", 1
        while self._uses[name]:
            number += 1
            name = f"{stem}-{number}.png"
        self._uses[name] += 1
        return name

    @functools.cached_property
    def _uses(self) -> Counter[str]:
        """How many entries name each picture file."""
        entries = [*self.document["frames"], *self.document.get("novel_views", [])]
        return Counter(entry[key] for entry in entries for key in _PICTURES if entry.get(key))

    def set_as_read(self, frame: Frame, key: str) -> None:
        """`set_picture` with what is read of the source's, which has no lens and no gain."""
        source = self.source
        readers = {"image": source.image, "sharp": source.sharp, "mask": source.mask}
        picture = readers[key](frame)
        assert picture is not None, "asked of pictures that the frame has"
        self.set_picture(frame, key, picture)

    def set_body(
        self, model: str, times_us: ArrayLike, poses: ArrayLike, transl: ArrayLike, **details: Any
    ) -> None:
        """Replace body and poses, as `CaptureWriter.set_body`; there are no dense ones then."""
        old = self.document.get("body")
        for name in {"body.npz", "body_dense.npz", *([old["file"]] if old else [])}:
            # It may be a hard link, and what it is linked to must stay.
            remove_file(self.folder / name)
        self.document["body"] = write_body(self.folder, model, times_us, poses, transl, **details)

    def keep(self, frames: Frames) -> None:
        """Leave out all but some frames, and novel views at the times of others."""
        kept = {frame.name for frame in frames}
        for key, name in (("frames", "name"), ("novel_views", "frame")):
            entries = self.document.get(key, [])
            for entry in entries:
                if entry[name] not in kept:
                    for picture in _PICTURES:
                        self.drop(entry, picture)
            self.document[key] = [entry for entry in entries if entry[name] in kept]
        for frame in frames:
            # Without one it would follow from the place in the list.
            self.entry(frame)["split"] = frame.split


@contextmanager
def derived_capture(
    source: Capture,
    path: Path | str,
    *,
    without: Collection[str] = (),
    replace: bool = False,
) -> Iterator[Derivation]:
    """Give a capture in the making that becomes ``path`` when the block ends well and it is valid.

    All files of ``source`` are in it but the frames' pictures of the kinds in ``without`` (out of
    "image", "sharp" and "mask"). They are hard links where the file system can, since evsplat never
    writes into a file that exists; else copies. Where the lens distorts, pictures and events are
    written without distortion, because that is how they are read and new pictures are made.
    ``replace``: a folder at ``path`` stays until then; see `new_folder`.
    """
    path = Path(path)
    document = read_json(source.path / "capture.json")
    with new_folder(path, replace=replace) as folder:
        making = Derivation(source, folder, document)
        for entry in document["frames"]:
            for key in without:
                entry.pop(key, None)
        _copy_files(making)
        _undistort(making)
        yield making
        write_json(folder / "capture.json", document)
        _, findings = check_capture(folder, deep=False)
        refuse_errors(findings, lambda file: path / file.relative_to(folder))


def training_frames_first(
    capture: Capture, seen: TrainingCapture, make: Callable[[TrainingCapture, Frames], Made]
) -> Made:
    """Results of ``make`` for all frames: for training frames from what they may know, ``seen``.

    Those of held-out frames, which no training opens, come after them and from everything.
    """
    yield from make(seen, seen.train_frames)
    everything = capture.for_training(Policy(use="everything"))
    yield from make(everything, [everything.frame(f.name) for f in seen.held_out_frames])


def write_picture(path: Path, picture: Float[Tensor, "..."], *, like: Path | None = None) -> None:
    """Write a picture in [0, 1] as PNG, of 8 bits or as many as the picture file ``like`` has."""
    make_folder(path.parent)
    pixels = np.ascontiguousarray(picture.detach().cpu().numpy())
    # 8 bits of light leave a dark picture a handful of levels.
    if like is not None and holds_16_bits(like):
        pixels = (pixels.clip(0, 1) * np.iinfo(np.uint16).max + 0.5).astype(np.uint16)
    # It may be a hard link, and what it is linked to must stay.
    remove_file(path)
    write_image(path, pixels)


def _stem(image: str) -> str:
    """Path of a frame's picture without its suffix and the folder of all pictures."""
    path = Path(image).with_suffix("")
    return path.relative_to("images").as_posix() if path.parts[0] == "images" else path.as_posix()


def _copy_files(making: Derivation) -> None:
    root, document = making.source.path, making.document
    names = {path.name for path in root.iterdir() if path.is_file() and path.name[0] != "."}
    names -= {"capture.json"}
    names |= {entry[key] for entry in document["frames"] for key in _PICTURES if entry.get(key)}
    names |= {view["image"] for view in document.get("novel_views", [])}
    names |= {document[key]["file"] for key in ("body", "events") if document.get(key)}
    for name in sorted(names):
        copy_file((root / name).resolve(), making.folder / name, link=True)


def _undistort(making: Derivation) -> None:
    """Replace what a distorting lens recorded by what is read of it."""
    source, cameras = making.source, making.document["cameras"]
    bent = {name for name, camera in cameras.items() if source.is_distorted(name)}
    for name in bent:
        cameras[name]["distortion"] = None
    for frame in source.frames:
        entry = making.entry(frame)
        for key in _PICTURES if frame.camera in bent else ():
            if entry.get(key):
                making.set_as_read(frame, key)
    for view in source.novel_views:
        entry = making.document["novel_views"][view.index]
        if view.camera in bent:
            stem = Path(entry["image"]).with_suffix("").as_posix()
            making.drop(entry, "image")
            entry["image"] = making.free(stem)
            place = making.folder / entry["image"]
            write_picture(place, source.novel_image(view), like=view.image)
    if source.events is not None and source.frames[0].camera in bent:
        events = making.document["events"]
        write_events(making.folder / events["file"], _pieces(source))
        events["clock_offset_us"] = 0


def _pieces(source: Capture) -> Iterator[EventStream]:
    """All events, undistorted and on the camera's clock."""
    assert source.events is not None
    start, end = source.events.time_range_us
    for time in range(start, end, _EVENT_PIECE_US):
        yield source.events.between(time, min(time + _EVENT_PIECE_US, end))
