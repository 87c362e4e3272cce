from pathlib import Path

import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.baselines import demo_table
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.synth import SynthConfig, make_release


def assert_five_agents_win(da: DeepAccident, *, map_gain: float) -> None:
    (single, five), text = demo_table(da)
    assert (single.agents, five.agents) == ("single", "all")
    assert five.iou > single.iou + map_gain
    assert five.vpq > single.vpq + map_gain
    assert five.apa > single.apa + 0.1
    assert five.warning >= single.warning + 0.5
    assert single.warning < 1.25  # the house at the corner hides the other until then
    heading, alone, together = text.splitlines()
    columns = "IoU (%) VPQ (%) APA (boxes) warning (s) precision false alarm (% of 4 s)"
    assert " ".join(heading.split()) == columns  # seconds of warning never stand without what they cost
    assert alone.startswith("single vehicle ")
    assert 0 < five.precision <= 1
    assert 0 <= five.false_time < 1
    assert together.split()[-3:] == [f"{five.warning:.1f}", f"{five.precision:.2f}", f"{100 * five.false_time:.0f}"]


@pytest.mark.slow
def test_five_agents_win_where_a_house_hides_the_other(da_hidden: DeepAccident) -> None:
    assert_five_agents_win(da_hidden, map_gain=10)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3])
def test_five_agents_win_on_other_seeds(tmp_path: Path, seed: int) -> None:
    """On maps the less, the more of the traffic is parked, or on the ego vehicle's own road."""
    config = SynthConfig(scenarios=1, frames=30, sensors=False, view="hidden", seed=seed)
    root = make_release(tmp_path / "hidden", config, workers=1)
    assert_five_agents_win(DeepAccident("v1", root, verbose=False), map_gain=3)


def test_a_scenario_without_an_accident_is_refused(da_motion: DeepAccident) -> None:
    normal = next(each for each in da_motion.scenario if not each["collision"])
    with pytest.raises(
        NotAvailableError, match=f"{normal['token']}: no label shows a colliding pair; choose a scenario with an"
    ):
        demo_table(da_motion, normal)
