"""`synthesize` from end to end: captures of footage whose blur and events can be computed."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from evsplat.capture import CaptureWriter, Policy, load_capture, validate_capture
from evsplat.errors import ConfigError, DataError
from evsplat.events import count_map
from evsplat.inspection import inspect_capture
from evsplat.masks import mask_capture
from evsplat.pictures.files import read_image, write_image
from evsplat.synthesis import SynthesisSettings, synthesize

Factory = Callable[..., Path]
FPS, WIDTH, HEIGHT = 1000, 40, 12
FAST = {"interpolation": "none", "progress": False}


def save_folder(folder: Path, pictures: np.ndarray) -> Path:
    folder.mkdir()
    for index, picture in enumerate(pictures):
        write_image(folder / f"{index:04d}.png", picture)
    return folder


def bar(count: int, speed: float = 1.0) -> np.ndarray:
    """A bright bar 6 px wide that moves right by ``speed`` px a picture over dark; 8 bit RGB."""
    left = 4 + speed * np.arange(count)[:, None]
    column = np.arange(WIDTH)[None]
    cover = np.clip(column + 1 - left, 0, 1) * np.clip(left + 6 - column, 0, 1)
    coded = 40 + 180 * cover[:, None, :, None] * np.array([1.0, 0.7, 0.4])
    return np.broadcast_to(coded + 0.5, (count, HEIGHT, WIDTH, 3)).astype(np.uint8)


def poses_file(path: Path, times_us: np.ndarray) -> Path:
    count = len(times_us)
    poses = np.random.default_rng(0).normal(0, 0.1, (count, 31, 3))
    np.savez(
        path, model="default", times_us=times_us, poses=poses, transl=poses[:, 0], betas=np.zeros(3)
    )
    return path


def camera_file(path: Path) -> Path:
    path.write_text(
        f'{{"width": {WIDTH}, "height": {HEIGHT}, "K": [[50, 0, 20], [0, 50, 6], [0, 0, 1]], '
        '"world_to_camera": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]}'
    )
    return path


@pytest.fixture
def posed(tmp_path: Path) -> dict[str, Path]:
    """Options that give footage of 31 pictures at 1 kHz a body and a camera."""
    times = np.arange(31) * 1000
    body = poses_file(tmp_path / "poses.npz", times)
    return {"body": body, "camera": camera_file(tmp_path / "camera.json")}


@pytest.mark.parametrize("transfer", ["power", "srgb", "linear"])
def test_bar_is_blurred_as_computed_in_float64(tmp_path, posed, transfer):
    pictures = bar(31)
    folder = save_folder(tmp_path / "bar", pictures)
    out = synthesize(
        folder, tmp_path / "out", source_fps=FPS, subframes=9, transfer=transfer, **posed, **FAST
    )
    capture = load_capture(out)
    coded = pictures / 255
    curves = {
        "power": (lambda v: v**2.2, lambda v: v ** (1 / 2.2)),
        "linear": (lambda v: v, lambda v: v),
        "srgb": (
            lambda v: np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4),
            lambda v: np.where(v <= 0.0031308, 12.92 * v, 1.055 * v ** (1 / 2.4) - 0.055),
        ),
    }
    decode, encode = curves[transfer]
    assert [frame.name for frame in capture.frames] == [f"{i:04d}" for i in range(4, 27)]
    for frame in capture.frames:
        index = int(frame.name)
        expected = encode(decode(coded[index - 4 : index + 5]).mean(axis=0))
        stored = read_image(frame.image)
        assert stored.dtype == np.uint8
        # within the rounding to 8 bits, and of exposures to whole microseconds
        assert np.abs(stored / 255 - expected).max() <= 0.55 / 255
        assert np.array_equal(read_image(frame.sharp), pictures[index])
        assert frame.exposure_us == (1000 * index - 4500, 1000 * index + 4500)
        assert frame.split == ("test" if frame.index % 10 >= 7 else "train")


def test_linear_light_not_coded_values_are_averaged(tmp_path, posed):
    """Half black, half white is brighter than middle grey."""
    flicker = np.zeros((31, HEIGHT, WIDTH), np.uint8)
    flicker[1::2] = 255
    out = synthesize(
        save_folder(tmp_path / "flicker", flicker),
        tmp_path / "out",
        source_fps=FPS,
        exposure_us=10_000,
        events="none",
        **posed,
        **FAST,
    )
    for frame in load_capture(out).frames:
        stored = read_image(frame.image)
        assert stored.shape == (HEIGHT, WIDTH)
        assert np.abs(stored.astype(int) - round(255 * 0.5 ** (1 / 2.2))).max() <= 1


@pytest.mark.parametrize("contrast", [0.15, 0.3])
def test_events_count_the_change_of_log_light(tmp_path, posed, contrast):
    """Each pixel fades by its own factor: the count is what fits into the change of logarithm."""
    rng = np.random.default_rng(7)
    start, end = rng.uniform(0.2, 0.95, (2, HEIGHT, WIDTH))
    mix = np.linspace(0, 1, 31)[:, None, None]
    linear = np.exp((1 - mix) * np.log(start) + mix * np.log(end))
    stored = np.round(linear ** (1 / 2.2) * 65535).astype(np.uint16)
    out = synthesize(
        save_folder(tmp_path / "fade", stored),
        tmp_path / "out",
        source_fps=FPS,
        subframes=5,
        contrast=contrast,
        **posed,
        **FAST,
    )
    capture = load_capture(out)
    assert capture.contrast_threshold == (contrast, contrast) and capture.events_simulated
    events = capture.events.between(-(10**9), 10**9)
    counts = count_map(events, HEIGHT, WIDTH).numpy()
    change = np.log(end + 1e-3) - np.log(start + 1e-3)
    assert np.abs(counts * contrast - change).max() < contrast * 1.01
    exact = np.trunc(change / contrast)
    assert (counts == exact).mean() > 0.98
    # 16-bit footage gives 16-bit frames
    assert read_image(capture.frames[0].image).dtype == np.uint16
    assert np.array_equal(read_image(capture.frames[3].sharp), stored[int(capture.frames[3].name)])


def test_body_poses_are_those_at_mid_exposure_and_all_go_to_the_dense_file(tmp_path, posed):
    out = synthesize(
        save_folder(tmp_path / "bar", bar(31)),
        tmp_path / "out",
        source_fps=FPS,
        fps=200,
        duty=0.8,
        pose_source="exact",
        **posed,
        **FAST,
    )
    capture = load_capture(out)
    assert capture.body_file.source == "exact"
    given = np.load(posed["body"])
    middles = [frame.mid_us for frame in capture.frames]
    assert np.diff(middles).tolist() == [5000] * (len(middles) - 1)
    assert capture.body_file.times_us.tolist() == middles
    chosen = np.searchsorted(given["times_us"], middles)
    assert np.array_equal(capture.body_file.poses, given["poses"][chosen].astype(np.float32))
    assert np.array_equal(capture.dense_body_file.times_us, given["times_us"])


def test_capture_of_a_data_set_keeps_what_belongs_to_its_frames(tiny_capture: Factory, tmp_path):
    source_path = tiny_capture(frames=24, seed=2)
    errors = {
        "pose_std_rad": np.random.default_rng(0).random((24, 3)),
        "transl_std_m": np.ones((24, 3)),
    }
    np.savez(source_path / "body.npz", **np.load(source_path / "body.npz"), **errors)
    document = json.loads((source_path / "capture.json").read_text())
    document["body"]["source"] = "markers"
    (source_path / "capture.json").write_text(json.dumps(document))
    (source_path / "points.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
        "property float z\nend_header\n1 2 3\n"
    )
    out = synthesize(
        source_path, tmp_path / "out", recipe="zju-mocap-blur", interpolation="flow", progress=False
    )
    source, made = load_capture(source_path), load_capture(out)
    assert [finding for finding in validate_capture(out)] == []
    # the first and the last picture have no neighbour to be blurred with
    assert [frame.name for frame in made.frames] == [frame.name for frame in source.frames[1:-1]]
    for frame in made.frames:
        before = source.frame(frame.name)
        assert frame.mid_us == before.mid_us
        assert frame.exposure_us[1] - frame.exposure_us[0] == 40_000
        assert np.array_equal(made.sharp(frame), source.sharp(before))
        assert np.array_equal(made.mask(frame), source.mask(before))
        assert not np.array_equal(made.image(frame), source.sharp(before))
    assert np.array_equal(made.camera("0003").K, source.camera("0003").K)
    kept = [view for view in source.novel_views if view.frame in {f.name for f in made.frames}]
    assert len(made.novel_views) == len(kept) > 3
    for view, before in zip(made.novel_views, kept, strict=True):
        assert (view.camera, view.frame, view.time_us) == (
            before.camera,
            before.frame,
            before.time_us,
        )
        assert np.array_equal(made.novel_image(view), source.novel_image(before))
    assert np.array_equal(made.body_file.times_us, source.body_file.times_us[1:-1])
    assert made.body_file.source == "markers"
    kept = errors["pose_std_rad"][1:-1].astype(np.float32)
    assert np.array_equal(made.body_file.pose_std_rad, kept)
    assert np.array_equal(made.dense_body_file.poses, source.body_file.poses)
    assert made.initial_points()[0].tolist() == [[1, 2, 3]]
    recorded = made.provenance["synthesis"]
    assert recorded["recipe"] == "zju-mocap-blur" and recorded["interpolation"] == "flow"
    assert recorded["sensor_settings"]["contrast_on"] == 0.2
    assert made.provenance["source"]["capture"] == source.name
    report = inspect_capture(out, tmp_path / "inspect")
    assert report.usable and "22: 16 train, 6 test" in report.summary


def test_source_events_and_split_can_be_kept(tiny_capture: Factory, tmp_path):
    source_path = tiny_capture(frames=12)
    out = synthesize(
        source_path,
        tmp_path / "out",
        duty=1.0,
        events="source",
        split="source",
        progress=False,
    )
    source, made = load_capture(source_path), load_capture(out)
    everything = source.events.between(*source.events.time_range_us)
    kept = made.events.between(*made.events.time_range_us)
    for name in "txyp":
        assert np.array_equal(getattr(kept, name), getattr(everything, name))
    assert [f.split for f in made.frames] == [f.split for f in source.frames[1:-1]]
    assert made.contrast_threshold == source.contrast_threshold


def test_moving_camera_and_lens_go_along(tiny_capture: Factory, tmp_path):
    tiny = load_capture(tiny_capture(frames=12))
    lens = (0.05, -0.01, 0.001, 0.002)
    with CaptureWriter(tmp_path / "moving") as writer:
        camera = tiny.cameras["main"]
        writer.add_camera("main", 32, 24, camera.K, distortion=lens)
        for frame in tiny.frames:
            pose = camera.world_to_camera.numpy().copy()
            pose[0, 3] += frame.index / 100
            writer.add_frame(
                frame.name, "main", frame.sharp, frame.exposure_us, world_to_camera=pose
            )
        body = tiny.body_file
        writer.set_body("rig", body.times_us, body.poses, body.transl, rig=body.rig)
    made = load_capture(synthesize(tmp_path / "moving", tmp_path / "out", progress=False))
    source = load_capture(tmp_path / "moving")
    for frame in made.frames:
        assert np.array_equal(frame.world_to_camera, source.frame(frame.name).world_to_camera)
        # `sharp` of a source without truth is its picture, lens included
        assert np.array_equal(read_image(frame.sharp), read_image(source.frame(frame.name).image))
    assert made.metadata.distortions["main"].coefficients == lens


def test_the_same_seed_gives_the_same_capture(tmp_path, posed):
    folder = save_folder(tmp_path / "bar", bar(31))
    options = dict(source_fps=FPS, subframes=5, sensor="davis346", read_noise=0.02, **posed, **FAST)
    made = [
        load_capture(synthesize(folder, tmp_path / f"out{i}", seed=seed, **options))
        for i, seed in enumerate((4, 4, 5))
    ]
    stored = [np.stack([read_image(f.image) for f in capture.frames]) for capture in made]
    assert np.array_equal(stored[0], stored[1]) and not np.array_equal(stored[0], stored[2])
    events = [capture.events.between(-(10**9), 10**9) for capture in made]
    assert np.array_equal(events[0].t, events[1].t)
    assert len(events[0]) != len(events[2]) or not np.array_equal(events[0].t, events[2].t)
    clean = synthesize(folder, tmp_path / "clean", **(options | {"read_noise": 0.0}))
    quiet = np.stack([read_image(frame.image) for frame in load_capture(clean).frames])
    light = [(pixels / 255) ** 2.2 for pixels in (stored[0], quiet)]
    unclipped = light[1] > 0.1
    assert np.std((light[0] - light[1])[unclipped]) == pytest.approx(0.02, rel=0.1)


def test_stop_in_the_middle_leaves_nothing(tmp_path, posed, monkeypatch):
    folder = save_folder(tmp_path / "bar", bar(31))
    before = sorted(path.name for path in tmp_path.iterdir())
    written = []

    def interrupted(self, name, *arguments, **options):
        written.append(name)
        if len(written) == 5:
            raise KeyboardInterrupt

    monkeypatch.setattr(CaptureWriter, "add_frame", interrupted)
    with pytest.raises(KeyboardInterrupt):
        synthesize(folder, tmp_path / "out", source_fps=FPS, subframes=5, **posed, **FAST)
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_what_does_not_fit_is_refused_before_anything_is_written(
    tiny_capture: Factory, tmp_path, posed
):
    folder = save_folder(tmp_path / "bar", bar(31))
    capture = tiny_capture()
    out = tmp_path / "out"
    cases = [
        (DataError, "no such video file", (tmp_path / "nothing",), {}),
        (ConfigError, "--source-fps", (folder,), {}),
        (ConfigError, "--source-fps.*is a capture", (capture,), {"source_fps": 3}),
        (ConfigError, "--body.*is a capture", (capture,), {"body": posed["body"]}),
        (ConfigError, "--camera", (folder,), {"source_fps": 9, "body": posed["body"]}),
        (ConfigError, "--events source", (folder,), {"source_fps": 9, "events": "source"}),
        (ConfigError, "--split source", (folder,), {"source_fps": 9, "split": "source"}),
        (ConfigError, "--weights", (capture,), {"weights": tmp_path / "w.ckpt"}),
        (ConfigError, "expected one of zju-mocap-blur", (capture,), {"recipe": "zju"}),
        (
            DataError,
            "lens.json: K: found .*expected 3x3",
            (folder,),
            {"camera": "lens.json"},
        ),
        (DataError, "small.json: width: found 3", (folder,), {"camera": "small.json"}),
        (DataError, "bare.json: width, height", (folder,), {"camera": "bare.json"}),
        (DataError, "short.npz: poses: found nothing, expected", (folder,), {"body": "short.npz"}),
        (DataError, "pickled", (folder,), {"body": "pickled.npz"}),
    ]
    text = posed["camera"].read_text()
    (tmp_path / "lens.json").write_text(text.replace("[[50, 0, 20], ", "["))
    (tmp_path / "small.json").write_text(text.replace(f'"width": {WIDTH}', '"width": 3'))
    (tmp_path / "bare.json").write_text("{}")
    np.savez(tmp_path / "short.npz", model="default", times_us=[0], transl=np.zeros((1, 3)))
    np.savez(tmp_path / "pickled.npz", model=np.array([{}], dtype=object))
    for kind, words, source, options in cases:
        for name in ("camera", "body"):
            if isinstance(options.get(name), str):
                options = {"source_fps": 9, **posed} | options | {name: tmp_path / options[name]}
        with pytest.raises(kind, match=words):
            synthesize(*source, out, **options, progress=False)
        assert not out.exists()


def test_grey_among_colour_is_named(tmp_path, posed):
    folder = save_folder(tmp_path / "bar", bar(31))
    Image.fromarray(np.zeros((HEIGHT, WIDTH), np.uint8)).save(folder / "0017.png")
    with pytest.raises(DataError, match="'0017'.*all grey or all colour"):
        synthesize(folder, tmp_path / "out", source_fps=FPS, subframes=5, **posed, **FAST)
    assert not (tmp_path / "out").exists()


def test_existing_capture_is_replaced_only_when_asked(tmp_path, posed):
    folder = save_folder(tmp_path / "bar", bar(31))
    options = dict(source_fps=FPS, subframes=5, events="none", **posed, **FAST)
    synthesize(folder, tmp_path / "out", **options)
    with pytest.raises(DataError, match="already exists"):
        synthesize(folder, tmp_path / "out", **options)
    synthesize(folder, tmp_path / "out", overwrite=True, **options)


def test_masks_that_were_found_are_not_given_ones_afterwards(tiny_capture, tmp_path):
    given = tiny_capture(width=64, height=48)
    found = mask_capture(given, tmp_path / "found", method="silhouette")
    for source, expected in ((given, "given"), (found, "estimated")):
        out = synthesize(source, tmp_path / expected, subframes=3, events="none", **FAST)
        made = load_capture(out)
        assert all(frame.mask is not None for frame in made.frames)
        assert made.for_training(Policy(masks="given")).terms().masks == expected
        assert made.has_others_masks == (expected == "given")


def test_recipes_are_the_papers():
    for recipe in ("zju-mocap-blur", "mmhpsd-blur"):
        settings = SynthesisSettings(recipe=recipe)
        assert settings.interpolation == "super-slomo" and settings.transfer == "power"
        assert settings.upsample == 8 and settings.duty == 1.0 and settings.split == "modulo"


def test_footage_without_poses_gives_a_capture_to_look_at(tmp_path, caplog):
    folder = save_folder(tmp_path / "bar", bar(31))
    out = synthesize(folder, tmp_path / "out", source_fps=FPS, fps=100, duty=0.5, **FAST)
    assert "No camera is given" in caplog.text and "No body poses are given" in caplog.text
    capture = load_capture(out)
    assert not capture.has_body and capture.dense_body_file is None
    with pytest.raises(DataError, match="has no body; find the person's poses with: evsplat poses"):
        _ = capture.body_file
    report = inspect_capture(out, tmp_path / "inspect")
    assert report.usable and "body       none" in report.summary
    assert [picture.stem for picture in report.pictures] == ["contact_sheet", "events", "timeline"]
    assert any("null: no body" in str(finding) for finding in report.findings)
