"""The evaluator on small captures, whole and with parts missing."""

import json
import logging
import os
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from evsplat.capture import Capture, Policy, load_capture
from evsplat.capture.policy import Terms, terms_of
from evsplat.cli.runs import summary_table
from evsplat.disk import held
from evsplat.errors import ConfigError, DataError
from evsplat.evaluation import evaluate
from evsplat.evaluation import run as evaluation_run
from evsplat.evaluation.event_maps import chosen_pairs, evaluate_event_maps
from evsplat.evaluation.protocols import METRICS, PSNR_CEILING_DB, REGIONS
from evsplat.evaluation.regions import Absent
from evsplat.evaluation.report.figures import figures
from evsplat.evaluation.tables import write_tables
from evsplat.methods.trivial import MedianBackground
from evsplat.similarity.lpips import WEIGHTS_VARIABLE

from .helpers import TruthWithNoise, drop, edit


@pytest.fixture(autouse=True)
def nobody_has_weights(monkeypatch, tmp_path):
    """LPIPS's weights are absent; ST-LPIPS is left out to be quick."""
    monkeypatch.delenv(WEIGHTS_VARIABLE, raising=False)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)


def run(path, out, noise=0.1):
    capture = load_capture(path)
    metrics = evaluate(capture, TruthWithNoise(capture, noise), out_dir=out)
    json.dumps(metrics, allow_nan=False)
    return metrics


def test_every_key_of_the_schema_is_there_and_means_are_means(tiny_capture, tmp_path):
    metrics = run(tiny_capture(frames=20, width=48, height=40), tmp_path / "run")
    assert list(metrics["protocols"]) == ["standard", "avatar-compat", "hugs-compat"]
    rows = [*metrics["protocols"].values(), *metrics["trivial"].values(), metrics["blurry_input"]]
    rows += [row for rows in metrics["compat_rows"].values() for row in rows.values()]
    assert all(tuple(row) == REGIONS for row in rows)
    assert all(tuple(row[region]) == METRICS for row in rows for region in REGIONS)
    assert set(metrics["trivial"]) == {"median_background", "nearest_frame"}
    assert len(metrics["per_frame"]) == 6
    for protocol, regions in metrics["protocols"].items():
        for region in REGIONS:
            values = [f["protocols"][protocol][region]["psnr"] for f in metrics["per_frame"]]
            assert regions[region]["psnr"] == pytest.approx(np.mean(values))
    assert set(metrics["novel_views"]["side"]) == {"full", "person_crop", "per_view"}


def test_training_frames_are_measured_against_their_own_truth(tiny_capture, tmp_path):
    capture = load_capture(tiny_capture(frames=20, width=48, height=40))
    both = {
        split: evaluate(capture, TruthWithNoise(capture, 0.1), out_dir=tmp_path, split=split)
        for split in ("test", "train")
    }
    trained = both["train"]
    assert [both[split]["split"] for split in both] == ["test", "train"]
    names = [frame.name for frame in capture.train_frames]
    assert [entry["frame"] for entry in trained["per_frame"]] == names
    # the same noise on other pictures
    psnr = trained["protocols"]["standard"]["full"]["psnr"]
    assert psnr == pytest.approx(both["test"]["protocols"]["standard"]["full"]["psnr"], abs=1)
    # the nearest training frame is the blurry picture itself
    assert list(trained["trivial"]) == ["median_background"]
    own = [
        -10 * np.log10(float((capture.image(name) - capture.sharp(name)).square().mean()))
        for name in names
    ]
    assert trained["blurry_input"]["full"]["psnr"] == pytest.approx(np.mean(own), abs=1e-3)
    assert trained["novel_views"] == {} and trained["events"] is None
    assert "events" in trained["reasons"]
    written = {path.name for path in (tmp_path / "pictures").iterdir()}
    assert {f"train_{name}_render.png" for name in names} <= written
    assert {f"test_{frame.name}_render.png" for frame in capture.test_frames} <= written
    write_tables(tmp_path, {**trained, "policy": {}})
    text = (tmp_path / "metrics_train.md").read_text("utf-8")
    assert f"Means over {len(names)} training frames" in text and "training saw it" in text
    assert "Training frames" in (tmp_path / "metrics_train.tex").read_text("utf-8")


