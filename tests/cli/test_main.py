"""Exit codes, messages and help of the command line."""

import re
import subprocess
import sys
from itertools import pairwise
from types import SimpleNamespace

import pytest

import evsplat
from evsplat.cli import main
from evsplat.cli.main import _gathered
from evsplat.shipped import demo_capture
from evsplat.training_sign import training_in

VERBS = ("demo", "doctor", "simulate", "synthesize", "stage", "inspect", "masks", "poses")
VERBS += ("restore", "settings", "train", "evaluate", "report", "render", "view", "export", "bench")


def _outcome(capsys, *arguments):
    """Exit code, stdout and stderr of a call."""
    try:
        code = main(arguments)
    except SystemExit as stop:
        code = stop.code
    return code, *capsys.readouterr()


@pytest.mark.parametrize("verb", ["inspect", "masks", "restore", "train"])
def test_missing_capture_is_one_message_and_code_2(capsys, tmp_path, verb):
    out = ["--out", str(tmp_path / "out")]
    code, stdout, stderr = _outcome(capsys, verb, str(tmp_path / "nothing"), *out)
    assert code == 2
    assert str(tmp_path / "nothing") in stdout + stderr
    assert "Traceback" not in stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        ("train c --set A=1 --out o --set B=2 C=-3 -h", "train c --set A=1 B=2 C=-3 --out o -h"),
        ("train --set A=1 B=2 --seed 3", "train --set A=1 B=2 --seed 3"),
        ("inspect c --out o", "inspect c --out o"),
        ("train c --set=A=1 --seed 3 --set B=2", "train c --set A=1 B=2 --seed 3"),
        ("bench s --only a --seeds 1 --only b", "bench s --only a b --seeds 1"),
        ("bench s --seeds 1 -2 --jobs 1", "bench s --seeds 1 -2 --jobs 1"),
        ("bench s --captures a --captures b --add x=y", "bench s --captures a b --add x=y"),
        ("bench s --add x=y --jobs 1 --add u=v", "bench s --add x=y u=v --jobs 1"),
        (
            "simulate v --set shot_hz=2 --out e.h5 --set leak_hz=1",
            "simulate v --set shot_hz=2 leak_hz=1 --out e.h5",
        ),
        (
            "import zju-mocap s --novel-cameras 1 --out o --novel-cameras 2",
            "import zju-mocap s --novel-cameras 1 2 --out o",
        ),
        ("convert a b --columns x,y --columns t", "convert a b --columns x,y --columns t"),
        ("import", "import"),
        ("--set A=1 --set B=2", "--set A=1 --set B=2"),
    ],
)
def test_settings_given_one_by_one_all_count(given, meant):
    assert _gathered(given.split()) == meant.split()


@pytest.mark.parametrize("arguments", [["--help"], ["inspect", "--help"]])
def test_a_reader_that_goes_away_is_no_traceback(arguments):
    process = subprocess.Popen(
        [sys.executable, "-m", "evsplat", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None and process.stderr is not None
    process.stdout.close()
    assert process.stderr.read() == ""
    assert process.wait() == 141


@pytest.mark.parametrize("verb", ["evaluate", "report", "render"])
def test_folder_that_is_no_run_is_one_message_and_code_2(capsys, tmp_path, verb):
    code, _, stderr = _outcome(capsys, verb, str(tmp_path))
    assert code == 2
    assert stderr.startswith(f"evsplat: {tmp_path}")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "parts"),
    [
        (["--method", "papr"], ["papr", "Did you mean paper?"]),
        (["--set", "event_wieght=0.2"], ["event_wieght", "Did you mean event_weight?"]),
        (["--set", "iterations=many"], ["iterations", "'many'"]),
        (["--set", "event_weight"], ["event_weight", "KEY=VALUE"]),
        (["--config", "missing.yaml"], ["missing.yaml", "not found"]),
        (["--device", "cuda"], ["--device cuda", "--device cpu"]),
        (["--iterations", "0"], ["--iterations 0", "at least 1"]),
        (["--max-minutes", "-1"], ["--max-minutes -1", "above 0"]),
        (["--threads", "0"], ["--threads 0", "at least 1"]),
        (["--view", "--port", "99999"], ["--port 99999", "within 1 and 65535"]),
        (["--resume"], ["no such run folder|not a run folder|config.yaml"]),
    ],
)
def test_bad_training_options_say_what_is_wrong(capsys, tmp_path, options, parts):
    run = str(tmp_path / "run")
    code, _, stderr = _outcome(capsys, "train", str(demo_capture()), "--out", run, *options)
    assert code == 2
    for part in parts:
        assert any(choice in stderr for choice in part.split("|")), stderr
    assert "Traceback" not in stderr


