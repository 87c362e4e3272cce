"""The twelve designs are the paper's: the accident that each means is of its type (docs/format.md,
Accident types).
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
def test_one_of_the_two_who_meet_breaks_a_rule(number):
    spec = draw(read_design(number), np.random.default_rng(0))
    lawful, broken = sorted((spec.actor(role).ignores for role in spec.meet.actors), key=len)
    assert (set(spec.meet.actors), lawful, bool(broken)) == ({"ego", "other"}, (), True)
    assert ("signal" in broken) == (number in (1, 2, 6))


def test_both_parts_fall_to_ego_and_all_weathers_come():
    made = [draw(read_design(3), np.random.default_rng(seed)) for seed in range(100)]
    assert {spec.actor("ego").turn for spec in made} == {"left", "straight"}
    assert (len({spec.weather for spec in made}), len({spec.time_of_day for spec in made})) == (
        7,
        3,
    )
    assert 0.1 < np.mean([spec.road.hump is not None for spec in made]) < 0.4


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
    _, *sections = PAGE.partition("## All fields")[2].split("\n### ")
    for section, (path, kind) in zip(sections, PARTS.items(), strict=True):
        assert section.startswith(f"`{path}`\n" if path else "The file\n")
        rows = dict(re.findall(r"^\| `(\w+)` \| (.*)", section, re.MULTILINE))
        types = field_types(kind)
        assert list(rows) == [key_of(name) for name in types]
        for row, wanted in zip(rows.values(), types.values(), strict=True):
            words = wanted.words or (wanted.items.words if wanted.items else ())
            assert row.partition(" | ")[0].endswith((", ".join(words), "; or null"))
            assert str(wanted.bounds or "") in row


def test_the_page_has_every_design():
    assert re.findall(r"^\| (\d+) (.*?) \| ", PAGE, re.MULTILINE) == [
        (str(number), read_design(number).name) for number in DESIGN_NUMBERS
    ]


def test_the_page_s_examples_can_be_read_and_its_code_runs(tmp_path, monkeypatch, capsys):
    first, *further = re.findall(r"^```yaml\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    assert [parse_spec(example).meets for example in further] == [True, True, True, False]
    monkeypatch.chdir(tmp_path)
    Path("mine.yaml").write_text(first, encoding="utf-8")
    _, code = re.findall(r"^```python\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    names = {"draw": draw}
    exec(compile(code, "synth.md", "exec"), names)  # noqa: S102
    assert 8 <= names["scenario"].actor("ego").max_speed <= 12
    assert capsys.readouterr().out.startswith(("SoftRain", "HardRain"))
