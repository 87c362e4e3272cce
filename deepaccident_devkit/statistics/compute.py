"""All statistics of a release, or of some of its scenarios, on the tables' columns."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit import taxonomy
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.interactions.scenario import least_times
from deepaccident_devkit.statistics.report import DatasetStatistics
from deepaccident_devkit.statistics.results import (
    CRITICAL,
    ENDS,
    GROUPS,
    PROBABILITIES,
    TOTAL,
    UNKNOWN_SPLIT,
    CollisionPair,
    CountTable,
    Histogram,
    LeftOut,
    QuantileRow,
    QuantileTable,
    scenario_end,
    word_of,
)
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, IntArray
from deepaccident_devkit.tables.tables import rows_of_scenarios
from deepaccident_devkit.taxonomy import AGENTS, CATEGORIES, OWN_ACTOR_ID, STATIC_ACTOR_ID

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine
    from deepaccident_devkit.tables.records import AgentRecord, ScenarioRecord

Chosen = RowArgument | Iterable[RowArgument] | None
"""Tokens or records of scenarios, or a single one; None for all."""
# The groups that the total is made of; a row's code counts in them, −1 for rows that do not count.
_PARTS: Final = GROUPS[1:]
_EGO: Final = AGENTS[0]
_SIZES: Final = ("length", "width", "height")
_BIN: Final = 30
# Twelve bins around 0°, 30°, …, 330°.
_ANGLES: Final = tuple(range(-_BIN // 2, 360, _BIN))
_TTCS: Final = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.5, 10.0)
# Table of counts → title, field, words that are there in any case, what is counted.
_OF_SCENARIOS: Final[Mapping[str, tuple[str, str, Sequence[str], str]]] = {
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


def dataset_statistics(
    dataset: Dataset,
    scenarios: Chosen = None,
    *,
    interactions: bool = False,
    **how: Unpack[Engine],
) -> DatasetStatistics:
    """Compute the paper's statistics on the tables' columns: no record of an annotation is made.

    Everything is counted for all scenarios and for each split. Scenarios without labels count where calib, meta and
    folders are enough; elsewhere a table's `left_out` says how many there are.

    Args:
        dataset: the release.
        scenarios: tokens or records of its scenarios to count alone, such as `find` gives, or a single one; None for
            all.
        interactions: whether to add how soon moving pairs would collide (`da.interactions`); where these are not kept
            yet, a tenth of a second a scenario.
        **how: `workers`, `executor` and `progress` of these, as `parallel.Engine` says.

    Raises:
        TokenError: something is no scenario of the release.
        ChoiceError: `scenarios` is nothing of this, or `workers` is less than 1.
        WorkerError: a worker was killed, or cannot do the work.
    """
    chosen = _Chosen(dataset, sorted(set(rows_of_scenarios(dataset, scenarios))))
    pairs, pair_histograms = _collisions(chosen)
    (distances, distance_quantiles), (speeds, speed_quantiles) = _distances(chosen), _speeds(chosen)
    histograms = [
        _lengths(chosen),
        _ego_speeds(chosen),
        _actors(chosen),
        distances,
        speeds,
        *pair_histograms,
    ]
    if interactions:
        histograms += _interactions(chosen, **how)
    quantiles = (_ego_sizes(chosen), _box_sizes(chosen), distance_quantiles, speed_quantiles)
    return DatasetStatistics(
        dataroot=str(dataset.dataroot),
        version=dataset.version,
        release_scenarios=len(dataset.scenario),
        selected=scenarios is not None,
        scenarios=_by_group(chosen.scenario_group),
        frames=_by_group(chosen.group("frame")),
        samples=_by_group(chosen.group("sample")),
        unlabelled=chosen.unlabelled.counts,
        counts={table.name: table for table in (*_scenario_counts(chosen), *_actor_counts(chosen))},
        histograms={table.name: table for table in histograms},
        quantiles={table.name: table for table in quantiles},
        collisions=pairs,
    )


class _Chosen:
    """The scenarios that count, and the columns of a release with the group that each row counts for."""

    def __init__(self, dataset: Dataset, rows: Sequence[int]) -> None:
        self.dataset = dataset
        self._groups: dict[str, AnyArray] = {}
        self.scenarios: dict[int, ScenarioRecord] = {row: dataset.scenario[row] for row in rows}
        self.agents: dict[str, list[AgentRecord]] = {}
        wanted = {scenario["token"] for scenario in self.scenarios.values()}
        for agent in dataset.agent[:]:
            if agent["scenario_token"] in wanted:
                self.agents.setdefault(agent["scenario_token"], []).append(agent)
        self.scenario_group = np.full(len(dataset.scenario), -1, dtype=np.int8)
        for row, scenario in self.scenarios.items():
            self.scenario_group[row] = _PARTS.index(_split_of(scenario))
        labelled = np.zeros(len(self.scenario_group), dtype=bool)
        labelled[self.column("sample", "scenario_row")[self.column("sample", "labelled")]] = True
        self.labelled_group = np.where(labelled, self.scenario_group, np.int8(-1))
        self.unlabelled = LeftOut(
            what="scenarios without labels",
            counts=_by_group(np.where(labelled, np.int8(-1), self.scenario_group)),
        )
        self.ends = {
            each["token"]: scenario_end(each, self.agents.get(each["token"], []))
            for each in self.scenarios.values()
        }

    def column(self, table: str, name: str) -> Any:
        """A stored column, read-only."""
        return self.dataset.columns(table)[name]

    def group(self, table: str) -> AnyArray:
        """(N,) int8 group code of every row of a table."""
        if table not in self._groups:
            of, name = (
                (self.group("sample"), "sample_row")
                if table == "annotation"
                else (self.scenario_group, "scenario_row")
            )
            self._groups[table] = of[self.column(table, name)]
        return self._groups[table]


def _split_of(scenario: ScenarioRecord) -> str:
    """The group, besides the total, that a scenario counts for."""
    return scenario["split"] or UNKNOWN_SPLIT


def _by_group(groups: AnyArray, weights: Iterable[int] | None = None) -> dict[str, int]:
    """Group → how many rows (N,) have its code, or the sum of their weights."""
    counts = np.zeros(len(_PARTS), dtype=np.int64)
    counted = groups >= 0
    np.add.at(counts, groups[counted], 1 if weights is None else np.asarray(weights)[counted])
    return {TOTAL: int(counts.sum()), **dict(zip(_PARTS, counts.tolist(), strict=True))}


def _by_code(words: Sequence[str], codes: AnyArray, groups: AnyArray) -> dict[str, dict[str, int]]:
    """Word → group → how many rows (N,) have its code."""
    counted = (codes >= 0) & (groups >= 0)
    keys = codes[counted] * np.int16(len(_PARTS)) + groups[counted]
    table = np.bincount(keys, minlength=len(words) * len(_PARTS)).reshape(len(words), len(_PARTS))
    return {
        word: {TOTAL: int(row.sum()), **dict(zip(_PARTS, row.tolist(), strict=True))}
        for word, row in zip(words, table, strict=True)
    }


def _histogram(
    names: tuple[str, str, str, str],
    counted: str,
    values: FloatArray,
    groups: AnyArray,
    edges: Sequence[float],
    left_out: LeftOut | None = None,
) -> Histogram:
    """A histogram; `names` are name, title, field and unit; rows (N,) with −1 do not count, and NaN never does."""
    bounds = np.asarray(edges, dtype=np.float64)
    bins = np.searchsorted(bounds, values, side="right").astype(np.int8)  # 0 below, B + 1 above
    bins[values == bounds[-1]] = len(bounds) - 1
    bins[np.isnan(values)] = -1
    below, *rows, above = _by_code(
        [str(place) for place in range(len(edges) + 1)], bins, groups
    ).values()
    name, title, field, unit = names
    return Histogram(
        name=name,
        title=title,
        field=field,
        unit=unit,
        counted=counted,
        edges=tuple(edges),
        counts={group: tuple(row[group] for row in rows) for group in GROUPS},
        outside={group: below[group] + above[group] for group in GROUPS},
        left_out=left_out,
    )


def _quantile_rows(
    field: str, category: str, values: FloatArray, groups: AnyArray
) -> list[QuantileRow]:
    """The quantiles of values (N,) without NaN in every group."""
    chosen = [values[groups == code] for code in range(len(_PARTS))]
    everything = np.concatenate(chosen)
    return [
        QuantileRow(
            field=field,
            category=category,
            group=group,
            number=len(each),
            values=tuple(np.quantile(each, PROBABILITIES).tolist()) if len(each) else None,
        )
        for group, each in zip(GROUPS, [everything, *chosen], strict=True)
    ]


def _scenario_counts(chosen: _Chosen) -> list[CountTable]:
    """Scenarios by type, town, weather, time of day, road type, collision and end; frames by weather and time."""
    made, records = [], chosen.scenarios.values()
    groups = chosen.scenario_group[list(chosen.scenarios)]
    frames = np.array([scenario["num_frames"] for scenario in records], dtype=np.int64)
    for name, (title, field, known, counted) in _OF_SCENARIOS.items():
        words = [
            (chosen.ends[scenario["token"]] if field == "end" else word_of(scenario, field))
            or UNKNOWN_SPLIT
            for scenario in records
        ]
        others = sorted(set(words) - {*known, UNKNOWN_SPLIT})
        listed = [*known, *others, *({UNKNOWN_SPLIT} & set(words))]
        rows = {word: [row for row, each in enumerate(words) if each == word] for word in listed}
        counts = {
            word: _by_group(groups[here], frames[here] if counted == "frames" else None)
            for word, here in rows.items()
        }
        made.append(CountTable(name=name, title=title, field=field, counted=counted, counts=counts))
    return made


def _actor_counts(chosen: _Chosen) -> list[CountTable]:
    """Instances, parked ones among them, and annotations, by category."""
    category, group = chosen.column("instance", "category"), chosen.group("instance")
    parked = chosen.column("instance", "actor_id") >= STATIC_ACTOR_ID
    tables = (
        ("instances", "Instances", "instances", category, group),
        ("parked_instances", "Parked instances", "instances", category[parked], group[parked]),
        (
            *("annotations", "Annotations", "annotations"),
            *(chosen.column("annotation", "category"), chosen.group("annotation")),
        ),
    )
    return [
        CountTable(
            name=name,
            title=title,
            field="category",
            counted=counted,
            counts=_by_code(CATEGORIES, codes, groups),
            left_out=chosen.unlabelled,
        )
        for name, title, counted, codes, groups in tables
    ]


def _lengths(chosen: _Chosen) -> Histogram:
    """Recorded frames of scenarios; meta's simulated ones are ten more."""
    lengths = np.array(
        [scenario["num_frames"] for scenario in chosen.scenarios.values()], dtype=np.float64
    )
    groups = chosen.scenario_group[list(chosen.scenarios)]
    names = ("lengths", "Lengths of scenarios", "length", "frames")
    return _histogram(names, "scenarios", lengths, groups, range(30, 101, 10))


