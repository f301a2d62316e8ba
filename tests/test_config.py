"""Configuration: round trips and errors that help."""

import math
import re
import time
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar, Literal

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from evsplat.config import check, check_read, from_dict, load_yaml, override, settings, to_dict
from evsplat.config_docs import save_yaml
from evsplat.errors import ConfigError
from evsplat.methods import TRAINABLE, method_config
from evsplat.methods.avatar3dgs import AvatarConfig
from evsplat.methods.paper import PaperConfig
from evsplat.ranges import Above, AtLeast, AtMost, ReadIf, Within


@dataclass(frozen=True)
class Inner:
    rate: float = 0.1
    kind: Literal["a", "b"] = "a"
    pairs: float | tuple[tuple[float, float], ...] = 1.0
    limit: int | None = None


@dataclass(frozen=True)
class Outer:
    inner: Inner = field(default_factory=Inner)
    flag: bool = False


@dataclass(frozen=True)
class Owner:
    outer: Outer = field(default_factory=lambda: Outer(Inner(rate=0.5), flag=True))


Pairs = tuple[tuple[Annotated[int, AtLeast(0)], float], ...]


@dataclass(frozen=True)
class Ranged:
    opacity: Annotated[float, Within(0, 1)] = 0.5
    rate: Annotated[float, Above(0)] = 0.1
    count: Annotated[int, AtLeast(1)] = 3
    low_pass: Annotated[float, Above(0), AtMost(0.3)] = 0.3
    limit: Annotated[float, Above(0)] | None = None
    weight: Annotated[float, AtLeast(0)] | Pairs = 1.0
    all_of_them: Annotated[float | tuple[float, ...], AtLeast(0)] = 1.0


@dataclass(frozen=True)
class Lamps:
    lights: Annotated[int, AtLeast(0)] = 0
    width: Annotated[float, Above(0), ReadIf("lights", "above 0", lambda n: n > 0)] = 0.1
    colour: Annotated[
        str,
        ReadIf("lights", "above 0", lambda n: n > 0),
        ReadIf("deform.shading", "true", bool),
    ] = "white"
    shading: Annotated[float, ReadIf("shading", "above 0", lambda s: s > 0)] = 0.5
    blur: Annotated[float, ReadIf("width", "above 1", lambda w: w > 1)] = 0.0


@dataclass(frozen=True)
class Deform:
    shading: bool = False
    lamps: Lamps = field(default_factory=Lamps)


@dataclass(frozen=True)
class Method:
    DROPPED: ClassVar[dict[str, str]] = {
        "deform.encoding": "gone: the hash grid earned nothing (docs/method.md)",
        "edi": "gone: sharpened frames earned nothing",
        "pose_begin": "renamed to pose_start",
    }

    pose_start: float = 0.0
    shading: float = 0.0
    deform: Deform = field(default_factory=lambda: Deform(lamps=Lamps(width=0.2)))
    extra: Annotated[Lamps | None, ReadIf("deform.shading", "true", bool)] = None
    part: Annotated[Lamps, ReadIf("pose_start", "above 0", lambda s: s > 0)] = field(
        default_factory=lambda: Lamps(lights=2)
    )


def test_every_value_survives_yaml(tmp_path):
    config = Outer(Inner(rate=3e-5, kind="b", pairs=((0.0, 10.0), (1000.0, 0.1)), limit=7), True)
    save_yaml(tmp_path / "c.yaml", config)
    assert from_dict(Outer, load_yaml(tmp_path / "c.yaml"), where="c") == config


def test_defaults_of_the_paper_method_survive_yaml(tmp_path):
    save_yaml(tmp_path / "c.yaml", PaperConfig())
    assert from_dict(PaperConfig, load_yaml(tmp_path / "c.yaml"), where="c") == PaperConfig()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"inner": {"rat": 1}}, "f.yaml: unknown setting inner.rat. Did you mean inner.rate?"),
        ({"flagg": True}, "f.yaml: unknown setting flagg. Did you mean flag?"),
        ({"inner": {"kind": "c"}}, "inner.kind is 'c'; expected one of a, b"),
        ({"inner": {"rate": "fast"}}, "inner.rate is 'fast'; expected a number"),
        ({"inner": {"limit": 1.5}}, "inner.limit is 1.5; expected an integer or null."),
        ({"inner": {"pairs": "x"}}, "inner.pairs is 'x'; expected a number or a list of [a number"),
        ({"inner": {"pairs": [[1, "x"]]}}, "inner.pairs is 'x'; expected a number."),
        ({"inner": {"pairs": [[1]]}}, "inner.pairs is [1]; expected 2 values."),
        ({"inner": {"rate": math.inf}}, "inner.rate is inf; expected a finite number."),
        ({"inner": {"rate": "1e999"}}, "inner.rate is '1e999'; expected a number."),
        ({"inner": {"rate": True}}, "inner.rate is True; expected a number."),
        ({"inner": 3}, "inner is 3; expected a section with keys"),
        ({"flag": 1}, "flag is 1; expected true or false"),
    ],
)
def test_wrong_values_are_named_with_what_was_expected(values, message):
    with pytest.raises(ConfigError) as error:
        from_dict(Outer, values, where="f.yaml")
    assert message in str(error.value)


