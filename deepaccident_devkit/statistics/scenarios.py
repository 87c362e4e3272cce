"""Statistics of whole scenarios, by meta and the tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from deepaccident_devkit import taxonomy
from deepaccident_devkit.statistics.results import (
    ENDS,
    NO_ACCIDENT,
    NO_DESIGN,
    UNKNOWN,
    WITH_OTHER,
    WITH_PEDESTRIAN,
    CountTable,
    Histogram,
    LeftOut,
    QuantileTable,
)
from deepaccident_devkit.statistics.selected import Selected, group_of
from deepaccident_devkit.statistics.tally import LEFT_OUT, Tally

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import AgentRecord, CollisionRecord, ScenarioRecord

_EGO = taxonomy.AGENTS[0]
_LENGTH_EDGES = tuple(range(30, 101, 10))
_SPEED_EDGES = tuple(range(21))
_SIZES: Final = ("length", "width", "height")
_TABLES: Final[Mapping[str, tuple[str, str, tuple[str, ...], str]]] = {
    "scenario_types": ("Scenario types", "scenario_type", (), "scenarios"),
    "towns": ("Towns", "town", taxonomy.TOWNS, "scenarios"),
    "weathers": ("Weather", "weather", taxonomy.WEATHERS, "scenarios"),
    "weather_frames": ("Weather, by frame", "weather", taxonomy.WEATHERS, "frames"),
    "times_of_day": ("Time of day", "time_of_day", taxonomy.TIMES_OF_DAY, "scenarios"),
    "time_of_day_frames": ("Time of day, by frame", "time_of_day", taxonomy.TIMES_OF_DAY, "frames"),
    "road_types": ("Road types", "road_type", taxonomy.ROAD_TYPES, "scenarios"),
    "collisions": ("Ended in a collision", "collision", ("yes", "no"), "scenarios"),
    "ends": ("How scenarios ended", "end", ENDS, "scenarios"),
}
"""Table of counts → title, field, words that are there in any case, what is counted."""


def count_scenarios(selected: Selected, tally: Tally) -> None:
    """Count scenarios, their frames and samples, by the words of their records and by length."""
    ends = scenario_ends(selected)
    for scenario in selected.scenarios.values():
        group = group_of(scenario)
        for table, (_, field, _, counted) in _TABLES.items():
            word = ends[scenario["token"]] if field == "end" else _word(scenario, field)
            number = scenario["num_frames"] if counted == "frames" else 1
            tally.counts[table, word or UNKNOWN, group] += number
    lengths = np.array([scenario["num_frames"] for scenario in selected.scenarios.values()], dtype=np.float64)
    tally.count_bins("lengths", lengths, selected.scenario_group[selected.scenario_group >= 0], _LENGTH_EDGES)
    tally.count("scenarios", selected.scenario_group)
    for table in ("frame", "sample"):
        tally.count(f"{table}s", selected.group(table))


def count_egos(selected: Selected, tally: Tally) -> None:
    """Count the speeds of `ego_vehicle` at its samples, and its size once a scenario, by its own label rows."""
    ego = selected.column("sample", "agent") == taxonomy.AGENTS.index(_EGO)
    speeds = np.linalg.norm(selected.column("sample", "velocity")[ego], axis=1)
    groups, known = selected.group("sample")[ego], np.isfinite(speeds)
    tally.count_bins("ego_speeds", speeds[known], groups[known], _SPEED_EDGES)
    tally.count("ego_speeds", groups[~known], LEFT_OUT)
    ego = selected.column("agent", "name") == taxonomy.AGENTS.index(_EGO)
    sizes, groups = selected.column("agent", "size")[ego], selected.group("agent")[ego]
    known = ~np.isnan(sizes).any(axis=1)
    for axis, field in enumerate(_SIZES):
        tally.add_values("ego_sizes", field, _EGO, sizes[known, axis], groups[known])
    tally.count("ego_sizes", groups[~known], LEFT_OUT)


def scenario_counts(tally: Tally) -> list[CountTable]:
    """Scenarios by type, town, weather, time of day, road type, collision and end; frames by weather and time."""
    return [
        CountTable(name=name, title=title, field=field, counted=counted, counts=tally.by_word(name, known))
        for name, (title, field, known, counted) in _TABLES.items()
    ]


def scenario_end(scenario: ScenarioRecord, agents: Sequence[AgentRecord]) -> str | None:
    """How a scenario ended, one of `ENDS`; None without meta, or where meta is silent on agents or roads.

    Args:
        scenario: the record.
        agents: the records of its agents that are in this release.
    """
    collision = scenario["collision"]
    if scenario["weather"] is None:  # there is no meta
        return None
    if collision is None:
        return NO_ACCIDENT
    if "pedestrian" in collision["classes"]:
        return WITH_PEDESTRIAN
    if scenario["accident_type"] is not None:
        return f"design {scenario['accident_type']}"
    return _undesigned_end(scenario, collision, agents)


def scenario_ends(selected: Selected) -> dict[str, str | None]:
    """Scenario token → how it ended."""
    agents: dict[str, list[AgentRecord]] = {}
    for agent in selected.agents:
        agents.setdefault(agent["scenario_token"], []).append(agent)
    records = selected.scenarios.values()
    return {record["token"]: scenario_end(record, agents.get(record["token"], [])) for record in records}


def lengths(tally: Tally) -> Histogram:
    """Recorded frames of scenarios; meta's simulated ones are ten more."""
    counts, outside = tally.by_bin("lengths", _LENGTH_EDGES)
    return Histogram(
        name="lengths",
        title="Lengths of scenarios",
        field="length",
        unit="frames",
        counted="scenarios",
        edges=_LENGTH_EDGES,
        counts=counts,
        outside=outside,
    )


