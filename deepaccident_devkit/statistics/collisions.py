"""Statistics of colliding pairs at the last recorded frame, by the merged tracks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from deepaccident_devkit.arrays import IntArray
from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.statistics.results import GROUPS, TOTAL, UNKNOWN, CollisionPair, Histogram, LeftOut
from deepaccident_devkit.statistics.scenarios import scenario_ends
from deepaccident_devkit.statistics.selected import Selected, binned, group_of
from deepaccident_devkit.taxonomy import AGENTS, CATEGORIES

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import ScenarioRecord

_BIN = 30
_ANGLE_EDGES = tuple(range(-_BIN // 2, 360, _BIN))
"""Twelve bins around 0°, 30°, …, 330°."""


def collision_pairs(selected: Selected) -> tuple[tuple[CollisionPair, ...], LeftOut]:
    """The pairs of the selected scenarios with a collision, and how many of these lack one of the pair's tracks.

    Meta may name one actor twice: that is no pair.
    """
    ends, agents, tracks = scenario_ends(selected), _agents_of_actors(selected), _tracks_at_the_end(selected)
    pairs, left_out = [], Counter[str]()
    for row, scenario in zip(selected.rows, selected.scenarios, strict=True):
        if scenario["collision"] is None:
            continue
        names = agents.get(row, {})
        ids = _in_agents_order(scenario["collision"]["ids"], names)
        here = tracks.get(row, {})
        if len(set(ids)) == len(ids) and set(ids) <= set(here):
            end = ends[scenario["token"]] or UNKNOWN
            pairs.append(_pair(selected, scenario, end, [here[actor] for actor in ids], list(map(names.get, ids))))
        else:
            left_out.update((TOTAL, group_of(scenario)))
    counts = {group: left_out[group] for group in GROUPS}
    return tuple(pairs), LeftOut(what="collisions without a pair labelled at the last frame", counts=counts)


def collision_histograms(pairs: Sequence[CollisionPair], left_out: LeftOut) -> tuple[Histogram, Histogram]:
    """The pairs' angles between headings, and the bearings of the other as the first of the pair sees it."""
    groups = np.array([GROUPS.index(pair.split) - 1 for pair in pairs], dtype=np.int8)
    values = {
        ("collision_angles", "Collision angle", "angle"): [pair.angle for pair in pairs],
        ("collision_bearings", "Bearing of the other", "bearing"): [
            _wrapped(np.degrees(np.arctan2(pair.y, pair.x))) for pair in pairs
        ],
    }
    made = []
    for (name, title, field), angles in values.items():
        counts, outside = binned(np.array(angles, dtype=np.float64), groups, _ANGLE_EDGES)
        made.append(
            Histogram(
                name=name,
                title=title,
                field=field,
                unit="°",
                counted="collisions",
                edges=_ANGLE_EDGES,
                counts=counts,
                outside=outside,
                left_out=left_out,
            )
        )
    return made[0], made[1]


def _agents_of_actors(selected: Selected) -> dict[int, dict[int, str]]:
    """Scenario row → actor id → name of its agent."""
    scenario_rows = selected.column("agent", "scenario_row").tolist()
    actors = selected.column("agent", "actor_id").tolist()
    names = selected.column("agent", "name").tolist()
    agents: dict[int, dict[int, str]] = {}
    for row, actor, name in zip(scenario_rows, actors, names, strict=True):
        agents.setdefault(row, {})[actor] = AGENTS[name]
    return agents


def _tracks_at_the_end(selected: Selected) -> dict[int, dict[int, int]]:
    """Scenario row → actor id → track row of the colliders at the scenario's last frame."""
    is_last = np.zeros(len(selected.column("frame", "index")), dtype=bool)
    is_last[selected.column("scenario", "last_frame_row")] = True
    ends = is_last[selected.column("track", "frame_row")] & selected.column("track", "is_collider")[:]
    rows: IntArray = np.flatnonzero(ends)
    actors = selected.column("instance", "actor_id")[selected.column("track", "instance_row")[rows]]
    scenarios = selected.column("track", "scenario_row")[rows]
    tracks: dict[int, dict[int, int]] = {}
    for scenario, actor, row in zip(scenarios.tolist(), actors.tolist(), rows.tolist(), strict=True):
        tracks.setdefault(scenario, {})[actor] = row
    return tracks


def _pair(
    selected: Selected, scenario: ScenarioRecord, end: str, tracks: Sequence[int], names: Sequence[str | None]
) -> CollisionPair:
    """The pair of two track rows, the first of which looks at the other."""
    first, other = quaternions.yaw_of(selected.column("track", "rotation")[list(tracks)]).tolist()
    centers = selected.column("track", "translation")
    x, y, _ = centers[tracks[1]] - centers[tracks[0]]
    cosine, sine = np.cos(first), np.sin(first)
    categories = [CATEGORIES[selected.column("track", "category").item(row)] for row in tracks]
    return CollisionPair(
        scenario=scenario["token"],
        split=group_of(scenario),
        end=end,
        actor=names[0],
        category=categories[0],
        other=names[1],
        other_category=categories[1],
        angle=_wrapped(np.degrees(other - first)),
        x=float(cosine * x + sine * y),
        y=float(cosine * y - sine * x),
    )


def _wrapped(degrees: float) -> float:
    """The angle in [−15, 345)."""
    return float((degrees + _BIN / 2) % 360 - _BIN / 2)


def _in_agents_order(ids: Sequence[int], names: Mapping[int, str]) -> list[int]:
    """A pair's actor ids, agents first and in the order of `AGENTS`, else as they are."""
    ranks: dict[str | None, int] = {name: rank for rank, name in enumerate(AGENTS)}
    return sorted(ids, key=lambda actor: ranks.get(names.get(actor), len(AGENTS)))
