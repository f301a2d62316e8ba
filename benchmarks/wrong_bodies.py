"""How often a wrong body is noticed, and how often a right one is called wrong.

    python benchmarks/wrong_bodies.py [--characters C ...] [--motions M ...] [--count N] [--size PX]
        [--seed S] [--variants V ...] [--captures CAPTURE ...] [--out FOLDER]

Stages captures at random (character, motion, turn, frame rate, exposure, sensor, cloth, shadow, and
poses that are exact or off as markers or estimators are). Each is judged with its own body and with
a wrong one, by turns: of another capture, 8 to 14 pixels beside, 2 to 4 frames early or late. The
same again without events, with dark pictures (events alone) and with a textured square that passes
through the picture, and whether something else than the person is said to move. ``--captures`` are
judged apart, with their own and with each other's bodies.
Staged captures stay in the folder. Times are of one thread. The last line is one JSON object.
"""

import argparse
import json
import logging
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

import evsplat as ev
from evsplat.body import BodyTrack
from evsplat.capture import Capture, Policy, load_body_track, load_capture
from evsplat.capture.derive import Derivation, derived_capture
from evsplat.errors import ConfigError
from evsplat.events import EventStream, write_events
from evsplat.events.simulator import PRESETS, SensorSimulator
from evsplat.inspection import Belonging, judge_body
from evsplat.pictures import decode, encode, luminance

CHARACTERS = ("woman", "worker")
MOTIONS = ("punch", "run", "spin", "spinkick", "walk")
NOISE = ("none", "mocap", "estimated", "estimated-blurry")
SENSORS = ("clean", "davis346", "dvxplorer", "evk4")
RATES_HZ = (12.5, 25.0, 50.0)
WRONG = ("another", "shifted", "late")
_SUBFRAMES = 6
_SQUARE = 0.2
"""Side of the square that passes through, in heights of the picture."""