def test_overrides_reach_nested_values_and_read_scientific_notation():
    values = override(to_dict(Outer()), ["inner.rate=1e-3", "flag=true", "inner.limit=null"])
    assert from_dict(Outer, values, where="--set") == Outer(Inner(rate=1e-3), True)


@pytest.mark.parametrize("text", ["inner.rate", "=3", "inner.rate.x=1", "flag=[1"])
def test_malformed_overrides_are_refused(text):
    with pytest.raises(ConfigError, match="--set"):
        override(to_dict(Outer()), [text])


def test_a_key_that_is_set_twice_is_refused():
    with pytest.raises(ConfigError, match=r"--set flag=true: flag is given twice; leave one out\."):
        override(to_dict(Outer()), ["flag=false", "inner.rate=1", "flag=true"])


@pytest.mark.parametrize("section", ["inner={rate: 2.0}", "inner={}", "inner=null"])
@pytest.mark.parametrize("turned", [False, True])
def test_a_section_and_a_key_of_it_are_not_both_set(section, turned):
    first, last = ("inner.rate=1", section) if turned else (section, "inner.rate=1")
    message = f"--set {last}: --set {first}, which is given before it, says some of the same"
    with pytest.raises(ConfigError, match=re.escape(message)):
        override(to_dict(Outer()), ["flag=true", first, last])
    # a name that only begins alike is another's
    assert override({}, ["a=1", "ab.c=2", "a_b=3"]) == {"a": 1, "ab": {"c": 2}, "a_b": 3}


def test_unknown_method_names_the_nearest():
    with pytest.raises(ConfigError, match="Did you mean paper"):
        method_config("papr", {}, where="x")


def test_damaged_yaml_is_named(tmp_path):
    path = tmp_path / "broken.yaml"
    path.write_text("a: [1,")
    with pytest.raises(ConfigError, match="broken.yaml: not valid YAML"):
        load_yaml(path)
    path.write_text("- 1\n- 2\n")
    with pytest.raises(ConfigError, match="expected a mapping"):
        load_yaml(path)


def test_a_section_given_in_part_keeps_what_its_owner_set():
    found = from_dict(Owner, {"outer": {"inner": {"kind": "b"}}}, where="test")
    assert found == Owner(Outer(Inner(rate=0.5, kind="b"), flag=True))


def test_a_method_keeps_its_parts_when_one_setting_of_them_changes():
    config = method_config("avatar3dgs", {"networks": {"width": 16}}, where="test")
    assert config.networks == replace(AvatarConfig().networks, width=16)
    assert config.networks.pose_start == 5_000  # which its type alone would not give


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[" * 5_000, "nested more than 50 deep"),
        ("{" * 5_000, "nested more than 50 deep"),
        ("- " * 5_000, "nested more than 50 deep"),
        ("a:\n" + "".join(" " * i + "- \n" for i in range(1_000)), "nested more than 50 deep"),
        ("a: 2001-99-99", "month must be in 1..12"),
        ("a: " + "1" * 5_000, "value has 5000 digits)"),
        ("a: !!bool 3", "a tag that its value does not fit"),
        ("a: !!timestamp x", "a tag that its value does not fit"),
        ('a: !!int ""', "a tag that its value does not fit"),
    ],
)
def test_yaml_without_a_value_is_refused_quickly(tmp_path, text, said):
    path = tmp_path / "a.yaml"
    path.write_text(text)
    start = time.process_time()
    with pytest.raises(ConfigError, match="a.yaml: not valid YAML") as error:
        load_yaml(path)
    assert said in str(error.value)
    with pytest.raises(ConfigError, match="is not a YAML value"):
        override({}, [f"a={text}"])
    # PyYAML alone takes many times as long for the first
    assert time.process_time() - start < 3


def test_settings_may_be_nested_as_deep_as_anyone_needs(tmp_path):
    (tmp_path / "a.yaml").write_text("a: " + "[" * 40 + "]" * 40)
    assert "a" in load_yaml(tmp_path / "a.yaml")