def _ego_speeds(chosen: _Chosen) -> Histogram:
    """Speeds of `ego_vehicle` at its samples, by the first line of their labels."""
    ego = chosen.column("sample", "agent") == AGENTS.index(_EGO)
    speeds, groups = (
        np.linalg.norm(chosen.column("sample", "velocity")[ego], axis=1),
        chosen.group("sample")[ego],
    )
    without = LeftOut(
        what="ego samples without a label", counts=_by_group(groups[~np.isfinite(speeds)])
    )
    names = ("ego_speeds", "Speed of the ego vehicle", "speed", "m/s")
    return _histogram(names, "ego samples", speeds, groups, tuple(range(21)), without)


def _actors(chosen: _Chosen) -> Histogram:
    """Actors (instances) of each labelled scenario."""
    numbers = np.bincount(
        chosen.column("instance", "scenario_row"), minlength=len(chosen.scenario_group)
    ).astype(float)
    names = ("actors", "Actors a scenario", "actors", "actors")
    return _histogram(
        names, "scenarios", numbers, chosen.labelled_group, range(0, 201, 10), chosen.unlabelled
    )


def _ego_sizes(chosen: _Chosen) -> QuantileTable:
    """Size of `ego_vehicle`, once a scenario, by its own label row."""
    ego = chosen.column("agent", "name") == AGENTS.index(_EGO)
    sizes, groups = chosen.column("agent", "size")[ego], chosen.group("agent")[ego]
    known = ~np.isnan(sizes).any(axis=1)
    rows = [
        row
        for axis, field in enumerate(_SIZES)
        for row in _quantile_rows(field, _EGO, sizes[known, axis], groups[known])
    ]
    return QuantileTable(
        name="ego_sizes",
        title="Size of the ego vehicle",
        unit="m",
        counted="scenarios",
        quantiles=tuple(rows),
        left_out=LeftOut(
            what="scenarios whose ego has no label row of its own", counts=_by_group(groups[~known])
        ),
    )


