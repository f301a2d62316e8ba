"""Videos and picture folders are read back with an independent decoder."""

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from evsplat.errors import ConfigError, DataError
from evsplat.pictures.video import write_animation, write_pictures, write_video


def _flat_pictures(count: int, height: int, width: int) -> list[np.ndarray]:
    """Pictures of one colour each, so that what the codec keeps is known."""
    rng = np.random.default_rng(count)
    colours = rng.integers(30, 226, size=(count, 3), dtype=np.uint8)
    return [np.broadcast_to(colour, (height, width, 3)).copy() for colour in colours]


@pytest.mark.parametrize(("fps", "height", "width"), [(30.0, 48, 64), (23.976, 47, 65)])
def test_video_has_the_pictures_rate_and_even_size(tmp_path, fps, height, width):
    pictures = _flat_pictures(7, height, width)
    path = tmp_path / "out.mp4"
    assert write_video(path, iter(pictures), fps=fps) == 7
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"
        assert abs(float(stream.average_rate) - fps) < 1e-3
        frames = list(container.decode(stream))
        times = [frame.time for frame in frames]
    assert len(frames) == 7
    assert (frames[0].height, frames[0].width) == (height + height % 2, width + width % 2)
    np.testing.assert_allclose(np.diff(times), 1 / fps, atol=1e-3)
    for frame, picture in zip(frames, pictures, strict=True):
        decoded = frame.reformat(format="rgb24", src_colorspace="ITU709").to_ndarray()
        # 8-bit limited-range YCbCr rounds a flat colour by at most a few levels.
        assert np.abs(decoded.astype(int).mean((0, 1)) - picture[0, 0]).max() < 4


@pytest.mark.parametrize("enlarged", [2, 3, 4])
def test_enlarged_pixels_are_squares_of_their_colour(tmp_path, enlarged):
    """Every pixel another colour, which yuv420p would mix with its neighbours'."""
    rng = np.random.default_rng(enlarged)
    picture = rng.integers(30, 226, size=(8, 12, 3), dtype=np.uint8)
    path = tmp_path / "out.mp4"
    assert write_video(path, [picture] * 2, fps=25, crf=1, enlarged=enlarged) == 2
    with av.open(str(path)) as container:
        planes = next(container.decode(video=0)).to_ndarray()
    frame = av.VideoFrame.from_ndarray(picture, format="rgb24").reformat(
        format="yuv444p", dst_colorspace="ITU709", dst_color_range=1
    )
    y, *colours = frame.to_ndarray().astype(int)
    height = 8 * enlarged
    assert np.abs(planes[:height] - np.kron(y, np.ones((enlarged, enlarged)))).max() <= 3
    # Of an odd factor every other Cb and Cr stands for two pixels.
    for colour, plane in zip(colours, np.split(planes[height:].ravel(), 2), strict=True):
        each = np.kron(colour, np.ones((enlarged, enlarged)))[::2, ::2]
        apart = np.abs(plane.reshape(each.shape) - each)
        assert np.quantile(apart, 1 if enlarged % 2 == 0 else 0.25) <= 3


def test_frame_rate_1000_over_1001_is_kept_exactly(tmp_path):
    write_video(tmp_path / "out.mp4", _flat_pictures(2, 16, 16), fps=30000 / 1001)
    with av.open(str(tmp_path / "out.mp4")) as container:
        assert container.streams.video[0].base_rate == Fraction(30000, 1001)


