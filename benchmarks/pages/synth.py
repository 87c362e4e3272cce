"""What the generator makes: pairs of each design, what agents see of them, and a release like the
real scenario.

The measured values are kept in synth.json; `main` measures again, the real scenario only where it
is given.
"""

import json
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from statistics import median
from typing import TypedDict

import numpy as np

from benchmarks.pages import synth_beside
from benchmarks.pages.marks import put
from deepaccident_devkit.plugins.synth import SynthConfig
from deepaccident_devkit.plugins.synth.plan import plan_scenarios
from deepaccident_devkit.plugins.synth.scenario import Scenario, build_scenario
from deepaccident_devkit.plugins.synth.sensors.rig import make_rig
from deepaccident_devkit.plugins.synth.spec import DESIGN_NUMBERS, read_design
from deepaccident_devkit.plugins.synth.traffic.simulate import gap, separation
from deepaccident_devkit.release import Labels
from deepaccident_devkit.tables import visible_mask
from deepaccident_devkit.tables.build import accident_type
from deepaccident_devkit.taxonomy import AGENTS, INFRASTRUCTURE, VEHICLE_AGENTS, frame_timestamp
from deepaccident_devkit.v2x import accident_visible_mask, pair_in_view

MEASURED = Path(__file__).with_suffix(".json")
SEEDS = 20
"""Pairs of each design."""
STEP, EVALUATED, OBSERVED = 5, 4, 3
"""Frames between two observations; number of evaluated moments before the last frame; observations
for each of them.
"""
RELEASED_SCENARIOS, RELEASED_FRAMES = 691, 57_000
"""Numbers of its authors (paper, abstract: 57K frames)."""
WORKERS = 2


class Pair(TypedDict):
    """The measured values of an accident and its normal twin.

    `views` has for each agent one letter for each of 2, 1.5, 1 and 0.5 s before the impact: `v`, it
    sees the accident by the released rule; `c`, it does not, but the five together see the pair;
    `u`, the five do not see it either. `sees_both` is for 1 s before the impact. `twin_gap` is the
    least distance between any two of the four vehicle agents, metres.
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


class Measured(TypedDict):
    """All measured values: of a real scenario, of similar generated ones, and of pairs of all
    designs.
    """

    real: synth_beside.Numbers
    generated: synth_beside.Numbers
    pairs: list[Pair]


_WATCHING = (VEHICLE_AGENTS[1], VEHICLE_AGENTS[3], INFRASTRUCTURE)


def config(pairs: int) -> SynthConfig:
    """The release that is measured: only designed accidents, with all their frames."""
    return SynthConfig(
        scenarios=2 * pairs, frames=None, unplanned=0.0, sensors=False, designed=True
    )


def measure(number: int, *, views: bool = True) -> Pair:
    """Make a pair, and measure it; without `views` the results do not say what agents see."""
    whole = config(number + 1)
    accident, twin = (build_scenario(whole, plan) for plan in plan_scenarios(whole)[-2:])
    assert accident.meta.collision is not None
    rows = [accident.actors.row_of(actor) for actor in accident.meta.collision.ids]
    end = accident.actors.at(frame_timestamp(accident.frames))
    turn = float(np.subtract(*end.poses[rows, 2]))
    labels = _labels(accident, whole.seed) if views else {}
    twin_gap, twin_touches = _nearest(twin)
    return Pair(
        design=accident.plan.design or 0,
        type=accident_type(accident.meta, signalized=accident.plan.traits.subtype == 1),
        draws=accident.draws,
        angle=round(abs(np.degrees(np.angle(np.exp(1j * turn)))), 1),
        speeds=sorted(np.hypot(*end.velocities[rows].T).round(1).tolist()),
        frames=accident.frames,
        twin_frames=twin.frames,
        twin_gap=round(twin_gap, 2),
        twin_touches=twin_touches,
        sees_both={
            agent: _in_view(accident, [of_agent[-2]], [agent], agent)
            for agent, of_agent in labels.items()
        },
        views={agent: _letters(accident, labels, agent) for agent in labels},
    )


def _nearest(scenario: Scenario) -> tuple[float, bool]:
    """How near two of the vehicle agents come to each other, metres, and whether any two road users
    ever touch.
    """
    actors, size = scenario.actors, scenario.actors.size[:, :2]
    poses = np.stack(
        [actors.at(frame_timestamp(frame)).poses for frame in range(1, scenario.frames + 1)]
    )
    first, second = np.triu_indices(len(size), 1)
    touching = (separation(poses[:, first], size[first], poses[:, second], size[second]) <= 0).any()
    agents = np.array([actors.row_of(actor) for actor in scenario.agents.values()])
    first, second = (agents[rows] for rows in np.triu_indices(len(agents), 1))
    return float(gap(poses[:, first], size[first], poses[:, second], size[second]).min()), bool(
        touching
    )


def _labels(scenario: Scenario, seed: int) -> dict[str, list[Labels]]:
    """Every agent's labels at the observed moments, the last one `STEP` frames before the
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
    labels: dict[str, list[Labels]] = {agent: [] for agent in AGENTS}
    for back in range(EVALUATED + OBSERVED - 1, 0, -1):
        frame = scenario.frames - STEP * back
        scene = rig.scene(frame_timestamp(frame))
        for agent in rig.agents:
            labels[agent.name].append(rig.sighting(scene, agent, frame).labels)
    return labels


def _in_view(scenario: Scenario, labels: Sequence[Labels], agents: Sequence[str], own: str) -> bool:
    """Whether some agents together have the pair in view; the agent `own` itself does not count."""
    assert scenario.meta.collision is not None
    seen = [
        visible_mask(
            each.center[:, :2],
            each.category,
            each.num_lidar_pts,
            each.camera_visible,
            infrastructure=agent == INFRASTRUCTURE,
        )
        for agent, each in zip(agents, labels, strict=True)
    ]
    ids = np.concatenate([each.actor_id for each in labels])
    own_id = next((actor for agent, actor in scenario.agents.items() if agent == own), None)
    return pair_in_view(np.concatenate(seen), ids, scenario.meta.collision.ids, own_id)