def _box_sizes(chosen: _Chosen) -> QuantileTable:
    """Length, width and height of all annotations, by category."""
    categories, sizes = chosen.column("annotation", "category"), chosen.column("annotation", "size")
    groups, rows = chosen.group("annotation"), []
    for code, name in enumerate(CATEGORIES):
        here = np.flatnonzero((categories == code) & (groups >= 0))
        for axis, field in enumerate(_SIZES):
            rows += _quantile_rows(field, name, sizes[here, axis], groups[here])
    return QuantileTable(
        name="box_sizes",
        title="Sizes of boxes",
        unit="m",
        counted="annotations",
        quantiles=tuple(rows),
        left_out=chosen.unlabelled,
    )


def _distances(chosen: _Chosen) -> tuple[Histogram, QuantileTable]:
    """Horizontal distances of annotated boxes from the LiDAR of their agent; its own box does not count."""
    x, y = chosen.column("annotation", "translation")[:, :2].T
    of_others = chosen.column("annotation", "actor_id") != OWN_ACTOR_ID
    groups = np.where(of_others, chosen.group("annotation"), np.int8(-1))
    names = ("distances", "Distance from the agent", "distance", "m")
    what = ("annotations of others", tuple(range(0, 101, 5)), chosen.unlabelled)
    return _distribution(
        names, what, np.hypot(x, y), chosen.column("annotation", "category"), groups
    )