def test_misspelt_option_is_answered_with_the_nearest(capsys):
    code, stdout, stderr = _outcome(capsys, "train", "capture", "--max-minuts", "3")
    assert code == 2
    assert "--max-minutes" in stdout + stderr


def test_ctrl_c_is_code_130_and_says_how_to_go_on(capsys, monkeypatch, tmp_path):
    import evsplat.training
    from evsplat.training import Stopped

    def interrupted(capture, options, **_):
        raise Stopped(tmp_path / "my run")

    monkeypatch.setattr(evsplat.training, "train", interrupted)
    code, _, stderr = _outcome(capsys, "train", str(demo_capture()))
    assert code == 130
    assert f"evsplat train {demo_capture()} --out '{tmp_path}/my run' --resume" in stderr
    assert "Traceback" not in stderr


def test_the_demo_trains_on_poses_that_were_found(capsys, monkeypatch, tmp_path):
    import evsplat.posing
    import evsplat.training

    def found(capture, out, search, **_):
        assert capture == demo_capture()
        return SimpleNamespace(summary=f"found: {out}")

    def stopped(capture, options, **_):
        raise evsplat.training.Stopped(capture)

    monkeypatch.setattr(evsplat.posing, "find_poses", found)
    monkeypatch.setattr(evsplat.training, "train", stopped)
    _, stdout, stderr = _outcome(capsys, "demo", "--find-poses")
    assert "found: captures/demo_" in stdout
    assert f"--out {stdout.split()[1]} --resume" in stderr


def test_the_demo_reads_its_run_once_for_films_avatar_and_figures(capsys, monkeypatch, tmp_path):
    import evsplat.evaluation.run
    import evsplat.export
    import evsplat.training

    loaded, given = object(), []
    monkeypatch.setattr(evsplat.training, "train", lambda capture, options, **_: tmp_path)
    monkeypatch.setattr(evsplat.training, "load_run", lambda run, **_: loaded)
    for name in ("render_run", "export_run"):
        monkeypatch.setattr(evsplat.export, name, lambda run, *_, **__: given.append(run))

    def measured(run, **_):
        given.append(run)
        return {"frames": {"train": 1, "test": 0}, "per_frame": []}, tmp_path / "report.html"

    monkeypatch.setattr(evsplat.evaluation.run, "evaluate_and_report", measured)
    code, stdout, _ = _outcome(capsys, "demo")
    assert code == 0
    assert given == [loaded] * 4
    assert f"run:    {tmp_path}\nreport: {tmp_path / 'report.html'}" in stdout


