"""Statistics of colliding pairs at the last recorded frame, by the merged tracks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from deepaccident_devkit.arrays import IntArray
from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.statistics.results import UNKNOWN, CollisionPair, Histogram, LeftOut
from deepaccident_devkit.statistics.scenarios import scenario_ends
from deepaccident_devkit.statistics.selected import Selected, group_of
from deepaccident_devkit.statistics.tally import LEFT_OUT, PARTS, Tally
from deepaccident_devkit.taxonomy import AGENTS, CATEGORIES

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import ScenarioRecord

_BIN = 30
_ANGLE_EDGES = tuple(range(-_BIN // 2, 360, _BIN))
"""Twelve bins around 0°, 30°, …, 330°."""


def count_collisions(selected: Selected, tally: Tally) -> None:
    """Add the pairs of the scenarios with a collision to a new tally; those that lack one of their tracks are left out.

    Meta may name one actor twice: that is no pair.
    """
    ends, agents, tracks = scenario_ends(selected), _agents_of_actors(selected), _tracks_at_the_end(selected)
    for row, scenario in selected.scenarios.items():
        if scenario["collision"] is None:
            continue
        names = agents.get(scenario["token"], {})
        ids = _in_agents_order(scenario["collision"]["ids"], names)
        here = tracks.get(row - selected.first, {})
        if len(set(ids)) == len(ids) and set(ids) <= set(here):
            end = ends[scenario["token"]] or UNKNOWN
            tally.pairs[row] = _pair(selected, scenario, end, [here[actor] for actor in ids], list(map(names.get, ids)))
        else:
            tally.counts["collision_pairs", LEFT_OUT, group_of(scenario)] += 1
    pairs = tally.pairs.values()
    groups = np.array([PARTS.index(pair.split) for pair in pairs], dtype=np.int8)
    bearings = [_wrapped(np.degrees(np.arctan2(pair.y, pair.x))) for pair in pairs]
    tally.count_bins("collision_angles", np.array([pair.angle for pair in pairs]), groups, _ANGLE_EDGES)
    tally.count_bins("collision_bearings", np.array(bearings), groups, _ANGLE_EDGES)


def collision_pairs(tally: Tally) -> tuple[CollisionPair, ...]:
    """The pairs, in the order of the scenario table."""
    return tuple(tally.pairs[row] for row in sorted(tally.pairs))


def collision_histograms(tally: Tally) -> list[Histogram]:
    """The pairs' angles between headings, and the bearings of the other as the first of the pair sees it."""
    what = "collisions without a pair labelled at the last frame"
    left_out = LeftOut(what=what, counts=tally.by_group("collision_pairs", LEFT_OUT))
    names = (
        ("collision_angles", "Collision angle", "angle"),
        ("collision_bearings", "Bearing of the other", "bearing"),
    )
    made = []
    for name, title, field in names:
        counts, outside = tally.by_bin(name, _ANGLE_EDGES)
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
    return made


def _agents_of_actors(selected: Selected) -> dict[str, dict[int | None, str]]:
    """Scenario token → actor id → name of its agent."""
    agents: dict[str, dict[int | None, str]] = {}
    for agent in selected.agents:
        agents.setdefault(agent["scenario_token"], {})[agent["actor_id"]] = agent["name"]
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


def _in_agents_order(ids: Sequence[int], names: Mapping[int | None, str]) -> list[int]:
    """A pair's actor ids, agents first and in the order of `AGENTS`, else as they are."""
    ranks: dict[str | None, int] = {name: rank for rank, name in enumerate(AGENTS)}
    return sorted(ids, key=lambda actor: ranks.get(names.get(actor), len(AGENTS)))
