import dataclasses
import importlib.util
import re
from pathlib import Path

import pytest

from deepaccident_devkit.synth.roads import Hump, RoadSpec
from deepaccident_devkit.synth.spec import (
    ActorSpec,
    BackgroundSpec,
    EndSpec,
    MeetSpec,
    ScenarioSpec,
    designs_text,
    draw,
    field_tables,
    parse_spec,
    read_spec,
)

DOCS = Path(__file__).parents[4] / "docs"
PARTS = {
    "": ScenarioSpec,
    "road": RoadSpec,
    "road.hump": Hump,
    "actors[]": ActorSpec,
    "meet": MeetSpec,
    "background": BackgroundSpec,
    "end": EndSpec,
}


def test_every_field_has_a_line_with_values_and_meaning():
    tables = field_tables()
    assert list(tables) == list(PARTS)
    for path, kind in PARTS.items():
        keys = [entry.key.replace("from", "from_arm") for entry in tables[path]]
        assert keys == [field.name for field in dataclasses.fields(kind)]
        assert all(len(entry.meaning) > 8 and entry.values for entry in tables[path])


def test_a_line_of_each_kind():
    lines = {(path, entry.key): entry for path, entries in field_tables().items() for entry in entries}
    assert (lines["actors[]", "role"].default, lines["actors[]", "lane"].values) == ("required", "whole number, 0 to 1")
    assert lines["actors[]", "max_speed"].values == "number, 0.5 to 20 m/s; or null"
    assert lines["", "weather"].values == "Clear, Cloudy, HardRain, MidRain, SoftRain, Wet, WetCloudy"
    assert (lines["", "road"].values, lines["", "road"].default) == ("keys and values", "its defaults")
    assert (lines["meet", "actors"].default, lines["road", "signalized"].default) == ("[ego, other]", "true")


def test_the_designs_are_listed():
    lines = designs_text().splitlines()
    assert len(lines) == 13
    assert re.fullmatch(r" +3  unprotected left turn +four-way, signalised", lines[3])
    assert lines[12].endswith("three-way, unsignalised")


def test_the_page_is_what_the_fields_make():
    spec = importlib.util.spec_from_file_location("make_scenarios_page", DOCS / "make_scenarios_page.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.PAGE.read_text(encoding="utf-8") == module.page(), "run: python docs/make_scenarios_page.py"


def test_the_page_s_examples_can_be_read_and_its_code_runs(tmp_path, monkeypatch, capsys):
    page = (DOCS / "scenarios.md").read_text(encoding="utf-8")
    first, *further, design = re.findall(r"^```yaml\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    assert parse_spec(design).design == 3
    assert [parse_spec(example).meets for example in further] == [True, True, False]
    monkeypatch.chdir(tmp_path)
    Path("mine.yaml").write_text(first, encoding="utf-8")
    (code,) = re.findall(r"^```python\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    names = {"draw": draw}
    exec(compile(code, "scenarios.md", "exec"), names)  # noqa: S102
    assert 8 <= names["scenario"].actor("ego").max_speed <= 12
    assert capsys.readouterr().out.startswith(("SoftRain", "HardRain"))


def test_the_page_s_message_is_the_one_given(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    page = (DOCS / "scenarios.md").read_text(encoding="utf-8")
    example = re.findall(r"^```yaml\n(.*?)^```", page, re.DOTALL | re.MULTILINE)[0]
    Path("mine.yaml").write_text(example.replace("turn: left", "turn: lef"), encoding="utf-8")
    with pytest.raises(ValueError, match=r"mine.yaml:4: actors\[1\]") as caught:
        read_spec("mine.yaml")
    assert f"    {caught.value}\n" in page
