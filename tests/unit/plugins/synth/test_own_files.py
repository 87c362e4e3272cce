"""Scenario files, those in docs/synth.md among them, have the effects that they describe."""

import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.plugins.synth import SynthConfig, make_release

PAGE = (Path(__file__).parents[4] / "docs" / "synth.md").read_text(encoding="utf-8")
EXAMPLES = dict(
    re.findall(r"^```yaml\n# (\w+)\.yaml.*?\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
)
# ego turns right across the path of a cyclist in the next lane
EXAMPLES["right_hook"] = """
road: {signalized: false, lanes: 2}
actors:
  - {role: ego, from: west, lane: 1, turn: right, max_speed: [8, 10]}
  - {role: other, from: east, max_speed: [7, 10]}
  - {role: background, category: cyclist, from: west, lane: 0, max_speed: [3, 6]}
meet: {actors: [ego, background]}
"""
# a normal scenario, in which nobody is timed to meet
EXAMPLES["quiet"] = """
road: {kind: three-way, signalized: false}
actors:
  - {role: ego, from: south, turn: left}
  - {role: other, from: east}
background: {vehicles: 4, two_wheelers: 2}
weather: Cloudy
"""


@pytest.fixture
def make_example(tmp_path):
    """A function that makes a release from an example: an accident and its twin, two frames without
    sensors.
    """

    def make(name: str) -> DeepAccident:
        path = tmp_path / f"{name}.yaml"
        path.write_text(EXAMPLES[name], encoding="utf-8")
        config = SynthConfig(spec=path, scenarios=2, frames=2, sensors=False)
        root = make_release(tmp_path / name, config, workers=1)

        return DeepAccident("v1", root, workers=1, verbose=False)

    return make


@pytest.mark.slow
def test_the_accident_is_rendered_without_sensors(make_example, tmp_path, monkeypatch):
    """The page's section 'Look at it'."""
    monkeypatch.chdir(tmp_path)
    line = "deepaccident render accident OUT --layers boxes --out countdown.png"
    assert f"    {line}\n" in PAGE

    root = str(make_example("mine").dataroot)
    arguments = [root if word == "OUT" else word for word in line.split()[1:]]
    CliRunner().invoke(deepaccident, arguments)
    assert (tmp_path / "countdown.png").is_file()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "classes", "side"),
    [("pedestrian", ["car", "pedestrian"], "front"), ("right_hook", ["car", "cyclist"], "right")],
)
def test_ego_hits_one_on_foot_or_turns_into_the_cyclist_beside_it(
    make_example, name, classes, side
):
    da = make_example(name)
    (accident,) = da.find(collision=True)
    assert accident["collision"]["classes"] == classes
    assert da.collision(accident).sides[0] == side


@pytest.mark.slow
def test_ego_runs_into_the_rear_of_the_one_who_changed_lanes(make_example):
    """The first of meet.actors has the later row of the two, which once made every draw fail."""
    da = make_example("rear_end")
    (accident,) = da.find(collision=True)
    collision = da.collision(accident)
    assert collision.sides == ("rear", "front")
    assert collision.speeds[0] < collision.speeds[1]
    assert np.rad2deg(collision.impact_angle) < 20

    # the vehicle behind the other one stayed in the right lane
    ego = da.get_sample(accident, "ego_vehicle", 2)
    behind = da.get_sample(accident, "other_vehicle_behind", 2)
    ego_from_behind = da.transform(ego, behind)
    assert ego_from_behind.translation[1] == pytest.approx(-3.5, abs=0.3)
    assert 10 * ego_from_behind.yaw == pytest.approx(0, abs=0.3)


@pytest.mark.slow
def test_nothing_happens_where_nobody_is_to_meet(make_example):
    scenarios = list(make_example("quiet").scenario)
    assert len(scenarios) == 2
    for scenario in scenarios:
        assert scenario["accident_type"] is None
        assert scenario["collision"] is None
