"""The twelve designs are the paper's: each design's accident has the type of its number
(docs/format.md, Accident types).
"""

import re
from pathlib import Path

import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.roads import Hump, RoadSpec
from deepaccident_devkit.plugins.synth.spec import (
    DESIGN_NUMBERS,
    ActorSpec,
    BackgroundSpec,
    MeetSpec,
    ScenarioSpec,
    draw,
    parse_spec,
    read_design,
)
from deepaccident_devkit.plugins.synth.spec.model import key_of
from deepaccident_devkit.plugins.synth.spec.reading import field_types


@pytest.mark.parametrize("number", DESIGN_NUMBERS)
def test_exactly_one_of_the_two_who_meet_breaks_rules(number):
    spec = draw(read_design(number), np.random.default_rng(0))
    assert set(spec.meet.actors) == {"ego", "other"}

    ignored_rules = [spec.actor(role).ignores for role in spec.meet.actors]
    lawful, unlawful = sorted(ignored_rules, key=len)
    assert lawful == ()
    assert unlawful
    assert ("signal" in unlawful) == (number in (1, 2, 6))


def test_both_parts_fall_to_ego_and_all_weathers_come():
    template = read_design(3)
    specs = [draw(template, np.random.default_rng(seed)) for seed in range(100)]

    assert {spec.actor("ego").turn for spec in specs} == {"left", "straight"}
    assert len({spec.weather for spec in specs}) == 7
    assert len({spec.time_of_day for spec in specs}) == 3
    assert 0.1 < np.mean([spec.road.hump is not None for spec in specs]) < 0.4


PAGE = (Path(__file__).parents[5] / "docs" / "synth.md").read_text(encoding="utf-8")
PARTS = {
    "": ScenarioSpec,
    "road": RoadSpec,
    "road.hump": Hump,
    "actors[]": ActorSpec,
    "meet": MeetSpec,
    "background": BackgroundSpec,
}


def test_the_page_has_every_field_with_its_values():
    table = PAGE.partition("## All fields")[2]
    rows = dict(re.findall(r"^\| `(\S+)` \| (.*)", table, re.MULTILINE))
    types = {}
    for path, kind in PARTS.items():
        prefix = f"{path}." if path else ""
        for name, field_type in field_types(kind).items():
            types[f"{prefix}{key_of(name)}"] = field_type
    assert list(rows) == list(types)

    for row, field_type in zip(rows.values(), types.values(), strict=True):
        words = field_type.words or (field_type.items.words if field_type.items else ())
        values, _, _ = row.partition(" | ")
        assert values.endswith((", ".join(words), "; or null"))
        assert str(field_type.bounds or "") in row


def test_the_page_links_a_table_of_every_design():
    assert "(format.md#accident-types)" in PAGE
    page = (Path(__file__).parents[5] / "docs" / "format.md").read_text(encoding="utf-8")
    table = page.partition("## Accident types\n")[2].partition("\n## ")[0]
    roads = {}
    for with_lights, without_lights, kind in re.findall(
        r"^\| (\d+), (\d+) \| (\w+-way)", table, re.MULTILINE
    ):
        roads[int(with_lights)] = (kind, True)
        roads[int(without_lights)] = (kind, False)
    expected = {}
    for number in DESIGN_NUMBERS:
        road = draw(read_design(number), np.random.default_rng(0)).road
        expected[number] = (road.kind, road.signalized)
    assert roads == expected


def test_the_page_s_examples_can_be_read_and_its_code_runs(tmp_path, monkeypatch, capsys):
    first, *examples = re.findall(r"^```yaml\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    assert [parse_spec(example).meets for example in examples] == [True, True]

    monkeypatch.chdir(tmp_path)
    Path("mine.yaml").write_text(first, encoding="utf-8")
    _, code = re.findall(r"^```python\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    names = {"draw": draw}
    exec(compile(code, "synth.md", "exec"), names)  # noqa: S102
    assert 8 <= names["scenario"].actor("ego").max_speed <= 12
    assert capsys.readouterr().out.startswith(("SoftRain", "HardRain"))