def test_pictures_that_are_the_truth_themselves_are_no_row(tiny_capture, tmp_path):
    def sharp_is_image(document):
        for frame in document["frames"]:
            frame["image"] = frame["sharp"]

    path = edit(tiny_capture(frames=20, width=48, height=40), sharp_is_image)
    metrics = run(path, tmp_path)
    assert metrics["protocols"]["standard"]["full"]["psnr"] == pytest.approx(20, abs=2)
    assert set(metrics["blurry_input"]["full"].values()) == {None}
    assert "is taken as the sharp truth" in metrics["reasons"]["blurry_input.full.psnr"]
    write_tables(tmp_path, metrics)
    told = (tmp_path / "metrics.md").read_text() + summary_table(metrics)
    told += figures(SimpleNamespace(metrics=metrics))
    for words in ("blurry input itself", "own blurry picture", "Against the blurry pictures"):
        assert words not in told
    assert "nearest" in told


def test_training_frames_without_truth_are_refused(tiny_capture, tmp_path):
    capture = load_capture(edit(tiny_capture(), drop("sharp")))
    said = "capture.json: none of the 7 training frames names a sharp"
    with pytest.raises(DataError, match=said):
        evaluate(capture, TruthWithNoise(capture), out_dir=tmp_path / "run", split="train")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("split", ["val", "Train", "", None])
def test_a_split_that_there_is_none_of_is_refused(tiny_capture, tmp_path, split):
    capture = load_capture(tiny_capture())
    said = f"--split {split}: expected test or train"
    with pytest.raises(ConfigError, match=said):
        evaluate(capture, TruthWithNoise(capture), out_dir=tmp_path / "run", split=split)
    assert not (tmp_path / "run").exists()
    with pytest.raises(ConfigError, match=said):
        evaluation_run.write_report(tmp_path, split=split)


def test_a_person_who_is_in_no_frame_is_remarked(tiny_capture, tmp_path, caplog):
    path = tiny_capture()
    assert run(path, tmp_path / "a")["remarks"] == []
    for mask in (path / "masks").iterdir():
        Image.new("L", Image.open(mask).size).save(mask)
    metrics = run(path, tmp_path / "b")
    (remark,) = metrics["remarks"]
    assert "the person is in no test frame" in remark and remark in caplog.text
    write_tables(tmp_path, {**metrics, "policy": {}})
    words = (tmp_path / "metrics.md").read_text("utf-8").replace("\\", "")
    assert remark in words


def test_missing_weights_are_null_with_the_reason(tiny_capture, tmp_path):
    metrics = run(tiny_capture(), tmp_path / "run")
    assert metrics["protocols"]["standard"]["full"]["lpips_vgg"] is None
    assert metrics["weights"]["lpips_vgg"]["sha256"] is None
    assert "vgg16-397923af.pth" in metrics["weights"]["lpips_vgg"]["reason"]
    assert "perceptual" in metrics["weights"]["st_lpips"]["reason"]
    assert "weights.lpips_vgg" in metrics["reasons"]["protocols.standard.full.lpips_vgg"]


def test_every_null_has_a_reason(tiny_capture, tmp_path):
    metrics = run(tiny_capture(), tmp_path / "run")
    paths = {f"protocols.{name}": row for name, row in metrics["protocols"].items()}
    paths |= {f"trivial.{name}": row for name, row in metrics["trivial"].items()}
    paths |= {key: metrics[key] for key in ("blurry_input", "blurry_ground_truth")}
    for path, row in paths.items():
        for region in REGIONS:
            for metric, value in row[region].items():
                assert value is not None or metrics["reasons"][f"{path}.{region}.{metric}"]