def _letters(scenario: Scenario, labels: dict[str, list[Labels]], agent: str) -> str:
    alone = [_in_view(scenario, [each], [agent], agent) for each in labels[agent]]
    letters = ""
    for moment in range(OBSERVED - 1, len(alone)):
        if accident_visible_mask(alone[moment - OBSERVED + 1 : moment + 1]):
            letters += "v"
        else:
            together = _in_view(scenario, [labels[each][moment] for each in AGENTS], AGENTS, agent)
            letters += "c" if together else "u"
    return letters


def designs_table(pairs: Sequence[Pair]) -> str:
    """One row for each design."""
    head = "| design | collide at the first draw | draws | type in meta is the design | angle (°) "
    head += (
        "| slower, faster (m/s) | frames | follower of ego, of other, "
        "infrastructure: each sees both "
    )
    head += "| twins without contact | least gap of agents in twins (m) |"
    lines = [head, "|---" * (head.count("|") - 1) + "|"]
    for design in DESIGN_NUMBERS:
        of_design = [pair for pair in pairs if pair["design"] == design]
        speeds = np.median([pair["speeds"] for pair in of_design], axis=0)
        cells = (
            f"{design} {read_design(design).name}",
            _share(pair["draws"] == 1 for pair in of_design),
            sum(pair["draws"] for pair in of_design),
            _share(pair["type"] == pair["design"] for pair in of_design),
            _range([pair["angle"] for pair in of_design]),
            f"{speeds[0]:.1f}, {speeds[1]:.1f}",
            _range([pair["frames"] for pair in of_design]),
            ", ".join(
                _share(pair["sees_both"][agent] for pair in of_design) for agent in _WATCHING
            ),
            _share(not pair["twin_touches"] for pair in of_design),
            f"{min(pair['twin_gap'] for pair in of_design):.1f}",
        )
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


def views_table(pairs: Sequence[Pair]) -> str:
    """One row for each agent, and one for all."""
    head = "| samples of | evaluated | accident-invisible | of these, the five together see it |"
    lines = [head, "|---" * 4 + "|"]
    for name, agents in {**{f"`{agent}`": (agent,) for agent in AGENTS}, "all": AGENTS}.items():
        letters = "".join(pair["views"][agent] for pair in pairs for agent in agents)
        unseen, together = len(letters) - letters.count("v"), letters.count("c")
        shares = (
            f"{100 * unseen / len(letters):.1f} %",
            f"{100 * together / unseen:.1f} %" if unseen else "–",
        )
        lines.append(f"| {name} | {len(letters):,} | {shares[0]} | {shares[1]} |")
    return "\n".join(lines)


def lengths_table(pairs: Sequence[Pair]) -> str:
    """Numbers of frames of scenarios, in the release and here."""
    accidents, twins = [pair["frames"] for pair in pairs], [pair["twin_frames"] for pair in pairs]
    rows = {
        "the release": (
            RELEASED_SCENARIOS,
            f"{RELEASED_FRAMES / RELEASED_SCENARIOS:.0f}",
            "40–100",
        ),
        "here": (2 * len(pairs), f"{np.mean(accidents + twins):.0f}", _ends(accidents + twins)),
        "here, accidents": (len(pairs), f"{np.mean(accidents):.0f}", _ends(accidents)),
        "here, normal twins": (len(pairs), f"{np.mean(twins):.0f}", _ends(twins)),
    }
    lines = ["| | scenarios | frames of a scenario, mean | least–most |", "|---" * 4 + "|"]
    return "\n".join(
        lines + [f"| {name} | {' | '.join(map(str, cells))} |" for name, cells in rows.items()]
    )


def tables(measured: Measured) -> dict[str, str]:
    """The tables between the page's markers."""
    pairs = measured["pairs"]
    return {
        "designs": designs_table(pairs),
        "views": views_table(pairs),
        "lengths": lengths_table(pairs),
        "beside": synth_beside.table(measured["real"], measured["generated"]),
    }


def measured() -> Measured:
    """The values of the last measurement."""
    content: Measured = json.loads(MEASURED.read_text(encoding="utf-8"))
    return content


def save(content: Measured) -> None:
    """Save the measured values, one pair on each line."""
    beside = [f'"{key}": {json.dumps(content[key], indent=1)}' for key in ("real", "generated")]
    pairs = ",\n".join(json.dumps(pair) for pair in content["pairs"])
    MEASURED.write_text(
        "{\n" + ",\n".join([*beside, f'"pairs": [\n{pairs}\n]']) + "\n}\n", encoding="utf-8"
    )


def _share(holds: Iterable[bool]) -> str:
    return f"{100 * np.mean([float(each) for each in holds]):.0f} %"


def _range(values: Sequence[float]) -> str:
    return f"{median(values):.0f} ({_ends(values)})"


def _ends(values: Sequence[float]) -> str:
    return f"{min(values):.0f}–{max(values):.0f}"


def main(release: Path | None = None) -> None:
    """Measure, and write the tables."""
    content = measured()
    if release is not None:
        content["real"] = synth_beside.measure_real(release)
    content["generated"] = synth_beside.measure_generated()
    with ProcessPoolExecutor(WORKERS) as executor:
        content["pairs"] = list(
            executor.map(measure, range(SEEDS * len(DESIGN_NUMBERS)), chunksize=4)
        )
    save(content)
    for name, text in tables(content).items():
        put(name, f"\n{text}\n")
