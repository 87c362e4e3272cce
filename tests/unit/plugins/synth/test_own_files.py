"""The scenario files that docs/synth.md has: what happens is what the page says."""

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


@pytest.fixture
def made(tmp_path):
    """A function: name of an example → a release of an accident and its twin by it, two frames
    without sensors.
    """

    def make(name: str) -> DeepAccident:
        path = tmp_path / f"{name}.yaml"
        path.write_text(EXAMPLES[name], encoding="utf-8")
        config = SynthConfig(spec=path, scenarios=2, frames=2, sensors=False)
        return DeepAccident(
            "v1", make_release(tmp_path / name, config, workers=1), workers=1, verbose=False
        )

    return make


@pytest.mark.slow
def test_the_accident_is_rendered_without_sensors(made, tmp_path, monkeypatch):
    """The page's section 'Look at it'."""
    monkeypatch.chdir(tmp_path)
    line = "deepaccident render accident OUT --layers boxes --out countdown.png"
    assert f"    {line}\n" in PAGE
    root = str(made("mine").dataroot)
    CliRunner().invoke(deepaccident, [root if word == "OUT" else word for word in line.split()[1:]])
    assert (tmp_path / "countdown.png").is_file()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "classes", "side"),
    [("pedestrian", ["car", "pedestrian"], "front"), ("right_hook", ["car", "cyclist"], "right")],
)
def test_ego_hits_one_on_foot_or_turns_into_the_cyclist_beside_it(made, name, classes, side):
    da = made(name)
    (accident,) = da.find(collision=True)
    assert (accident["collision"]["classes"], da.collision(accident).sides[0]) == (classes, side)


@pytest.mark.slow
def test_ego_runs_into_the_rear_of_the_one_who_changed_lanes(made):
    """The first of meet.actors has the later row of the two, which once kept any draw from
    counting.
    """
    da = made("rear_end")
    (accident,) = da.find(collision=True)
    collision = da.collision(accident)
    assert (collision.sides, collision.speeds[0] < collision.speeds[1]) == (("rear", "front"), True)
    assert np.rad2deg(collision.impact_angle) < 20
    ego, behind = (
        da.get_sample(accident, agent, 2) for agent in ("ego_vehicle", "other_vehicle_behind")
    )
    ego_from_behind = da.transform(ego, behind)
    # who is behind it stayed in the right lane
    assert (ego_from_behind.translation[1], 10 * ego_from_behind.yaw) == pytest.approx(
        (-3.5, 0), abs=0.3
    )


@pytest.mark.slow
def test_nothing_happens_where_nobody_is_to_meet(made):
    da = made("quiet")
    assert [(each["accident_type"], each["collision"]) for each in da.scenario] == [
        (None, None)
    ] * 2