def test_the_truth_itself_reaches_the_ceiling_and_beats_all_rows(tiny_capture, tmp_path):
    metrics = run(tiny_capture(), tmp_path / "run", noise=0.0)
    ours = metrics["protocols"]["standard"]["full"]
    assert ours["psnr"] == PSNR_CEILING_DB and ours["ssim"] == pytest.approx(1)
    for row in (*metrics["trivial"].values(), metrics["blurry_input"]):
        assert row["full"]["psnr"] < 60
    assert metrics["novel_views"]["side"]["full"]["psnr"] == PSNR_CEILING_DB
    # against the blurry picture the truth is as far off as the blurry picture is from the truth
    assert metrics["blurry_ground_truth"]["full"]["psnr"] == pytest.approx(
        metrics["blurry_input"]["full"]["psnr"]
    )


def test_pictures_are_written_for_all_test_frames_and_views(tiny_capture, tmp_path):
    out = tmp_path / "run"
    metrics = run(tiny_capture(), out)
    named = [path for f in metrics["per_frame"] for path in f["pictures"].values()]
    views = metrics["novel_views"]["side"]["per_view"]
    named += [path for view in views for path in view["pictures"].values()]
    named += [path for pair in metrics["events"]["pairs"] for path in pair["pictures"].values()]
    assert {str(p.relative_to(out)) for p in (out / "pictures").iterdir()} == set(named)
    assert all(Image.open(out / path).size == (32, 24) for path in named)


def test_the_true_motion_explains_the_events_and_a_still_picture_does_not(tiny_capture, tmp_path):
    path = tiny_capture(frames=20, width=48, height=40)
    similarity = run(path, tmp_path / "a", noise=0.0)["events"]["mean_similarity"]
    # not 1: events come in steps of the threshold, which are large beside this small motion
    assert similarity["test"] > 0.85 and similarity["train"] > 0.85
    capture = load_capture(path)
    still = TruthWithNoise(capture)
    still._picture = lambda camera, time: capture.sharp(capture.frames[0])
    edit(path, lambda document: document.update(novel_views=[]))
    pairs = evaluate(load_capture(path), still, out_dir=tmp_path / "b")["events"]["pairs"]
    assert all(pair["similarity"] is None for pair in pairs)


def test_frames_of_event_pairs_are_drawn_once(tiny_capture, tmp_path):
    capture = load_capture(tiny_capture(frames=20, width=48, height=40))
    source, drawn = TruthWithNoise(capture), []
    picture = source._picture
    source._picture = lambda camera, time: drawn.append((camera, time)) or picture(camera, time)
    pairs = evaluate(capture, source, out_dir=tmp_path)["events"]["pairs"]
    frames = {name for pair in pairs for name in pair["frames"]}
    frames |= {frame.name for frame in capture.test_frames}
    assert len(frames) < 2 * len(pairs)
    assert len(drawn) == len(frames) + len(capture.novel_views)


def test_event_pairs_hold_every_test_frame_and_some_of_training_only(tiny_capture):
    capture = load_capture(tiny_capture(frames=30))
    pairs = chosen_pairs(capture)
    assert all(after.index == before.index + 1 for before, after in pairs)
    test = {frame.name for pair in pairs for frame in pair if frame.split == "test"}
    assert test == {frame.name for frame in capture.test_frames}
    assert sum(all(frame.split == "train" for frame in pair) for pair in pairs) == 3


def test_of_one_frame_there_are_no_event_maps_and_the_reason_is_told(tiny_capture):
    def drawn(*_):
        raise AssertionError("there is nothing to draw")

    path = edit(
        tiny_capture(),
        lambda document: document.update(
            frames=[frame for frame in document["frames"] if frame["split"] == "train"][:1],
            novel_views=[],
        ),
    )
    found = evaluate_event_maps(load_capture(path), drawn, drawn)
    assert isinstance(found, Absent) and "no camera has two" in found.reason