def ego_speeds(tally: Tally) -> Histogram:
    """Speeds of `ego_vehicle` at its samples, by the first line of their labels."""
    counts, outside = tally.by_bin("ego_speeds", _SPEED_EDGES)
    return Histogram(
        name="ego_speeds",
        title="Speed of the ego vehicle",
        field="speed",
        unit="m/s",
        counted="ego samples",
        edges=_SPEED_EDGES,
        counts=counts,
        outside=outside,
        left_out=LeftOut(what="ego samples without a label", counts=tally.by_group("ego_speeds", LEFT_OUT)),
    )


def ego_sizes(tally: Tally) -> QuantileTable:
    """Size of `ego_vehicle`, once a scenario, by its own label row."""
    what = "scenarios whose ego has no label row of its own"
    return QuantileTable(
        name="ego_sizes",
        title="Size of the ego vehicle",
        unit="m",
        counted="scenarios",
        quantiles=tuple(row for field in _SIZES for row in tally.quantiles("ego_sizes", field, _EGO)),
        left_out=LeftOut(what=what, counts=tally.by_group("ego_sizes", LEFT_OUT)),
    )


def _undesigned_end(scenario: ScenarioRecord, collision: CollisionRecord, agents: Sequence[AgentRecord]) -> str | None:
    """Of a collision that realises no design: whether its pair are agents; None where meta is silent."""
    here = {agent["name"]: agent["actor_id"] for agent in agents if not agent["is_infrastructure"]}
    names = collision["agents"] or (None, None)
    missing = set(taxonomy.VEHICLE_AGENTS) - set(here)  # of a partial download: meta's names stand for their ids
    if None in here.values() or (missing and collision["agents"] is None):
        return None
    known = [actor in here.values() or name in missing for actor, name in zip(collision["ids"], names, strict=True)]
    if not all(known):
        return WITH_OTHER
    story = ("road_type", "spawn_side", "ego_direction", "other_direction")
    return None if None in [scenario[word] for word in story] else NO_DESIGN  # type: ignore[literal-required]


def _word(scenario: ScenarioRecord, field: str) -> str | None:
    """What a scenario counts as in tables of a field of its record."""
    if field != "collision":
        return scenario[field]  # type: ignore[literal-required,no-any-return]
    if scenario["weather"] is None:  # there is no meta
        return None
    return "yes" if scenario["collision"] else "no"
