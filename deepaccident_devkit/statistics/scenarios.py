"""Statistics of whole scenarios, by meta and the tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from deepaccident_devkit import taxonomy
from deepaccident_devkit.statistics.results import (
    ENDS,
    NO_ACCIDENT,
    NO_DESIGN,
    WITH_OTHER,
    WITH_PEDESTRIAN,
    CountTable,
    Histogram,
    LeftOut,
    QuantileTable,
)
from deepaccident_devkit.statistics.selected import Selected, binned, group_counts, quantile_rows, word_counts

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import AgentRecord, CollisionRecord, ScenarioRecord

_EGO = taxonomy.AGENTS[0]
_LENGTH_EDGES = tuple(range(30, 101, 10))
_SPEED_EDGES = tuple(range(21))


def scenario_counts(selected: Selected) -> list[CountTable]:
    """Scenarios by type, town, weather, time of day, road type, collision and end; frames by weather and time."""
    return [
        _by_field(selected, "scenario_types", "Scenario types", "scenario_type"),
        _by_field(selected, "towns", "Towns", "town", taxonomy.TOWNS),
        _by_field(selected, "weathers", "Weather", "weather", taxonomy.WEATHERS),
        _by_field(selected, "weather_frames", "Weather, by frame", "weather", taxonomy.WEATHERS, frames=True),
        _by_field(selected, "times_of_day", "Time of day", "time_of_day", taxonomy.TIMES_OF_DAY),
        _by_field(
            selected, "time_of_day_frames", "Time of day, by frame", "time_of_day", taxonomy.TIMES_OF_DAY, frames=True
        ),
        _by_field(selected, "road_types", "Road types", "road_type", taxonomy.ROAD_TYPES),
        _collisions(selected),
        _ends(selected),
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
    for agent in selected.dataset.agent:
        agents.setdefault(agent["scenario_token"], []).append(agent)
    return {record["token"]: scenario_end(record, agents.get(record["token"], [])) for record in selected.scenarios}


def lengths(selected: Selected) -> Histogram:
    """Recorded frames of scenarios; meta's simulated ones are ten more."""
    values = np.array([record["num_frames"] for record in selected.scenarios], dtype=np.float64)
    counts, outside = binned(values, selected.scenario_group[list(selected.rows)], _LENGTH_EDGES)
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


def ego_speeds(selected: Selected) -> Histogram:
    """Speeds of `ego_vehicle` at its samples, by the first line of their labels."""
    ego = selected.column("sample", "agent") == taxonomy.AGENTS.index(_EGO)
    speeds = np.linalg.norm(selected.column("sample", "velocity")[ego], axis=1)
    groups, known = selected.group("sample")[ego], np.isfinite(speeds)
    counts, outside = binned(speeds[known], groups[known], _SPEED_EDGES)
    return Histogram(
        name="ego_speeds",
        title="Speed of the ego vehicle",
        field="speed",
        unit="m/s",
        counted="ego samples",
        edges=_SPEED_EDGES,
        counts=counts,
        outside=outside,
        left_out=LeftOut(what="ego samples without a label", counts=group_counts(groups[~known])),
    )


def ego_sizes(selected: Selected) -> QuantileTable:
    """Size of `ego_vehicle`, once a scenario, by its own label row."""
    ego = selected.column("agent", "name") == taxonomy.AGENTS.index(_EGO)
    sizes, groups = selected.column("agent", "size")[ego], selected.group("agent")[ego]
    known = ~np.isnan(sizes).any(axis=1)
    counted = known & (groups >= 0)
    rows = [
        row
        for axis, field in enumerate(("length", "width", "height"))
        for row in quantile_rows(field, _EGO, sizes[counted, axis], groups[counted])
    ]
    return QuantileTable(
        name="ego_sizes",
        title="Size of the ego vehicle",
        unit="m",
        counted="scenarios",
        quantiles=tuple(rows),
        left_out=LeftOut(what="scenarios whose ego has no label row of its own", counts=group_counts(groups[~known])),
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


def _by_field(
    selected: Selected, name: str, title: str, field: str, known: Sequence[str] = (), *, frames: bool = False
) -> CountTable:
    """Scenarios by a field of their records; with `frames`, their frames."""
    counts = word_counts(
        selected.scenarios,
        lambda record: record[field],  # type: ignore[literal-required]
        known,
        (lambda record: record["num_frames"]) if frames else (lambda _: 1),
    )
    counted = "frames" if frames else "scenarios"
    return CountTable(name=name, title=title, field=field, counted=counted, counts=counts)


def _collisions(selected: Selected) -> CountTable:
    def word(scenario: ScenarioRecord) -> str | None:
        if scenario["weather"] is None:  # there is no meta
            return None
        return "yes" if scenario["collision"] else "no"

    counts = word_counts(selected.scenarios, word, ("yes", "no"))
    return CountTable(
        name="collisions", title="Ended in a collision", field="collision", counted="scenarios", counts=counts
    )


def _ends(selected: Selected) -> CountTable:
    ends = scenario_ends(selected)
    counts = word_counts(selected.scenarios, lambda record: ends[record["token"]], ENDS)
    return CountTable(name="ends", title="How scenarios ended", field="end", counted="scenarios", counts=counts)
