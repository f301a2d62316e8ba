"""Options of the verbs: checked where they are made, named as on the command line."""

import subprocess
import sys
from dataclasses import dataclass, fields
from typing import Annotated, Literal

import numpy as np
import pytest
import tyro

from evsplat import options
from evsplat.errors import ConfigError
from evsplat.options.declare import FLAT, Flag, check_options, given, option
from evsplat.ranges import AtLeast

CLASSES = [kind for name, kind in vars(options).items() if name[0].isupper()]


@dataclass(frozen=True)
class Lamp:
    """A lamp."""

    watts: Annotated[float, AtLeast(1), option("W")] = 40.0
    """Power."""
    count: Annotated[int | None, AtLeast(1), option("N", default="as many as fit")] = None
    """Number of bulbs."""
    colour: Literal["warm", "cold"] = "warm"
    """Colour."""
    turn_deg: Annotated[float, option("DEG", name="turn", alias="--yaw")] = 0.0
    """Turn."""
    dimmed: Flag = False
    """Dim it."""
    hours: Annotated[tuple[int, ...], AtLeast(0), option("H")] = ()
    """When it is lit."""

    def __post_init__(self) -> None:
        check_options(self)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"watts": 0.5}, "--watts 0.5: expected a number of at least 1."),
        ({"watts": float("nan")}, "--watts nan"),
        ({"count": 0}, "--count 0: expected an integer of at least 1."),
        ({"colour": "blue"}, "--colour blue: expected one of warm, cold."),
        ({"turn_deg": float("inf")}, "--turn inf"),
        ({"hours": (3, -1)}, "--hours 3 -1: expected a list of integers of at least 0."),
        ({"watts": "40"}, "--watts '40': expected a number of at least 1."),
        ({"watts": None}, "--watts None: expected a number of at least 1."),
        ({"watts": True}, "--watts True: expected a number"),
        ({"count": 2.5}, "--count 2.5: expected an integer of at least 1."),
        ({"count": 2.0}, "--count 2.0: expected an integer of at least 1."),
        ({"count": "2"}, "--count '2': expected an integer of at least 1."),
        ({"colour": None}, "--colour None: expected one of warm, cold."),
        ({"dimmed": "no"}, "--dimmed 'no': expected true or false."),
        ({"hours": 3}, "--hours 3: expected a list of integers of at least 0."),
        ({"hours": (3, 4.5)}, "--hours 3 4.5: expected a list of integers of at least 0."),
        ({"wats": 3}, "wats: no such option; did you mean watts?"),
    ],
)
@pytest.mark.parametrize("start", [None, Lamp(watts=60)])
def test_bad_values_are_one_sentence_with_the_options_name(changes, message, start):
    with pytest.raises(ConfigError) as raised:
        given(Lamp, start, changes)
    assert message in str(raised.value) and "\n" not in str(raised.value)


@pytest.mark.parametrize(
    "changes",
    [
        {"watts": 60},
        {"watts": np.float32(60)},
        {"count": np.int64(2)},
        {"count": None},
        {"hours": [3, 4]},
        {"dimmed": np.bool_(True)},
    ],
)
def test_numbers_of_numpy_and_lists_are_taken(changes):
    assert vars(given(Lamp, None, changes)).items() >= changes.items()


@pytest.mark.parametrize(
    ("given_both", "said"),
    [
        (
            {"iterations": 20, "overrides": ("width=8", "iterations=5")},
            "--iterations 20: --set gives iterations as well; leave one out.",
        ),
        (
            {"use": "everything", "overrides": ("policy.use=training",)},
            "--use everything: --set gives policy.use as well; leave one out.",
        ),
        (
            {"use": "training", "overrides": ("policy={use: training}",)},
            "--use training: --set gives policy as well; leave one out.",
        ),
    ],
)
def test_an_option_and_the_setting_that_it_stands_for_are_refused_together(given_both, said):
    with pytest.raises(ConfigError) as raised:
        options.TrainOptions(**given_both)
    assert str(raised.value) == said
    options.TrainOptions(iterations=20, overrides=("policy.held_out_events=true", "iteration=3"))


def test_changes_are_made_to_what_is_given_or_to_the_defaults():
    assert given(Lamp, None, {"count": 3}) == Lamp(count=3)
    assert given(Lamp, Lamp(watts=60), {"count": 3}) == Lamp(watts=60, count=3)


def test_a_verb_gets_them_as_one_value_under_their_names(capsys):
    def verb(*, lamp: Annotated[Lamp, FLAT]) -> Lamp:
        return lamp

    words = "--watts 60 --yaw 3 --dimmed --colour cold".split()
    assert tyro.cli(verb, args=words) == Lamp(60, None, "cold", 3, True)
    assert tyro.cli(verb, args=["--turn", "3"]) == Lamp(turn_deg=3)
    with pytest.raises(SystemExit):
        tyro.cli(verb, args=["--help"])
    text = capsys.readouterr().out
    assert "Power. (default: 40)" in text and "(default: as many as fit)" in text


@pytest.mark.parametrize("kind", CLASSES, ids=lambda kind: kind.__name__)
def test_defaults_are_in_range(kind):
    assert fields(kind()) and kind() == given(kind, None, {})


def test_options_load_no_torch():
    probe = "import sys, evsplat.options; print('torch' in sys.modules, 'numpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True)
    assert done.stdout == "False False\n", done.stderr


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"events": "source", "sensor": "evk4"}, "--sensor: goes with --events simulate"),
        ({"events": "none", "contrast": 0.3}, "--contrast: goes with --events simulate"),
        ({"interpolation": "none", "upsample": 4}, "--upsample: --interpolation none makes no"),
        ({"seed": -1}, "--seed -1: expected an integer of at least 0"),
    ],
)
def test_what_the_making_of_a_capture_would_pass_over_is_refused(changes, said):
    with pytest.raises(ConfigError, match=said):
        options.SynthesisSettings(**changes)
    options.SynthesisSettings(recipe="zju-mocap-blur", events="source")


def test_a_recipe_fills_in_what_is_not_given():
    recipe = options.SynthesisSettings(recipe="mmhpsd-blur", interpolation="flow", subframes=5)
    assert (recipe.interpolation, recipe.duty, recipe.contrast) == ("flow", None, 0.2)
    assert options.SynthesisSettings().duty == 0.75


def test_a_picture_of_one_side_is_square():
    assert options.StageSettings(width=96).size == (96, 96)
    assert options.StageSettings(width=96, height=64).size == (96, 64)