def stage_one(folder: Path, index: int, options: argparse.Namespace) -> Path:
    """A capture with settings drawn at random; the file names say which."""
    rng = np.random.default_rng((options.seed, index))
    motion = options.motions[index % len(options.motions)]
    fps = float(rng.choice(RATES_HZ))
    settings = {
        "character": options.characters[index // len(options.motions) % len(options.characters)],
        "motion": motion,
        "fps": fps,
        "exposure_ms": round(float(rng.uniform(0.3, 0.95)) * 1000 / fps, 1),
        "events": str(rng.choice(SENSORS)),
        "pose_noise": NOISE[(index + index // len(NOISE)) % len(NOISE)],
        "yaw_deg": float(rng.uniform(-180, 180)),
        "cloth_mm": float(rng.choice([0, 8])),
        "shadows": bool(rng.random() < 0.8),
    }
    name = "_".join(str(settings[key]) for key in ("character", "motion", "fps", "pose_noise"))
    path = folder / f"{index:02d}_{name}"
    frames = int(rng.integers(12, 25))
    while not path.exists():
        try:
            ev.stage(
                path,
                width=options.size,
                frames=frames,
                novel_views="none",
                seed=index,
                threads=1,
                progress=False,
                **settings,
            )
        except ConfigError:  # the motion is shorter
            frames -= 2
            if frames < 4:
                raise
    return path


def without_events(making: Derivation) -> None:
    """A recording of frames alone."""
    making.document["events"] = None


def in_the_dark(making: Derivation) -> None:
    """A recording whose pictures show nothing, so that events alone tell."""
    for frame in making.source.frames:
        making.set_picture(frame, "image", torch.zeros_like(making.source.image(frame)))


def with_passer_by(making: Derivation) -> None:
    """A textured square crosses the pictures, before the person, with the events that it makes."""
    source = making.source
    frames, events = source.frames, source.events
    assert events is not None
    rng = np.random.default_rng(len(source.name))
    height, width = source.image(frames[0]).shape[:2]
    side = int(_SQUARE * height)
    texture = torch.from_numpy(rng.random((side, side, 3)).astype(np.float32) ** 2.2)
    start, end = frames[0].exposure_us[0], frames[-1].exposure_us[1]
    top, way = int(rng.integers(0, height - side)), width + side

    def paint(light: torch.Tensor, time_us: float) -> torch.Tensor:
        left = round((time_us - start) / (end - start) * way) - side
        first, last = max(left, 0), min(left + side, width)
        painted = light.clone()
        if first < last:
            painted[top : top + side, first:last] = texture[:, first - left : last - left]
        return painted

    for frame in frames:
        light = decode(source.image(frame))
        times = np.linspace(*frame.exposure_us, 2 * _SUBFRAMES + 1)[1::2]
        blurred = torch.stack([paint(light, t) for t in times]).mean(0)
        making.set_picture(frame, "image", encode(blurred))
    still = decode(source.median_background())
    sensor = SensorSimulator(width, height, PRESETS["clean"], 0)
    passing = [sensor.step(luminance(paint(still, t)), t) for t in range(start, end, 1000)]
    recorded = events.between(*events.time_range_us)
    streams = (recorded, EventStream.joined(passing))
    order = np.argsort(np.concatenate([stream.t for stream in streams]), kind="stable")
    merged = EventStream(
        *(
            np.concatenate([getattr(s, name) for s in streams])[order]
            for name in ("t", "x", "y", "p")
        )
    )
    file = making.folder / making.document["events"]["file"]
    file.unlink()  # it may be a hard link, and what it is linked to must stay
    write_events(file, merged, width=width, height=height)
    making.document["events"]["clock_offset_us"] = 0


VARIANTS: dict[str, Callable[[Derivation], None] | None] = {
    "frames_and_events": None,
    "frames_alone": without_events,
    "events_alone": in_the_dark,
    "passer_by": with_passer_by,
}


def wrong_body(
    kind: str, capture: Capture, other: Capture, rng: np.random.Generator
) -> tuple[BodyTrack, str]:
    """A wrong body for ``capture``, and how it is wrong in words."""
    mids = np.array([frame.mid_us for frame in capture.frames])
    if kind == "another":
        track = load_body_track(other)
        key = np.minimum(np.arange(len(mids)), len(track.times_us) - 1)
        moved = BodyTrack(track.body, mids, track.poses[key], track.transl[key])
        return moved, f"that of {other.name}"
    track = load_body_track(capture)
    if kind == "late":
        delay = int(rng.choice([-4, -3, -2, 2, 3, 4]))
        times = track.times_us + delay * round(float(np.median(np.diff(mids))))
        return BodyTrack(track.body, times, track.poses, track.transl), f"{delay:+d} frames late"
    angle, length = rng.uniform(0, 2 * np.pi), rng.uniform(8, 14)
    camera = capture.camera(capture.frames[0])
    _, depth = camera.project(track.vertices(int(mids[len(mids) // 2])))
    step = np.array([np.cos(angle), np.sin(angle), 0]) * length * float(depth.mean())
    world = camera.world_to_camera[:3, :3].numpy().T @ (step / float(camera.K[0, 0]))
    shifted = BodyTrack(track.body, track.times_us, track.poses, track.transl + world)
    return shifted, f"{length * np.cos(angle):+.0f}, {length * np.sin(angle):+.0f} px beside"


def judged(capture: Capture, track: BodyTrack | None, label: str) -> tuple[Belonging, float]:
    """The judgement of a body, its seconds, and a line about it."""
    start = time.perf_counter()
    found = judge_body(capture.for_training(Policy()), track)
    seconds = time.perf_counter() - start
    order, follows = (
        "-" if told is None else f"{told:.2f}" for told in (found.order, found.follows)
    )
    print(
        f"{label:78} {found.verdict:8} {found.score:5.2f} of {found.best_score:.2f}, "
        f"order {order}, follows {follows}, off {found.shift_px[0]:+5.1f} "
        f"{found.shift_px[1]:+5.1f} px {found.delay_frames:+.1f} frames, {seconds:.2f} s"
        f"{'' if found.elsewhere is None else f', {found.elsewhere.sentence}'}",
        flush=True,
    )
    return found, seconds


def compare(paths: Sequence[Path], options: argparse.Namespace) -> dict[str, float]:
    """Judge staged captures, right and wrong, in all variants."""
    results: dict[str, float] = {}
    spent = []
    for variant in options.variants:
        change, captures = VARIANTS[variant], []
        for path in paths:
            folder = options.out / variant / path.name
            if change is not None and not folder.exists():
                with derived_capture(load_capture(path), folder) as making:
                    change(making)
            captures.append(load_capture(path if change is None else folder))
        counts = {
            f"{kind}_{what}": 0 for kind in ("right", *WRONG) for what in ("n", "warned", "refused")
        }
        counts["right_others"] = 0
        for index, capture in enumerate(captures):
            rng = np.random.default_rng((options.seed, index, 1))
            wrong = WRONG[index % len(WRONG)]
            other = captures[(index + 1 + int(rng.integers(len(captures) - 1))) % len(captures)]
            track, how = wrong_body(wrong, capture, other, rng)
            for kind, body, label in (("right", None, "its own"), (wrong, track, how)):
                found, seconds = judged(capture, body, f"{variant} {capture.name}: {label}")
                spent.append(seconds)
                counts[f"{kind}_n"] += 1
                counts[f"{kind}_warned"] += found.verdict != "belongs"
                counts[f"{kind}_refused"] += found.verdict == "another"
                if body is None:
                    counts["right_others"] += found.elsewhere is not None
        results |= {f"{variant}_{name}_count": count for name, count in counts.items()}
    return results | {"slowest_s": round(max(spent), 2), "mean_s": round(float(np.mean(spent)), 2)}


def apart(paths: Sequence[Path]) -> dict[str, float]:
    """Judge recorded captures with their own and with each other's bodies."""
    captures = [load_capture(path) for path in paths]
    counts = {
        "right_n": 0,
        "right_warned": 0,
        "right_others": 0,
        "another_n": 0,
        "another_warned": 0,
    }
    counts["another_refused"] = 0
    for capture in captures:
        for other in captures:
            if other is capture:
                found, _ = judged(capture, None, f"{capture.name}: its own")
                counts["right_n"] += 1
                counts["right_warned"] += found.verdict != "belongs"
                counts["right_others"] += found.elsewhere is not None
            else:
                track, how = wrong_body("another", capture, other, np.random.default_rng(0))
                found, _ = judged(capture, track, f"{capture.name}: {how}")
                counts["another_n"] += 1
                counts["another_warned"] += found.verdict != "belongs"
                counts["another_refused"] += found.verdict == "another"
    return {f"apart_{name}_count": count for name, count in counts.items()}


def main() -> None:
    """Stage what is missing, judge, and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--characters", nargs="*", default=list(CHARACTERS))
    parser.add_argument("--motions", nargs="*", default=list(MOTIONS))
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--variants", nargs="*", default=list(VARIANTS), choices=list(VARIANTS))
    parser.add_argument("--captures", nargs="*", type=Path, default=[])
    parser.add_argument("--out", type=Path, default=Path("bench/wrong_bodies"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    logging.getLogger("evsplat").setLevel(logging.ERROR)
    paths = [stage_one(options.out / "staged", k, options) for k in range(options.count)]
    results = compare(paths, options) | apart(options.captures)
    for name, value in results.items():
        print(f"{name:44} {value}")
    print(json.dumps(results))


if __name__ == "__main__":
    main()
