"""Whole captures, small enough for tests."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from evsplat.body import silhouette
from evsplat.body.motion import load_motion
from evsplat.capture import load_body_track, load_capture, validate_capture
from evsplat.cli import main
from evsplat.errors import ConfigError, DataError
from evsplat.events import count_map
from evsplat.events.simulator import PRESETS
from evsplat.pictures import luminance
from evsplat.staging import StageSettings, characters, motions, stage
from evsplat.staging.assets import find_character, find_motion
from evsplat.staging.camera import CameraPath, frame_times
from evsplat.staging.character import load_character
from evsplat.staging.cloth import Cloth
from evsplat.staging.motion import (
    cut_motion,
    dressed_vertices,
    key_poses,
    place_motion,
    warn_of_hiding,
)
from evsplat.staging.renderer import StageRenderer
from evsplat.staging.room import load_room

FAST = StageSettings(
    character="worker",
    motion="kick",
    width=96,
    height=96,
    frames=8,
    fps=50,
    exposure_ms=12,
    start_s=0.4,
    seed=3,
)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A capture, its character and a renderer of the same room."""
    path = stage(tmp_path_factory.mktemp("stage") / "kick", FAST, threads=1, progress=False)
    character = load_character(find_character("worker"))
    return load_capture(path), character, StageRenderer(load_room(), character, threads=1)


def bones(track, times):
    return track.body.bone_transforms(*track.at(times))


def true_track(capture):
    return load_body_track(capture, dense=True)


def test_capture_is_valid_and_complete(made):
    capture = made[0]
    assert validate_capture(capture.path) == []
    assert len(capture.frames) == 8 and [f.split for f in capture.frames].count("test") == 1
    assert {view.camera for view in capture.novel_views} == {
        "novel_left",
        "novel_right",
        "novel_back",
    }
    assert capture.contrast_threshold == (0.2, 0.2) and capture.events_simulated
    assert len(capture.events) > 1000
    assert capture.provenance["settings"]["motion"] == "kick"
    for frame in capture.frames:
        assert capture.mask(frame) is not None and capture.sharp(frame).std() > 0.05
    exact = load_body_track(capture).errors
    assert exact.source == "exact" and exact.joint_rad.max() == exact.root_m.max() == 0


@pytest.mark.parametrize(
    ("pose_noise", "source"),
    [("mocap", "markers"), ("estimated", "estimated"), ("estimated-blurry", "estimated")],
)
def test_poses_say_how_far_they_err(tmp_path, pose_noise, source):
    settings = replace(FAST, width=16, height=16, frames=8, pose_noise=pose_noise)
    capture = load_capture(stage(tmp_path / "a", settings, threads=1, progress=False))
    given, truth = load_body_track(capture), true_track(capture)
    errors = given.errors
    assert errors.source == source and not errors.typical
    exact = key_poses(truth, given.times_us)
    turns = Rotation.from_rotvec(exact[0].reshape(-1, 3)).inv() * Rotation.from_rotvec(
        given.poses.reshape(-1, 3)
    )
    off = turns.as_rotvec().reshape(given.poses.shape)
    still = errors.joint_rad[0] == 0
    assert np.abs(off[:, still]).max() < 1e-3
    in_units = off[:, ~still] / errors.joint_rad[:, ~still, None]
    # 17 joints, two or three errors that differ in 0.16 s each
    assert np.sqrt(np.mean(in_units**2)) == pytest.approx(1, rel=0.25)


def test_blurry_picture_is_the_mean_of_sharp_ones_in_linear_light(made):
    capture, _, renderer = made
    track, frame = true_track(capture), capture.frames[3]
    start, end = frame.exposure_us
    times = [start + round((k + 0.5) * (end - start) / 16) for k in range(16)]
    pictures, _ = renderer.draw(capture.cameras["main"], bones(track, times))
    expected = pictures.astype(np.float64).mean(0).clip(0, 1) ** (1 / 2.2)
    # 8 bit, and true poses stored as float32
    assert np.abs(capture.image(frame).numpy() - expected).max() < 0.51 / 255 + 1e-3
    assert (capture.image(frame) - capture.sharp(frame)).abs().max() > 0.1


def test_mask_is_where_the_character_is(made):
    capture, character, _ = made
    track, camera = true_track(capture), capture.cameras["main"]
    for frame in capture.frames[::3]:
        posed = dressed_vertices(character, track, frame.mid_us)
        outline = silhouette(posed, torch.from_numpy(character.faces).long(), camera).numpy()
        mask = capture.mask(frame).numpy() > 0.5
        both, either = (mask & outline).sum(), (mask | outline).sum()
        assert both / either > 0.93