def test_without_truth_the_figures_are_null_and_the_blurry_comparison_remains(
    tiny_capture, tmp_path
):
    metrics = run(edit(tiny_capture(), drop("sharp")), tmp_path / "run")
    assert metrics["protocols"]["standard"]["full"]["psnr"] is None
    reason = metrics["reasons"]["protocols.standard.full.psnr"]
    assert reason == "the frame has no sharp ground truth"
    assert metrics["blurry_ground_truth"]["full"]["psnr"] > 10
    assert "error" not in metrics["per_frame"][0]["pictures"]


def test_without_masks_the_posed_body_gives_the_crop(tiny_capture, tmp_path):
    with_mask = run(tiny_capture("a", width=96, height=80), tmp_path / "run_a")
    path = edit(tiny_capture("b", width=96, height=80), drop("mask"))
    without = run(path, tmp_path / "run_b")
    crops = [m["protocols"]["standard"]["person_crop"]["psnr"] for m in (with_mask, without)]
    # the boxes differ by a pixel at most: the mask covers pixels only in part
    assert crops[1] == pytest.approx(crops[0], abs=0.3)
    assert without["protocols"]["standard"]["person_mask"]["psnr"] is None


def test_without_events_and_novel_views_both_say_so(tiny_capture, tmp_path):
    def change(document):
        document.pop("events")
        document["novel_views"] = []

    metrics = run(edit(tiny_capture(), change), tmp_path / "run")
    assert metrics["events"] is None and "no events" in metrics["reasons"]["events"]
    assert metrics["novel_views"] == {} and "novel" in metrics["reasons"]["novel_views"]


def test_a_moving_camera_has_no_median_background(tiny_capture, tmp_path):
    def change(document):
        pose = document["cameras"]["main"]["world_to_camera"]
        for number, frame in enumerate(document["frames"]):
            aside = pose[0][:3] + [pose[0][3] + 1e-4 * number]
            frame["world_to_camera"] = [aside, *pose[1:]]

    metrics = run(edit(tiny_capture(), change), tmp_path / "run")
    assert metrics["trivial"]["median_background"]["full"]["psnr"] is None
    assert "camera moves" in metrics["reasons"]["trivial.median_background.full.psnr"]
    assert metrics["trivial"]["nearest_frame"]["full"]["psnr"] > 10


def test_a_grey_capture_is_measured_like_a_colour_one(tiny_capture, tmp_path):
    path = tiny_capture()
    for file in (*path.glob("images/*.png"), *path.glob("sharp/*.png")):
        Image.open(file).convert("L").save(file)
    metrics = run(path, tmp_path / "run", noise=0.0)
    assert metrics["protocols"]["standard"]["full"]["psnr"] == PSNR_CEILING_DB


def test_a_person_out_of_sight_in_one_frame_is_left_out_of_the_mean(tiny_capture, tmp_path):
    path = tiny_capture()
    empty = Image.fromarray(np.zeros((24, 32), dtype=np.uint8))
    empty.save(path / "masks" / "0008.png")
    metrics = run(path, tmp_path / "run")
    values = [f["protocols"]["standard"]["person_mask"]["psnr"] for f in metrics["per_frame"]]
    assert values[1] is None
    assert metrics["protocols"]["standard"]["person_mask"]["psnr"] == pytest.approx(
        (values[0] + values[2]) / 2
    )
    reason = metrics["reasons"]["protocols.standard.person_mask.psnr"]
    assert reason == "missing in 1 of 3: the person mask is empty"


def test_a_person_in_few_test_frames_or_none_is_told(tiny_capture, tmp_path, caplog):
    path = tiny_capture()
    for frame in load_capture(path).test_frames[1:]:
        Image.new("L", (32, 24)).save(frame.mask)
    (remark,) = run(path, tmp_path / "some")["remarks"]
    assert remark in caplog.text and "the person is in no test frame" not in remark
    assert remark.startswith(f"{path}: the person is in 1 of 3 test frames: crop and mask are ")
    for frame in load_capture(path).test_frames:
        Image.new("L", (32, 24)).save(frame.mask)
    run(path, tmp_path / "none")
    assert f"{path}: the person is in no test frame, so the figures" in caplog.text