def test_a_configuration_that_is_no_text_is_named(tmp_path):
    with pytest.raises(ConfigError, match="a folder, expected a file"):
        load_yaml(tmp_path)
    with pytest.raises(ConfigError, match="no.yaml: file not found"):
        load_yaml(tmp_path / "no.yaml")
    (tmp_path / "a.yaml").write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match="not a text in UTF-8"):
        load_yaml(tmp_path / "a.yaml")


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("opacity", 1.5, "a number within 0 and 1"),
        ("opacity", math.nan, "a finite number within 0 and 1"),
        ("rate", 0.0, "a number above 0"),
        ("count", 0, "an integer of at least 1"),
        ("low_pass", 0.4, "a number above 0 and of at most 0.3"),
        ("limit", -1.0, "a number above 0 or null"),
        ("limit", math.inf, "a finite number above 0 or null"),
        (
            "weight",
            -1.0,
            "a number of at least 0 or a list of [an integer of at least 0, a number]",
        ),
        ("all_of_them", -1.0, "a number of at least 0 or a list of numbers of at least 0"),
    ],
)
def test_values_out_of_range_are_refused_however_they_come(name, value, told):
    told = f"here: {name} is {value!r}; expected {told}."
    with pytest.raises(ConfigError) as error:
        from_dict(Ranged, {name: value}, where="here")
    assert str(error.value) == told
    with pytest.raises(ConfigError) as error:
        check(Ranged(**{name: value}), "here")
    assert str(error.value) == told


@pytest.mark.parametrize("name, value", [("weight", ((-1, 0.0),)), ("all_of_them", (1.0, -1.0))])
def test_numbers_in_lists_have_ranges_too(name, value):
    for attempt in (
        lambda: from_dict(Ranged, {name: value}, where="here"),
        lambda: check(Ranged(**{name: value}), "here"),
    ):
        with pytest.raises(ConfigError, match=f"here: {name} is -1(.0)?; expected .* of at least"):
            attempt()


def test_a_configuration_of_wrong_types_made_in_python_is_refused():
    with pytest.raises(ConfigError, match="rate is '0.1'; expected a number above 0"):
        check(Ranged(rate="0.1"), "here")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="deform.lamps.lights is -1; expected"):
        check(Method(deform=Deform(lamps=Lamps(lights=-1))), "here")


NUMBERS = st.one_of(st.floats(), st.sampled_from([0, 1, -0.0, 5e-324, 1 + 2**-52, 0.3, 10**400]))


@given(NUMBERS)
@example(math.nextafter(1, 2))
@example(math.nextafter(0, -1))
def test_ranges_end_where_they_say(value):
    finite = not isinstance(value, float) or math.isfinite(value)
    for name, fits in (
        ("opacity", 0 <= value <= 1),
        ("rate", value > 0),
        ("low_pass", 0 < value <= 0.3),
        ("limit", value > 0),
        ("weight", value >= 0),
    ):
        try:
            config = from_dict(Ranged, {name: value}, where="here")
        except ConfigError:
            assert not (fits and finite) or abs(value) > 1e308
        else:
            assert fits and finite and getattr(config, name) == value
            check(config, "here")


@given(
    st.builds(
        Ranged,
        opacity=st.floats(0, 1),
        rate=st.floats(0, exclude_min=True, allow_infinity=False),
        count=st.integers(1, 2**53),
        low_pass=st.floats(0, 0.3, exclude_min=True),
        limit=st.none() | st.floats(1e-300, 1e300),
        weight=st.floats(0, 1e300)
        | st.lists(st.tuples(st.integers(0, 2**53), st.floats(-1e300, 1e300))).map(tuple),
    )
)
def test_any_configuration_in_range_survives_yaml(tmp_path_factory, config):
    path = tmp_path_factory.mktemp("yaml") / "c.yaml"
    check(config, "here")
    save_yaml(path, config)
    assert from_dict(Ranged, load_yaml(path), where="here") == config