def test_posed_body_falls_on_the_person_to_within_a_pixel(made):
    capture = made[0]
    track, camera = load_body_track(capture), capture.cameras["main"]
    for frame in capture.frames[::3]:
        pixels, _ = camera.project(track.vertices(frame.mid_us))
        person = np.pad(capture.mask(frame).numpy() > 0, 1)
        near = np.zeros_like(person)
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                near |= np.roll(person, (dy, dx), (0, 1))
        column, row = pixels.floor().long().clamp(-1, 96).numpy().T + 1
        assert near[row, column].mean() > 0.995


def test_events_tell_how_the_light_changed_between_two_instants(made):
    capture, _, renderer = made
    track, settings = true_track(capture), PRESETS["clean"]
    drawn_us = capture.dense_body_file.times_us[[0, 25, 110]].tolist()
    pictures, _ = renderer.draw(capture.cameras["main"], bones(track, drawn_us))
    light = np.log(luminance(torch.from_numpy(pictures)).numpy() + settings.log_eps)
    # each pixel's threshold counts from the first picture
    for picture, time in zip(light[1:], drawn_us[1:], strict=True):
        counted = count_map(capture.events.between(0, time + 1), 96, 96).numpy()
        assert np.abs(picture - light[0] - 0.2 * counted).max() < 0.2 + 1e-3
    moved = np.abs(light[2] - light[0]) > 0.5
    assert moved.sum() > 50


def test_equal_settings_give_equal_files_with_any_number_of_threads(tmp_path):
    small = replace(FAST, width=32, height=32, frames=2, events="davis346", cloth_mm=5)
    small = replace(small, camera="handheld", pose_noise="estimated")
    paths = [
        stage(tmp_path / f"{threads}/a", small, threads=threads, progress=False)
        for threads in (1, 3)
    ]
    files = sorted(p.relative_to(paths[0]) for p in paths[0].rglob("*") if p.is_file())
    for name in files:
        if name.suffix in (".png", ".json"):
            assert (paths[0] / name).read_bytes() == (paths[1] / name).read_bytes(), name
    streams = [load_capture(path).events.between(0, 10**9) for path in paths]
    assert len(streams[0]) > 0
    for key in "txyp":
        assert np.array_equal(getattr(streams[0], key), getattr(streams[1], key))


def test_without_shadow_what_the_person_never_covers_stays_still(tmp_path):
    path = stage(
        tmp_path / "a", FAST, shadows=False, width=48, height=48, threads=1, progress=False
    )
    capture = load_capture(path)
    sharp = torch.stack([capture.sharp(frame) for frame in capture.frames])
    covered = torch.stack([capture.mask(frame) for frame in capture.frames]).amax(0) > 0
    assert 0.5 < (~covered).float().mean() < 0.97
    assert sharp.std(0)[~covered].max() == 0


@pytest.mark.parametrize("camera", ["orbit", "handheld"])
def test_moving_camera_is_where_each_frame_says(tmp_path, made, camera):
    settings = replace(FAST, camera=camera, width=48, height=48, frames=4)
    capture = load_capture(stage(tmp_path / "a", settings, threads=1, progress=False))
    assert [f for f in validate_capture(capture.path) if f.severity == "error"] == []
    assert not capture.is_static_camera
    track = true_track(capture)
    for frame in capture.frames[::3]:
        there, _ = made[2].draw(capture.camera(frame), bones(track, [frame.mid_us]))
        coded = there[0].clip(0, 1) ** (1 / 2.2)
        # the room is sampled 2x2 where the camera moves and 4x4 where it stands
        assert -10 * np.log10(((coded - capture.sharp(frame).numpy()) ** 2).mean()) > 30
    places = [capture.camera(frame).center() for frame in capture.frames]
    assert (places[0] - places[-1]).norm() > 1e-3


def test_orbit_keeps_its_distance_and_covers_its_arc():
    path = CameraPath("orbit", 2.0, orbit_deg=40)
    poses = path.at(np.linspace(0, 2e6, 9))
    eyes = -np.einsum("tji,tj->ti", poses[:, :3, :3], poses[:, :3, 3])
    flat = eyes[:, :2]
    assert np.ptp(np.linalg.norm(flat, axis=1)) < 1e-9
    cosine = flat[0] @ flat[-1] / np.linalg.norm(flat[0]) / np.linalg.norm(flat[-1])
    assert np.degrees(np.arccos(cosine)) == pytest.approx(40)
    assert np.allclose(poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), np.eye(3))


