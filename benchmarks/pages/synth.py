"""Measure what the generator makes: pairs of each design, what agents see of them, and a release
like the real scenario.

The measured values are stored in synth.json; `main` measures again, the real scenario only if it is
given.
"""

import json
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TypedDict

import numpy as np

from benchmarks.pages import synth_beside
from benchmarks.pages.marks import put, table, wrapped
from deepaccident_devkit.plugins.synth import SynthConfig
from deepaccident_devkit.plugins.synth.plan import plan_scenarios
from deepaccident_devkit.plugins.synth.scenario import Scenario, build_scenario
from deepaccident_devkit.plugins.synth.sensors.rig import make_rig
from deepaccident_devkit.plugins.synth.spec import DESIGN_NUMBERS
from deepaccident_devkit.plugins.synth.traffic.simulate import gap, separation
from deepaccident_devkit.release import Labels
from deepaccident_devkit.statistics import FACTS, Fact
from deepaccident_devkit.tables import visible_mask
from deepaccident_devkit.tables.build import accident_type
from deepaccident_devkit.taxonomy import AGENTS, INFRASTRUCTURE, frame_timestamp
from deepaccident_devkit.v2x import accident_visible_mask, pair_in_view

MEASURED = Path(__file__).with_suffix(".json")
SEEDS = 20
"""Number of pairs of each design."""
STEP, EVALUATED, OBSERVED = 5, 4, 3
"""Frames between two observations; number of evaluated moments before the last frame; number of
observations for each of them.
"""
WORKERS = 2
PAGE_FACTS = ("foreseen_all_1 area", "ade mean")
"""Names of the facts that the page shows."""


class Pair(TypedDict):
    """The measured values of an accident and its normal twin.

    `views` has one letter per agent for each of 2, 1.5, 1 and 0.5 s before the impact: `v` if the
    agent sees the accident by the released rule; `c` if it does not, but the five together see the
    pair; `u` if the five do not see it either. `sees_both` is for 1 s before the impact. `twin_gap`
    is the smallest distance between any two of the four vehicle agents, metres.
    """

    design: int
    type: int | None
    draws: int
    angle: float
    speeds: list[float]
    frames: int
    twin_frames: int
    twin_gap: float
    twin_touches: bool
    sees_both: dict[str, bool]
    views: dict[str, str]


class MeasuredFact(TypedDict):
    """The value of one of `statistics.FACTS` in a generated release, its interval, and whether it
    agrees with the real release.
    """

    here: float
    ends: list[float] | None
    verdict: str


class MeasuredFacts(TypedDict):
    """The facts of a generated release, by `fact_name`, and its number of scenarios."""

    scenarios: int
    values: Mapping[str, MeasuredFact]


class Measured(TypedDict):
    """All measured values: of a real scenario, of similar generated ones, of the facts of a
    generated release (`benchmarks.pages.facts` measures them), and of pairs of all designs.
    """

    real: synth_beside.Numbers
    generated: synth_beside.Numbers
    facts: MeasuredFacts
    pairs: list[Pair]


def config(pairs: int) -> SynthConfig:
    """Return the configuration of the measured release: only designed accidents, with all their
    frames.
    """
    return SynthConfig(
        scenarios=2 * pairs, frames=None, unplanned=0.0, sensors=False, designed=True
    )


def measure(number: int, *, views: bool = True) -> Pair:
    """Make and measure a pair; without `views` the result lacks what agents see."""
    release = config(number + 1)
    plans = plan_scenarios(release)[-2:]
    accident, twin = (build_scenario(release, plan) for plan in plans)
    meta = accident.meta
    assert meta.collision is not None
    rows = [accident.actors.row_of(actor) for actor in meta.collision.ids]
    end = accident.actors.at(frame_timestamp(accident.frames))
    turn = float(np.subtract(*end.poses[rows, 2]))
    angle = abs(np.degrees(np.angle(np.exp(1j * turn))))
    speeds = np.hypot(*end.velocities[rows].T)
    labels = _observe(accident, release.seed) if views else {}
    sees_both = {}
    for agent, of_agent in labels.items():
        sees_both[agent] = _in_view(accident, [of_agent[-2]], [agent], agent)
    twin_gap, twin_touches = _nearest(twin)
    return Pair(
        design=accident.plan.design or 0,
        type=accident_type(meta, signalized=accident.plan.traits.subtype == 1),
        draws=accident.draws,
        angle=round(angle, 1),
        speeds=sorted(speeds.round(1).tolist()),
        frames=accident.frames,
        twin_frames=twin.frames,
        twin_gap=round(twin_gap, 2),
        twin_touches=twin_touches,
        sees_both=sees_both,
        views={agent: _letters(accident, labels, agent) for agent in labels},
    )


def _nearest(scenario: Scenario) -> tuple[float, bool]:
    """Return the smallest distance between two of the vehicle agents, metres, and whether any two
    road users ever touch.
    """
    actors = scenario.actors
    size = actors.size[:, :2]
    timestamps = [frame_timestamp(frame) for frame in range(1, scenario.frames + 1)]
    poses = np.stack([actors.at(timestamp).poses for timestamp in timestamps])
    first, second = np.triu_indices(len(size), 1)
    separations = separation(poses[:, first], size[first], poses[:, second], size[second])
    agents = np.array([actors.row_of(actor) for actor in scenario.agents.values()])
    first, second = agents[np.stack(np.triu_indices(len(agents), 1))]
    gaps = gap(poses[:, first], size[first], poses[:, second], size[second])
    return float(gaps.min()), bool((separations <= 0).any())