@pytest.mark.parametrize(
    ("values", "told"),
    [
        (
            {"deform": {"lamps": {"width": 0.3}}},
            "deform.lamps.width is 0.3, but nothing reads it unless deform.lamps.lights is above "
            "0; leave it out or set deform.lamps.lights.",
        ),
        (
            {"deform": {"lamps": {"colour": "red", "lights": 1}}},
            "deform.lamps.colour is 'red', but nothing reads it unless deform.shading is true; "
            "leave it out or set deform.shading.",
        ),
        (  # by a setting of the same name at the root
            {"deform": {"lamps": {"shading": 0.1}}},
            "deform.lamps.shading is 0.1, but nothing reads it unless shading is above 0; leave it "
            "out or set shading.",
        ),
        (  # read only with a setting that is not read itself
            {"deform": {"lamps": {"blur": 1.0}}},
            "deform.lamps.blur is 1.0, but nothing reads it unless deform.lamps.width is above 1; "
            "leave it out or set deform.lamps.width.",
        ),
        (  # all at once
            {"deform": {"lamps": {"colour": "red", "width": 0.3}}, "extra": {}},
            "deform.lamps.width is 0.3 and deform.lamps.colour is 'red', but nothing reads them "
            "unless deform.lamps.lights is above 0; leave them out or set deform.lamps.lights. "
            "extra is given, but nothing reads it unless deform.shading is true; leave it out or "
            "set deform.shading.",
        ),
        (
            {"extra": {}},
            "extra is given, but nothing reads it unless deform.shading is true; leave it out or "
            "set deform.shading.",
        ),
        (
            {"part": {"lights": 3}},
            "part.lights is 3, but nothing reads it unless pose_start is above 0; leave it out or "
            "set pose_start.",
        ),
    ],
)
def test_a_setting_that_nothing_would_read_is_refused(values, told):
    with pytest.raises(ConfigError) as error:
        from_dict(Method, values, where="here")
    assert str(error.value) == f"here: {told}"


def test_settings_are_taken_where_they_are_read():
    values: dict[str, Any] = {
        "pose_start": 1.0,
        "deform": {"shading": True, "lamps": {"lights": 1, "width": 2.0, "blur": 0.5}},
        "extra": {"lights": 1},
        "part": {"lights": 3},
    }
    check_read(from_dict(Method, values, where="here"), "here")
    values["deform"]["lamps"] = {"width": 0.2}  # the section's default, though not the type's
    assert from_dict(Method, values, where="here").deform.lamps.width == 0.2


def test_a_setting_is_unread_where_what_it_depends_on_is():
    values = {"deform": {"lamps": {"width": 2.0, "blur": 0.5}}}
    with pytest.raises(ConfigError, match="nothing reads them unless deform.lamps.lights is"):
        from_dict(Method, values, where="here")


def test_a_whole_configuration_with_unread_settings_loads_again(tmp_path):
    save_yaml(tmp_path / "c.yaml", Method())
    assert from_dict(Method, load_yaml(tmp_path / "c.yaml"), where="c") == Method()


@pytest.mark.parametrize(
    ("values", "told"),
    [
        (
            {"deform": {"encoding": "hashgrid"}},
            "deform.encoding: gone: the hash grid earned nothing (docs/method.md).",
        ),
        ({"edi": {"weight": 0.1}}, "edi: gone: sharpened frames earned nothing."),
        ({"pose_begin": 3}, "pose_begin: renamed to pose_start."),
        (
            {"deform": {"encoding": "x", "lamps": {"light": 1}}, "pose_begin": 3, "?": 0},
            "deform.encoding: gone: the hash grid earned nothing (docs/method.md); unknown setting "
            "deform.lamps.light (did you mean deform.lamps.lights?); pose_begin: renamed to "
            "pose_start; unknown setting ?.",
        ),
        (
            {"extra": {"light": 1}},
            "unknown setting extra.light. Did you mean extra.lights?",
        ),
    ],
)
def test_settings_that_are_gone_say_what_became_of_them(values, told):
    with pytest.raises(ConfigError) as error:
        from_dict(Method, values, where="old.yaml")
    assert str(error.value) == f"old.yaml: {told}"


@pytest.mark.parametrize("count", [5, 6, 9])
def test_five_unknown_settings_are_named(count):
    with pytest.raises(ConfigError) as error:
        from_dict(Outer, {f"#{number}": 0 for number in range(count)}, where="here")
    names = "; ".join(f"unknown setting #{number}" for number in range(5))
    assert str(error.value) == f"here: {names}{f'; and {count - 5} more' if count > 5 else ''}."


@pytest.mark.parametrize("method", TRAINABLE)
def test_defaults_of_every_method_are_in_range_and_survive_yaml(method, tmp_path):
    kind = TRAINABLE[method].config
    check(kind(), method)
    check_read(kind(), method)
    save_yaml(tmp_path / "c.yaml", kind())
    assert method_config(method, load_yaml(tmp_path / "c.yaml"), where="c") == kind()


@pytest.mark.parametrize("method", TRAINABLE)
def test_conditions_name_settings_that_there_are(method):
    every = {setting.name: setting for setting in settings(TRAINABLE[method].config())}
    for setting in every.values():
        for name, condition in setting.conditions:
            assert condition.holds(every[name].value) in (True, False), (setting.name, name)
        asked, waiting = set(), [setting.name]
        while waiting:
            new = {name for name, _ in every[waiting.pop()].conditions} - asked
            asked |= new
            waiting += new
        assert setting.name not in asked