def test_ctrl_c_during_evaluation_says_that_the_training_is_safe(capsys, monkeypatch, tmp_path):
    import evsplat.evaluation.run
    import evsplat.training

    def interrupted(run, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(evsplat.training, "train", lambda capture, options, **_: tmp_path)
    monkeypatch.setattr(evsplat.evaluation.run, "evaluate_and_report", interrupted)
    code, _, stderr = _outcome(capsys, "train", str(demo_capture()))
    assert code == 130
    assert f"evsplat evaluate {tmp_path}" in stderr


@pytest.mark.parametrize("verb", ["", *VERBS])
def test_help_fits_a_screen_of_80_by_45(capsys, monkeypatch, verb):
    monkeypatch.setenv("COLUMNS", "80")
    code, stdout, _ = _outcome(capsys, *filter(None, [verb, "--help"]))
    assert code == 0
    usage, *lines = stdout.splitlines()
    assert usage.startswith("usage: evsplat")
    assert len(lines) <= 44
    assert max(map(len, lines)) <= 80


def test_every_option_of_train_and_render_is_explained(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "300")
    for verb in ("train", "render", "demo", "restore", "masks"):
        _, stdout, _ = _outcome(capsys, verb, "--help")
        options = [line.strip("│ ") for line in stdout.splitlines()]
        found = 0
        for line, below in pairwise(options):
            if re.match("--[a-z]", line):
                found += 1
                # The explanation stands behind the option, or below a long one.
                explanation = re.split("  +", line, maxsplit=1)[1:] or [below]
                assert re.match(r"\w.{15}", explanation[0]), line
        assert found >= 3


def test_no_argument_shows_the_help_and_version_the_version(capsys):
    code, stdout, _ = _outcome(capsys)
    assert code == 0
    assert all(verb in stdout for verb in VERBS)
    assert _outcome(capsys, "--version") == (0, f"evsplat {evsplat.__version__}\n", "")


def test_help_as_a_process_loads_no_torch():
    probe = (
        "import sys, runpy; sys.argv = ['evsplat', '--help']\n"
        "try: runpy.run_module('evsplat', run_name='__main__')\n"
        "finally: print('torch' in sys.modules, 'numpy' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "False False"


def test_a_process_ends_without_a_search_for_what_nobody_needs():
    """Half a second of every verb that imports PyTorch."""
    program = (
        "import gc, sys\n"
        "class Found:\n"
        "    def __del__(self): print('found')\n"
        "found = Found()\n"
        "found.itself = found\n"
        "del found\n"
        "gc.disable()\n"
    )
    ended = ["import evsplat.cli", "sys.argv = ['evsplat', '--version']", "evsplat.cli.main()"]

    def printed(*lines):
        code = program + "\n".join(lines)
        run = [sys.executable, "-c", code]
        return subprocess.run(run, capture_output=True, text=True, check=True).stdout

    assert printed() == "found\n"
    assert printed(*ended) == f"evsplat {evsplat.__version__}\n"


@pytest.mark.parametrize("name", sorted(set(evsplat.__all__) - {"__version__"}))
def test_the_verbs_are_functions_of_the_package(name):
    assert callable(getattr(evsplat, name))
    assert name in dir(evsplat)


def test_unknown_attribute_of_the_package_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'trian'"):
        _ = evsplat.trian


def test_ctrl_c_is_answered_with_a_word(capsys, monkeypatch, tmp_path):
    def interrupted(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("evsplat.synthesis.synthesize", interrupted)
    clip = tmp_path / "clip.mp4"
    clip.touch()
    code, _, stderr = _outcome(capsys, "synthesize", str(clip), "--out", str(tmp_path / "out"))
    assert (code, stderr) == (130, "\nevsplat: Stopped.\n")


@pytest.mark.parametrize("reading", ["import_with_kinds", "_gathered"])
def test_ctrl_c_while_the_command_line_is_read_is_answered_too(capsys, monkeypatch, reading):
    def interrupted(*arguments):
        raise KeyboardInterrupt

    # The package has a function of the module's name.
    monkeypatch.setattr(sys.modules["evsplat.cli.main"], reading, interrupted)
    code, _, stderr = _outcome(capsys, "import", "neuman", "there", "--out", "made")
    assert (code, stderr) == (130, "\nevsplat: Stopped.\n")


def test_view_without_its_package_says_how_to_get_it(capsys, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "viser", None)
    (tmp_path / "config.yaml").touch()
    assert main(["view", str(tmp_path)]) == 2
    message = capsys.readouterr().err
    assert "pip install 'evsplat[view]'" in message and message.count("\n") == 1


def test_view_of_a_folder_that_is_no_run_is_one_sentence(capsys, tmp_path):
    assert main(["view", str(tmp_path)]) == 2
    message = capsys.readouterr().err
    assert str(tmp_path) in message and "config.yaml" in message


@pytest.mark.parametrize("address", [["--port", "65536"], ["--host", "no.such.host.invalid"]])
def test_view_of_no_address_is_refused_before_a_run_is_waited_for(capsys, tmp_path, address):
    pytest.importorskip("viser", reason="needs the extra view: pip install 'evsplat[view]'")
    with training_in(tmp_path):  # which has not come to its first step
        assert main(["view", str(tmp_path), *address]) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith(f"evsplat: {' '.join(address)}: ")
    assert "waiting" not in printed.out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("train {demo} --iterations 20 --set iterations=5", "iterations"),
        ("simulate clip.mp4 --out e.h5 --contrast 0.2 --set contrast_on=0.3", "contrast_on"),
    ],
)
def test_an_option_beside_its_setting_is_refused(arguments, said, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "clip.mp4").touch()
    assert main([word.format(demo=demo_capture()) for word in arguments.split()]) == 2
    told = capsys.readouterr().err
    assert f"--set gives {said} as well; leave one out." in told
    assert [path.name for path in tmp_path.iterdir()] == ["clip.mp4"]


def test_import_without_a_kind_says_where_it_stands(tmp_path, capsys):
    (tmp_path / "clip.mp4").touch()
    assert main(["import", str(tmp_path / "clip.mp4"), "--out", str(tmp_path / "new")]) == 2
    said = capsys.readouterr().err
    assert f"evsplat import KIND {tmp_path / 'clip.mp4'}" in said and "video" in said
    assert main(["import", "vidoe", "clip.mp4"]) == 2
    assert "vidoe: no such kind of source; did you mean video?" in capsys.readouterr().err
    assert main(["import"]) == 2
    said = capsys.readouterr().err
    assert "import needs a kind of source, such as " in said and said.count("\n") == 1
