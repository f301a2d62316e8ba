"""Configuration: round trips and errors that help."""

import time
from dataclasses import dataclass, field, replace
from typing import Literal

import pytest

from evsplat.config import from_dict, load_yaml, override, save_yaml, to_dict
from evsplat.errors import ConfigError
from evsplat.methods import PaperConfig, method_config
from evsplat.methods.evsplat import EvsplatConfig


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
        ({"inner": {"limit": 1.5}}, "inner.limit is 1.5; expected an integer"),
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
    config = method_config("evsplat", {"deform": {"width": 16}}, where="test")
    assert config.deform == replace(EvsplatConfig().deform, width=16)


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