def test_sub_frames_divide_the_exposure_and_the_gap_evenly():
    for fps, exposure_ms, parts in ((25, 30, 30), (30, 8, 16), (12.5, 72, 72), (1000, 1, 16)):
        frames = frame_times(4, fps, exposure_ms, 1000)
        for before, after in zip(frames[:-1], frames[1:], strict=True):
            assert len(before.exposure) == parts
            times = np.concatenate((before.exposure, before.after, after.exposure))
            assert (np.diff(times) > 0).all() and np.diff(times).max() <= 1001
            centre = before.exposure.mean() - (before.start_us + before.end_us) / 2
            assert abs(centre) <= 0.5
            assert before.start_us <= before.exposure[0] and before.exposure[-1] < before.end_us


def test_cloth_moves_garments_only_by_its_amplitude_and_tilts_the_normals():
    character = load_character(find_character("man"))
    track = place_motion(load_motion(find_motion("kick")), character)
    cloth = Cloth(character, track, 0.008, seed=5)
    times = np.linspace(0, 1_400_000, 40)
    vertices, normals = cloth.at(times)
    moved = ((vertices - character.vertices) * character.normals).sum(-1)
    loose = character.cloth > 0
    assert np.abs(moved[:, ~loose]).max() < 1e-6
    assert moved.min() > -1e-6
    assert np.sqrt((moved[:, loose] ** 2).mean()) == pytest.approx(0.008, rel=0.5)
    assert np.allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-5)
    # along a short way on the surface the height changes as the tilt says
    t, faces = 20, character.faces[loose[character.faces].all(1)]
    a, b = faces[:, 0], faces[:, 1]
    way = character.vertices[b] - character.vertices[a]
    slope = normals[t] / (normals[t] * character.normals).sum(-1, keepdims=True)
    predicted = -((slope[a] + slope[b]) / 2 * way).sum(-1)
    flat = ((character.normals[a] + character.normals[b]) / 2 * way).sum(-1)
    short = np.linalg.norm(way, axis=1) < 0.02
    change = (moved[t, b] - moved[t, a])[short]
    assert np.corrcoef(change, (predicted + flat)[short])[0, 1] > 0.95


def test_motion_stands_on_the_floor_in_the_middle(captures_root):
    capture = load_capture(captures_root / "man_dance_hard_256")
    character = load_character(find_character("man"))
    ours = place_motion(load_motion(find_motion("dance_b")), character)
    theirs = true_track(capture)
    times = list(range(100_000, 2_400_000, 100_000))
    # made by another program from the same file; necks and axes of rotation differ a little
    apart = (
        ours.body.joint_transforms(*ours.at(times))
        - theirs.body.joint_transforms(*theirs.at(times))
    )[..., :3, 3].norm(dim=-1)
    assert apart.mean() < 0.02
    lowest = [float(dressed_vertices(character, ours, t)[:, 2].min()) for t in times]
    assert -0.05 < np.percentile(lowest, 20) < 0.03


def test_a_person_who_is_hidden_is_told(caplog):
    warn_of_hiding(0.002)
    assert not caplog.messages
    warn_of_hiding(0.0004)
    assert "fills 0.04 % of the pictures" in caplog.text


def test_cut_motion_begins_at_zero():
    motion = load_motion(find_motion("dance_b"))
    part = cut_motion(motion, 0.5, 1.0)
    assert part.times_us[0] <= 0 < part.times_us[1]
    assert part.times_us[-2] < 1_000_000 <= part.times_us[-1]
    whole = motion.times_us.tolist().index(int(part.times_us[1]) + 500_000)
    assert np.array_equal(part.world_rotations[1], motion.world_rotations[whole])