def _speeds(chosen: _Chosen) -> tuple[Histogram, QuantileTable]:
    """Horizontal speeds of actors that are not parked, once an actor and moment, by the labels' velocities."""
    parked = chosen.column("instance", "actor_id") >= STATIC_ACTOR_ID
    x, y = chosen.column("track", "velocity")[:, :2].T
    speeds = np.hypot(x, y)
    groups = np.where(
        parked[chosen.column("track", "instance_row")], np.int8(-1), chosen.group("track")
    )
    why = "moments of actors whose label has no velocity, and that no agent saw in the frame before or after"
    left_out = LeftOut(what=why, counts=_by_group(groups[~np.isfinite(speeds)]))
    names = ("speeds", "Speed of actors that are not parked", "speed", "m/s")
    what = ("moments of actors", tuple(range(21)), left_out)
    return _distribution(names, what, speeds, chosen.column("track", "category"), groups)


def _distribution(
    names: tuple[str, str, str, str],
    what: tuple[str, tuple[int, ...], LeftOut],
    values: FloatArray,
    categories: AnyArray,
    groups: AnyArray,
) -> tuple[Histogram, QuantileTable]:
    """A number's histogram over all categories and its quantiles by category; `what` is counted, edges, left out."""
    _, title, field, unit = names
    counted, edges, left_out = what
    known: BoolArray = np.isfinite(values) & (groups >= 0)
    rows: list[QuantileRow] = []
    for code, category in enumerate(CATEGORIES):
        here = np.flatnonzero(known & (categories == code))
        rows += _quantile_rows(field, category, values[here], groups[here])
    quantiles = QuantileTable(
        name=f"{field}_quantiles",
        title=title,
        unit=unit,
        counted=counted,
        quantiles=tuple(rows),
        left_out=left_out,
    )
    return _histogram(names, counted, values, groups, edges, left_out), quantiles