def _observe(scenario: Scenario, seed: int) -> dict[str, list[Labels]]:
    """Return every agent's labels at the observed moments; the last one is `STEP` frames before the
    impact.
    """
    sky = (scenario.spec.weather, scenario.spec.time_of_day)
    noise = (seed, scenario.plan.pair, int(scenario.plan.accident))
    rig = make_rig(
        scenario.world,
        scenario.actors,
        scenario.agents,
        sky=sky,
        image_size=(480, 270),
        seed=noise,
        images=False,
    )
    labels = {agent: [] for agent in AGENTS}
    for back in range(EVALUATED + OBSERVED - 1, 0, -1):
        frame = scenario.frames - STEP * back
        scene = rig.scene(frame_timestamp(frame))
        for agent in rig.agents:
            labels[agent.name].append(rig.sighting(scene, agent, frame).labels)
    return labels


def _in_view(scenario: Scenario, labels: Sequence[Labels], agents: Sequence[str], own: str) -> bool:
    """Return whether some agents together have the pair in view; the agent `own` itself does not
    count.
    """
    assert scenario.meta.collision is not None
    masks = []
    for agent, of_agent in zip(agents, labels, strict=True):
        mask = visible_mask(
            of_agent.center[:, :2],
            of_agent.category,
            of_agent.num_lidar_pts,
            of_agent.camera_visible,
            infrastructure=agent == INFRASTRUCTURE,
        )
        masks.append(mask)
    is_visible = np.concatenate(masks)
    ids = np.concatenate([of_agent.actor_id for of_agent in labels])
    own_id = scenario.agents.get(own)
    return pair_in_view(is_visible, ids, scenario.meta.collision.ids, own_id)


def _letters(scenario: Scenario, labels: dict[str, list[Labels]], agent: str) -> str:
    """Return the letters of `Pair.views` for an agent."""
    in_own_view = [_in_view(scenario, [observed], [agent], agent) for observed in labels[agent]]
    letters = ""
    for moment in range(OBSERVED - 1, len(in_own_view)):
        if accident_visible_mask(in_own_view[moment - OBSERVED + 1 : moment + 1]):
            letters += "v"
        else:
            of_all = [labels[name][moment] for name in AGENTS]
            letters += "c" if _in_view(scenario, of_all, AGENTS, agent) else "u"
    return letters


def pairs_text(pairs: Sequence[Pair]) -> str:
    """Return how often the agents do not see the accidents of the designs."""
    letters = "".join(pair["views"][agent] for pair in pairs for agent in AGENTS)
    invisible = 100 * (1 - letters.count("v") / len(letters))
    return wrapped(
        "At 2, 1.5, 1 and 0.5 s before the impact, the accident is invisible in "
        f"{invisible:.1f} % of all agents' samples."
    )


def fact_name(fact: Fact) -> str:
    """Return the name of a fact in `MeasuredFacts.values`."""
    return f"{fact.key} {fact.kind}"


def fact_row(fact: Fact, facts: MeasuredFacts) -> tuple[str, ...]:
    """Return the row of a fact: its name, the real value and the generated one."""
    measured_fact = facts["values"][fact_name(fact)]
    ends = None
    if measured_fact["ends"] is not None:
        low, high = measured_fact["ends"]
        ends = (low, high)
    cells = replace(fact, here=measured_fact["here"], ends=ends).texts()
    return (fact.name, cells[2], cells[3])


def comparison_table(content: Measured) -> str:
    """Return a table of the real release and of generated ones, one number in each row."""
    rows = [fact_row(fact, content["facts"]) for fact in FACTS if fact_name(fact) in PAGE_FACTS]
    rows += synth_beside.comparison_rows(content["real"], content["generated"])
    return table(("", "real", "generated"), rows)


def texts(content: Measured) -> dict[str, str]:
    """Return the texts between the page's markers, by marker."""
    return {
        "pairs": pairs_text(content["pairs"]),
        "comparison": comparison_table(content),
    }


def measured() -> Measured:
    """Return the values of the last measurement."""
    content: Measured = json.loads(MEASURED.read_text(encoding="utf-8"))
    return content


def save(content: Measured) -> None:
    """Save the measured values, one pair on each line, and write the page's texts."""
    entries = []
    for key in ("real", "generated", "facts"):
        entries.append(f'"{key}": {json.dumps(content[key], indent=1)}')
    pairs = ",\n".join(map(json.dumps, content["pairs"]))
    entries.append(f'"pairs": [\n{pairs}\n]')
    lines = ",\n".join(entries)
    MEASURED.write_text(f"{{\n{lines}\n}}\n", encoding="utf-8")
    for name, text in texts(content).items():
        put(name, f"\n{text}\n")


def main(release: Path | None = None) -> None:
    """Measure, and write the texts of the page."""
    content = measured()
    if release is not None:
        content["real"] = synth_beside.measure_real(release)
    content["generated"] = synth_beside.measure_generated()
    with ProcessPoolExecutor(WORKERS) as executor:
        numbers = range(SEEDS * len(DESIGN_NUMBERS))
        content["pairs"] = list(executor.map(measure, numbers, chunksize=4))
    save(content)