def test_the_same_pictures_are_the_same_bytes(tmp_path):
    """Soft ground and something that moves: x264's AVX-512 code ends differently now and then."""
    rows, columns = np.mgrid[:720, :960]
    pictures = []
    for number in range(11):
        picture = np.stack([rows // 4, columns // 5, (rows + columns) // 9], -1).astype(np.uint8)
        far = np.hypot(rows - 360, columns - 300 - 25 * number)
        picture[far < 150] = (180 - far[far < 150, None]).astype(np.uint8)
        pictures.append(picture)
    written = set()
    for number in range(6):
        write_video(tmp_path / f"{number}.mp4", iter(pictures), fps=24)
        written.add((tmp_path / f"{number}.mp4").read_bytes())
    assert len(written) == 1


@pytest.mark.parametrize("kind", ["video", "pictures"])
def test_interrupt_leaves_nothing_new_and_keeps_the_old(tmp_path, kind):
    def interrupted():
        yield from _flat_pictures(3, 16, 16)
        raise KeyboardInterrupt

    old = tmp_path / "old"
    if kind == "video":
        old = old.with_suffix(".mp4")
        write_video(old, _flat_pictures(1, 16, 16), fps=10)
    else:
        write_pictures(old, [("a", _flat_pictures(1, 16, 16)[0])])
    before = _content(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        if kind == "video":
            write_video(old, interrupted(), fps=10)
        else:
            named = ((str(i), p) for i, p in enumerate(interrupted()))
            write_pictures(old, named, replace=True)
    assert _content(tmp_path) == before


@pytest.mark.parametrize("number", [1, 40])
def test_a_picture_that_cannot_be_encoded_is_an_error_that_leaves_nothing(tmp_path, number):
    pictures: list[np.ndarray] = list(_flat_pictures(50, 16, 16))
    pictures[number] = pictures[number].astype(np.float32)
    with pytest.raises(ValueError):
        write_video(tmp_path / "a.mp4", pictures, fps=25)
    assert not list(tmp_path.iterdir())


def _content(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def test_pictures_are_kept_bit_for_bit(tmp_path):
    rng = np.random.default_rng(5)
    picture = rng.integers(0, 256, size=(9, 11, 3), dtype=np.uint8)
    assert write_pictures(tmp_path / "new", [("x", picture)]) == 1
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "new" / "x.png")), picture)


def test_folder_with_files_is_refused_unless_ours(tmp_path):
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "notes.txt").write_text("keep")
    picture = _flat_pictures(1, 8, 8)[0]
    with pytest.raises(DataError, match="not empty"):
        write_pictures(folder, [("x", picture)])
    assert [p.name for p in folder.iterdir()] == ["notes.txt"]
    write_pictures(folder, [("x", picture)], replace=True)
    assert [p.name for p in folder.iterdir()] == ["x.png"]


def test_no_picture_and_impossible_rates_are_refused(tmp_path):
    with pytest.raises(DataError, match="no picture"):
        write_video(tmp_path / "a.mp4", [], fps=10)
    for fps in (0.0, -1.0, float("nan"), 1e6, 1e-4):
        with pytest.raises(ConfigError, match=r"--fps .*: expected from 0\.01 to 1000 Hz"):
            write_video(tmp_path / "a.mp4", _flat_pictures(1, 8, 8), fps=fps)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("name", "most"), [("a.gif", 50), ("a.webp", 1_000)])
def test_animations_take_rates_that_their_format_holds(tmp_path, name, most):
    for fps in (0.0, 1e-4, 0.0099, most + 0.1, float("inf"), float("nan")):
        with pytest.raises(ConfigError, match=rf"--fps .*: expected from 0\.01 to {most} Hz"):
            write_animation(tmp_path / name, _flat_pictures(2, 8, 8), fps=fps)
    assert not list(tmp_path.iterdir())
    for fps in (0.01, most):
        assert write_animation(tmp_path / name, _flat_pictures(2, 8, 8), fps=fps) == 2


@pytest.mark.parametrize("name", ["../a", "/tmp/evsplat-a", "a/b", "a\\b", "..", "", "a" * 201])
def test_pictures_are_written_into_their_folder_only(tmp_path, name):
    picture = _flat_pictures(1, 16, 16)[0]
    with pytest.raises(DataError, match="is no name for a picture"):
        write_pictures(tmp_path / "in" / "out", [("a", picture), (name, picture)])
    assert list(tmp_path.iterdir()) == []