def _interactions(chosen: _Chosen, **how: Unpack[Engine]) -> list[Histogram]:
    """The least time to collision of pairs of which each moves at some frame, and of scenarios."""
    pairs = least_times(chosen.dataset, list(chosen.scenarios.values()), **how)
    codes = chosen.scenario_group[list(chosen.scenarios)]
    of_pairs = np.concatenate([np.zeros(0), *pairs])
    of_scenarios = np.array([each.min(initial=np.inf) for each in pairs])
    texts = (
        (
            *("pair_min_ttcs", "Least TTC of moving pairs", "pairs"),
            *("moving pairs that come near each other on no collision course", of_pairs),
            np.repeat(codes, [len(each) for each in pairs]),
        ),
        (
            *(CRITICAL, "Least TTC of scenarios", "scenarios"),
            *("scenarios without labels or moving pairs that would collide", of_scenarios, codes),
        ),
    )
    return [
        _histogram(
            (name, title, "least time to collision", "s"),
            counted,
            np.where(np.isfinite(values), values, np.nan),
            groups,
            _TTCS,
            LeftOut(what=what, counts=_by_group(groups[~np.isfinite(values)])),
        )
        for name, title, counted, what, values, groups in texts
    ]


def _collisions(chosen: _Chosen) -> tuple[tuple[CollisionPair, ...], list[Histogram]]:
    """The labelled pairs at the last frame and how they meet; one actor that meta names twice is no pair."""
    tracks, pairs, without = _tracks_at_the_end(chosen), [], []
    for row, scenario in chosen.scenarios.items():
        if scenario["collision"] is None:
            continue
        names = {
            each["actor_id"]: each["name"] for each in chosen.agents.get(scenario["token"], [])
        }
        ids = _in_agents_order(scenario["collision"]["ids"], names)
        here = tracks.get(row, {})
        if len(set(ids)) == len(ids) and set(ids) <= set(here):
            pairs.append(
                _pair(chosen, scenario, [here[actor] for actor in ids], list(map(names.get, ids)))
            )
        else:
            without.append(chosen.scenario_group[row])
    left_out = LeftOut(
        what="collisions without a pair labelled at the last frame",
        counts=_by_group(np.array(without, dtype=np.int8)),
    )
    groups = np.array([_PARTS.index(pair.split) for pair in pairs], dtype=np.int8)
    values = {
        ("collision_angles", "Collision angle", "angle", "°"): [pair.angle for pair in pairs],
        ("collision_bearings", "Bearing of the other", "bearing", "°"): [
            _wrapped(np.degrees(np.arctan2(pair.y, pair.x))) for pair in pairs
        ],
    }
    histograms = [
        _histogram(names, "collisions", np.array(each, dtype=np.float64), groups, _ANGLES, left_out)
        for names, each in values.items()
    ]
    return tuple(pairs), histograms


def _tracks_at_the_end(chosen: _Chosen) -> dict[int, dict[int, int]]:
    """Scenario row → actor id → track row of the colliders at the scenario's last frame."""
    is_last = np.zeros(len(chosen.column("frame", "index")), dtype=bool)
    is_last[chosen.column("scenario", "last_frame_row")] = True
    rows: IntArray = np.flatnonzero(
        is_last[chosen.column("track", "frame_row")] & chosen.column("track", "is_collider")[:]
    )
    actors = chosen.column("instance", "actor_id")[chosen.column("track", "instance_row")[rows]]
    scenarios = chosen.column("track", "scenario_row")[rows]
    tracks: dict[int, dict[int, int]] = {}
    for scenario, actor, row in zip(
        scenarios.tolist(), actors.tolist(), rows.tolist(), strict=True
    ):
        tracks.setdefault(scenario, {})[actor] = row
    return tracks


def _pair(
    chosen: _Chosen, scenario: ScenarioRecord, tracks: Sequence[int], names: Sequence[str | None]
) -> CollisionPair:
    """The pair of two track rows, the first of which looks at the other."""
    first, other = quaternions.yaw_of(chosen.column("track", "rotation")[list(tracks)]).tolist()
    centers = chosen.column("track", "translation")
    x, y, _ = centers[tracks[1]] - centers[tracks[0]]
    cosine, sine = np.cos(first), np.sin(first)
    categories = [CATEGORIES[chosen.column("track", "category").item(row)] for row in tracks]
    return CollisionPair(
        scenario=scenario["token"],
        split=_split_of(scenario),
        end=chosen.ends[scenario["token"]] or UNKNOWN_SPLIT,
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