def run_of(capture: Capture, path: Path) -> SimpleNamespace:
    """What `load_run` might give of a folder, which is made with no more than its first file."""
    path.mkdir()
    (path / "config.yaml").touch()
    return SimpleNamespace(
        path=path,
        capture=capture,
        reconstruction=TruthWithNoise(capture, 0.05),
        beside=lambda: TruthWithNoise(capture, 0.0),
        iteration=1200,
        train_seconds=61.5,
        human_only=False,
        what_was_seen=lambda: {"little_seen": 0.5},
        device="cpu",
        gaussians={"human": 10, "scene": 20},
        policy=Policy(held_out_events=True),
    )


def test_an_evaluation_waits_for_another_one_before_it_reads_the_run(
    tiny_capture, tmp_path, monkeypatch, caplog
):
    out, read = tmp_path / "run", threading.Event()
    trained = run_of(load_capture(tiny_capture()), out)

    def load_run(path, **_):
        read.set()
        return trained

    monkeypatch.setattr(evaluation_run, "load_run", load_run)
    caplog.set_level(logging.INFO, logger="evsplat.files")
    with held(out / ".evaluating"):  # by another descriptor, as of another process
        second = threading.Thread(target=evaluation_run.evaluate_run, args=[out])
        second.start()
        assert not read.wait(2.0)
        assert {path.name for path in out.iterdir()} == {"config.yaml", ".evaluating"}
    second.join(60.0)
    assert read.is_set() and (out / "metrics.json").exists()
    assert not (out / ".evaluating").exists()
    (told,) = (record.message for record in caplog.records if record.name == "evsplat.files")
    assert told.startswith(f"{out}: process {os.getpid()} is evaluating this run")


def test_a_run_gets_its_facts_and_tables(tiny_capture, tmp_path, monkeypatch):
    capture = load_capture(tiny_capture("under_score"))
    out = tmp_path / "run"
    trained = run_of(capture, out)
    monkeypatch.setattr(evaluation_run, "load_run", lambda path, **_: trained)
    metrics = evaluation_run.evaluate_run(out)
    # Novel views alone are what cameras beside the recording one see.
    novel = metrics["novel_views"]["side"]["full"]["psnr"]
    assert novel == PSNR_CEILING_DB > metrics["protocols"]["standard"]["full"]["psnr"]
    assert json.loads((out / "metrics.json").read_text()) == metrics
    facts = ["capture", "method", "iteration", "train_seconds", "device", "gaussians"]
    assert list(metrics)[:6] == facts and metrics["iteration"] == 1200
    assert terms_of(metrics) == Terms(held_out_events=True)
    psnr = f"{metrics['protocols']['standard']['full']['psnr']:.2f}"
    for name in ("metrics.md", "metrics.tex"):
        text = (out / name).read_text()
        assert psnr in text and "median background" in text and "hugs-compat" in text
    assert r"truth\_with\_noise" in (out / "metrics.tex").read_text()


def test_a_method_that_knows_one_camera_only_has_null_novel_views(tiny_capture, tmp_path):
    capture = load_capture(tiny_capture())
    metrics = evaluate(capture, MedianBackground(capture), out_dir=tmp_path / "run")
    assert metrics["novel_views"]["side"]["full"]["psnr"] is None
    assert "recording camera" in metrics["reasons"]["novel_views.side.full.psnr"]


def test_a_capture_without_test_frames_has_null_figures(tiny_capture, tmp_path):
    path = edit(tiny_capture(), lambda d: [f.update(split="train") for f in d["frames"]])
    metrics = run(path, tmp_path / "run")
    assert metrics["protocols"]["standard"]["full"]["psnr"] is None and not metrics["per_frame"]
    assert metrics["reasons"]["protocols.standard.full.psnr"] == "no picture to measure"
