"""What a scenario file gives: one pair drawn from it, and nothing written."""

from dataclasses import replace
from time import perf_counter

import numpy as np

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.synth.actors import Snapshot
from deepaccident_devkit.synth.config import SynthConfig
from deepaccident_devkit.synth.plan import plan_scenarios
from deepaccident_devkit.synth.scenario import Scenario, build_scenario
from deepaccident_devkit.synth.traffic.impact import contact_side
from deepaccident_devkit.taxonomy import FRAME_PERIOD


def checked_text(config: SynthConfig, *, progress: bool = False) -> str:
    """What happens in the first pair of a release of a scenario file, as text of some lines.

    Args:
        config: the settings of the release; `spec` is the file.
        progress: whether to show the number of draws if they take long.

    Raises:
        ConfigError: there is no file, it is no possible scenario, or its accident or twin cannot be made.
    """
    if config.spec is None:
        raise ConfigError("spec: nothing to check; give a scenario file")
    began = perf_counter()
    plans = plan_scenarios(replace(config, scenarios=2, sensors="none"))
    made = [build_scenario(config, plan, progress=progress) for plan in plans if plan.pair == 0]
    lines = [f"{config.spec}: can be simulated; one draw of it, with seed {config.seed}:"]
    for scenario in made:
        lines += [f"  {_outcome(scenario)}", f"    {_extent(scenario)}"]
    return "\n".join([*lines, f"checked in {perf_counter() - began:.1f} s; nothing is written"])


def _outcome(scenario: Scenario) -> str:
    """Who collides with whom, when, how fast and with which sides."""
    collision, meet = scenario.meta.collision, scenario.spec.meet
    if collision is None or meet is None:
        return "normal: nobody collides"
    time = _duration(scenario)
    now = scenario.actors.at(time)
    rows = [scenario.actors.row_of(actor) for actor in collision.ids]
    speeds = np.hypot(*now.velocities[rows].T)
    both = [
        f"{role} ({scenario.actors.all[pair[0]].category}, {speed:.1f} m/s, {_side(scenario, pair, now)})"
        for role, speed, pair in zip(meet.actors, speeds, (rows, rows[::-1]), strict=True)
    ]
    return f"accident: {' and '.join(both)} collide at {time:.1f} s; found in draw {scenario.draws}"


def _side(scenario: Scenario, pair: list[int], now: Snapshot) -> str:
    """The side of the first of a pair that is hit."""
    side = contact_side(now.poses[pair], scenario.actors.size[pair, :2])
    return f"{side} side" if side in ("left", "right") else side


def _extent(scenario: Scenario) -> str:
    """How long it is and how many take part."""
    parked = sum(actor.parked for actor in scenario.actors.all)
    moving = len(scenario.actors) - parked
    frames = f"{scenario.frames} frames ({_duration(scenario):.1f} s)"
    return f"{frames}, {moving} road users that move, {parked} parked; {scenario.weather}, {scenario.time_of_day}"


def _duration(scenario: Scenario) -> float:
    """Seconds from the first to the last frame."""
    return (scenario.frames - 1) * FRAME_PERIOD