def test_what_ships_has_its_licences():
    folder = find_character("man").parents[1]
    assert set(characters()) == {"man", "woman", "worker"}
    assert {"dance_b", "kick", "walk"} <= set(motions())
    text = (folder / "LICENSE.txt").read_text()
    for words in ("CC0", "MIT License", "LAAS-CNRS", "MakeHuman"):
        assert words in text
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    assert size < 8e6
    assert not list(folder.rglob("*.amc"))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"character": "nobody"}, "neither a file nor one of man, woman, worker"),
        ({"motion": "moonwalk"}, "neither a file nor one of"),
        ({"frames": 500}, "500 are asked for. Ask for fewer (--frames)"),
        ({"start_s": 60}, "gives 0 frames"),
        ({"exposure_ms": 50}, "shorten the exposure"),
        ({"width": 4}, "--width 4: expected an integer within 16 and 4096"),
        ({"fps": float("nan")}, "--fps nan"),
        ({"seed": -1}, "--seed -1: expected an integer of at least 0"),
        ({"orbit_deg": 60.0}, "--orbit 60: goes with --camera orbit"),
        ({"camera": "orbit", "orbit_deg": 90.0}, "--orbit 90: expected a number within -80 and 80"),
        ({"camera": "crane"}, "one of static, orbit, handheld"),
        ({"colour": "red"}, "colour: no such option"),
    ],
)
def test_bad_settings_get_one_sentence_and_leave_nothing(tmp_path, changes, said):
    with pytest.raises((DataError, ConfigError)) as raised:
        stage(tmp_path / "a", FAST, progress=False, **changes)
    assert said in str(raised.value) and "\n" not in str(raised.value)
    assert list(tmp_path.iterdir()) == []


def spoil(tmp_path, change) -> None:
    """A copy of a character with one array changed."""
    with np.load(find_character("man")) as archive:
        arrays = {key: archive[key] for key in archive.files}
    change(arrays)
    np.savez(tmp_path / "mine.npz", **arrays)
    Image.new("RGB", (8, 8)).save(tmp_path / "mine.png")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda a: a.pop("uv"), "uv missing"),
        (lambda a: a.update(uv=a["uv"][:5]), "uv has shape (5, 2), expected (15204, 2)"),
        (lambda a: a["vertices"].__setitem__((0, 0), np.nan), "vertices holds values"),
        (lambda a: a.update(uv=a["uv"].astype(str)), "uv is of type <U"),
        (lambda a: a.update(weights=a["weights"] + 1j), "weights is of type complex"),
        (lambda a: a.update(joint_names=a["parents"]), "joint_names is of type int"),
        (lambda a: a.update(vertices=a["vertices"][:0]), "vertices has shape (0, 3)"),
        (lambda a: a.update(faces=a["faces"] + 60000), "faces must hold"),
        (lambda a: a.update(body_vertices=a["body_vertices"][:9]), "body_vertices has 9 vertices"),
    ],
)
def test_bad_characters_get_one_sentence(tmp_path, change, said):
    spoil(tmp_path, change)
    with pytest.raises(DataError) as raised:
        load_character(tmp_path / "mine.npz")
    assert said in str(raised.value) and "mine.npz" in str(raised.value)


def test_own_character_without_extras_is_its_own_body(tmp_path):
    spoil(tmp_path, lambda a: [a.pop(k) for k in ("normals", "cutout", "cloth", "body_vertices")])
    mine, shipped = (load_character(p) for p in (tmp_path / "mine.npz", find_character("man")))
    assert len(mine.body.rest_vertices) == len(mine.vertices)
    assert np.median((mine.normals * shipped.normals).sum(1)) > 0.99


def test_command_line_makes_what_python_makes(tmp_path, capsys):
    arguments = "--character woman --motion walk --size 32 --height 24 --frames 2 --fps 50"
    arguments += " --exposure-ms 5 --no-shadow --novel-views none --camera handheld --seed 7"
    assert main(["stage", str(tmp_path / "cli"), *arguments.split()]) == 0
    settings = json.loads((tmp_path / "cli" / "capture.json").read_text())["provenance"]["settings"]
    assert settings["width"] == 32 and settings["height"] == 24 and settings["seed"] == 7
    assert settings["shadows"] is False and settings["camera"] == "handheld"
    assert load_capture(tmp_path / "cli").novel_views == ()
    assert "capture: " in capsys.readouterr().out


def test_command_line_lists_and_explains(tmp_path, capsys):
    assert main(["stage", "--list"]) == 0
    out = capsys.readouterr().out
    assert "characters: man, woman, worker" in out and "spinkick" in out
    assert main(["stage"]) == 2
    assert "needs a folder" in capsys.readouterr().err
    assert main(["stage", str(tmp_path / "a"), "--character", "x"]) == 2
    assert "neither a file" in capsys.readouterr().err
