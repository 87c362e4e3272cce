"""All statistics of a release, or of a selection of its scenarios, computed on table columns."""

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

ScenarioSelection = RowArgument | Iterable[RowArgument] | None
"""Tokens or records of scenarios, or a single one; None for all."""
# The groups that add up to the total; a row's code is an index here, −1 for rows that do not count.
_SPLIT_GROUPS: Final = GROUPS[1:]
_EGO: Final = AGENTS[0]
_SIZES: Final = ("length", "width", "height")
_ANGLE_BIN_DEG: Final = 30
# Twelve bins, centred at 0°, 30°, …, 330°.
_ANGLE_EDGES_DEG: Final = tuple(range(-_ANGLE_BIN_DEG // 2, 360, _ANGLE_BIN_DEG))
_TTC_EDGES_S: Final = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.5, 10.0)
# Table of counts → title, field, words that are always listed, what is counted.
_SCENARIO_TABLES: Final[Mapping[str, tuple[str, str, Sequence[str], str]]] = {
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
    scenarios: ScenarioSelection = None,
    *,
    interactions: bool = False,
    **engine: Unpack[Engine],
) -> DatasetStatistics:
    """Compute the paper's statistics on the tables' columns, without any annotation record.

    Everything is counted for all scenarios and for each split. Scenarios without labels count where
    calib, meta and folders are enough; elsewhere a table's `left_out` has their number.

    Args:
        dataset: Release to describe.
        scenarios: Tokens or records of the only scenarios to count, such as `find` returns, or a
            single one; None for all.
        interactions: Whether to add how soon moving pairs would collide (`da.interactions`); takes
            a tenth of a second a scenario unless these values are cached.
        **engine: `workers`, `executor` and `progress` of the interactions (`parallel.Engine`).

    Raises:
        TokenError: A token names no scenario of the release.
        ChoiceError: `scenarios` has another type, or `workers` is less than 1.
        WorkerError: A worker was killed, or cannot do the work.
    """
    selection = _Selection(dataset, sorted(set(rows_of_scenarios(dataset, scenarios))))
    pairs, pair_histograms = _describe_collisions(selection)
    distances, distance_quantiles = _describe_distances(selection)
    speeds, speed_quantiles = _describe_speeds(selection)
    histograms = [
        _bin_lengths(selection),
        _bin_ego_speeds(selection),
        _bin_actors(selection),
        distances,
        speeds,
        *pair_histograms,
    ]
    if interactions:
        histograms += _bin_interactions(selection, **engine)
    quantiles = (
        _ego_size_quantiles(selection),
        _box_size_quantiles(selection),
        distance_quantiles,
        speed_quantiles,
    )
    counts = (*_count_scenarios(selection), *_count_actors(selection))
    return DatasetStatistics(
        dataroot=str(dataset.dataroot),
        version=dataset.version,
        release_scenarios=len(dataset.scenario),
        selected=scenarios is not None,
        scenarios=_count_by_group(selection.scenario_group),
        frames=_count_by_group(selection.group("frame")),
        samples=_count_by_group(selection.group("sample")),
        unlabelled=selection.unlabelled.counts,
        counts={table.name: table for table in counts},
        histograms={table.name: table for table in histograms},
        quantiles={table.name: table for table in quantiles},
        collisions=pairs,
    )


class _Selection:
    """The selected scenarios, and a release's columns with the group that each row counts for."""

    def __init__(self, dataset: Dataset, rows: Sequence[int]) -> None:
        self.dataset = dataset
        self._groups: dict[str, AnyArray] = {}
        self.scenarios: dict[int, ScenarioRecord] = {row: dataset.scenario[row] for row in rows}
        self.agents: dict[str, list[AgentRecord]] = {
            scenario["token"]: [] for scenario in self.scenarios.values()
        }
        for agent in dataset.agent[:]:
            if agent["scenario_token"] in self.agents:
                self.agents[agent["scenario_token"]].append(agent)
        self.scenario_group = np.full(len(dataset.scenario), -1, dtype=np.int8)
        self.ends: dict[str, str | None] = {}
        for row, scenario in self.scenarios.items():
            token = scenario["token"]
            self.scenario_group[row] = _SPLIT_GROUPS.index(_split_of(scenario))
            self.ends[token] = scenario_end(scenario, self.agents[token])
        labelled = np.zeros(len(self.scenario_group), dtype=bool)
        labelled[self.column("sample", "scenario_row")[self.column("sample", "labelled")]] = True
        self.labelled_group = np.where(labelled, self.scenario_group, np.int8(-1))
        unlabelled_group = np.where(labelled, np.int8(-1), self.scenario_group)
        self.unlabelled = LeftOut(
            what="scenarios without labels", counts=_count_by_group(unlabelled_group)
        )

    def column(self, table: str, name: str) -> Any:
        """Return a stored column, read-only."""
        return self.dataset.columns(table)[name]

    def group(self, table: str) -> AnyArray:
        """Return the group code of every row of a table, shape (N,), int8."""
        if table not in self._groups:
            parent_groups = self.scenario_group
            key = "scenario_row"
            if table == "annotation":
                parent_groups = self.group("sample")
                key = "sample_row"
            self._groups[table] = parent_groups[self.column(table, key)]
        return self._groups[table]


def _split_of(scenario: ScenarioRecord) -> str:
    """Return the group, besides the total, that a scenario counts for."""
    return scenario["split"] or UNKNOWN_SPLIT


def _with_total(counts: AnyArray) -> dict[str, int]:
    """Return group → count, the total first, of counts by split group."""
    by_group = zip(_SPLIT_GROUPS, counts.tolist(), strict=True)
    return {TOTAL: int(counts.sum()), **dict(by_group)}


def _count_by_group(groups: AnyArray, weights: Iterable[int] | None = None) -> dict[str, int]:
    """Return group → number of rows (N,) with its code, or the sum of their weights."""
    counts = np.zeros(len(_SPLIT_GROUPS), dtype=np.int64)
    counted = groups >= 0
    np.add.at(counts, groups[counted], 1 if weights is None else np.asarray(weights)[counted])
    return _with_total(counts)


def _count_by_code(
    words: Sequence[str], codes: AnyArray, groups: AnyArray
) -> dict[str, dict[str, int]]:
    """Return word → group → number of rows (N,) with the word's code."""
    counted = (codes >= 0) & (groups >= 0)
    num_groups = len(_SPLIT_GROUPS)
    keys = codes[counted] * np.int16(num_groups) + groups[counted]
    counts = np.bincount(keys, minlength=len(words) * num_groups)
    table = counts.reshape(len(words), num_groups)
    return {word: _with_total(row) for word, row in zip(words, table, strict=True)}


def _make_histogram(
    names: tuple[str, str, str, str],
    counted: str,
    values: FloatArray,
    groups: AnyArray,
    edges: Sequence[float],
    left_out: LeftOut | None = None,
) -> Histogram:
    """Return a histogram of values (N,), without NaN and rows of group −1.

    `names` are its name, title, field and unit.
    """
    bounds = np.asarray(edges, dtype=np.float64)
    # Bin 0 holds values under the lowest edge, bin B + 1 values over the highest.
    bins = np.searchsorted(bounds, values, side="right").astype(np.int8)
    bins[values == bounds[-1]] = len(bounds) - 1
    bins[np.isnan(values)] = -1
    bin_names = list(map(str, range(len(edges) + 1)))
    too_low, *rows, too_high = _count_by_code(bin_names, bins, groups).values()
    name, title, field, unit = names
    return Histogram(
        name=name,
        title=title,
        field=field,
        unit=unit,
        counted=counted,
        edges=tuple(edges),
        counts={group: tuple(row[group] for row in rows) for group in GROUPS},
        outside={group: too_low[group] + too_high[group] for group in GROUPS},
        left_out=left_out,
    )


def _quantile_rows(
    field: str, category: str, values: FloatArray, groups: AnyArray
) -> list[QuantileRow]:
    """Return the quantiles of values (N,) without NaN in every group."""
    parts = [values[groups == code] for code in range(len(_SPLIT_GROUPS))]
    rows = []
    for group, part in zip(GROUPS, [np.concatenate(parts), *parts], strict=True):
        quantiles = tuple(np.quantile(part, PROBABILITIES).tolist()) if len(part) else None
        rows.append(
            QuantileRow(
                field=field, category=category, group=group, number=len(part), values=quantiles
            )
        )
    return rows


def _count_scenarios(selection: _Selection) -> list[CountTable]:
    """Return counts of scenarios by each of their words, and of frames by weather and time."""
    groups = selection.scenario_group[list(selection.scenarios)]
    scenarios = selection.scenarios.values()
    frames = np.array([scenario["num_frames"] for scenario in scenarios], dtype=np.int64)
    tables = []
    for name, (title, field, known_words, counted) in _SCENARIO_TABLES.items():
        names = [_scenario_word(selection, scenario, field) for scenario in scenarios]
        words = np.array(names, dtype=np.str_)
        new_words = sorted({*names} - {*known_words, UNKNOWN_SPLIT})
        listed_words = [*known_words, *new_words]
        if UNKNOWN_SPLIT in names:
            listed_words.append(UNKNOWN_SPLIT)
        weights = frames if counted == "frames" else np.ones_like(frames)
        counts = {}
        for word in listed_words:
            rows = np.flatnonzero(words == word)
            counts[word] = _count_by_group(groups[rows], weights[rows])
        table = CountTable(name=name, title=title, field=field, counted=counted, counts=counts)
        tables.append(table)
    return tables


def _scenario_word(selection: _Selection, scenario: ScenarioRecord, field: str) -> str:
    """Return the word that a scenario counts under in the table of a field."""
    if field == "end":
        return selection.ends[scenario["token"]] or UNKNOWN_SPLIT
    return word_of(scenario, field) or UNKNOWN_SPLIT


def _count_actors(selection: _Selection) -> list[CountTable]:
    """Return counts of instances, of parked instances and of annotations, by category."""
    category = selection.column("instance", "category")
    group = selection.group("instance")
    parked = selection.column("instance", "actor_id") >= STATIC_ACTOR_ID
    annotated = selection.column("annotation", "category"), selection.group("annotation")
    rows_by_name = {
        "instances": ("Instances", "instances", category, group),
        "parked_instances": ("Parked instances", "instances", category[parked], group[parked]),
        "annotations": ("Annotations", "annotations", *annotated),
    }
    tables = []
    for name, (title, counted, codes, groups) in rows_by_name.items():
        table = CountTable(
            name=name,
            title=title,
            field="category",
            counted=counted,
            counts=_count_by_code(CATEGORIES, codes, groups),
            left_out=selection.unlabelled,
        )
        tables.append(table)
    return tables


def _bin_lengths(selection: _Selection) -> Histogram:
    """Return the histogram of recorded frames a scenario; meta's simulated ones are ten more."""
    scenarios = selection.scenarios.values()
    lengths = np.array([scenario["num_frames"] for scenario in scenarios], dtype=np.float64)
    groups = selection.scenario_group[list(selection.scenarios)]
    names = ("lengths", "Lengths of scenarios", "length", "frames")
    return _make_histogram(names, "scenarios", lengths, groups, range(30, 101, 10))


def _bin_ego_speeds(selection: _Selection) -> Histogram:
    """Return the histogram of the ego's speeds at its samples, from the labels' first lines."""
    ego = selection.column("sample", "agent") == AGENTS.index(_EGO)
    speeds = np.linalg.norm(selection.column("sample", "velocity")[ego], axis=1)
    groups = selection.group("sample")[ego]
    left_out = LeftOut(
        what="ego samples without a label", counts=_count_by_group(groups[~np.isfinite(speeds)])
    )
    names = ("ego_speeds", "Speed of the ego vehicle", "speed", "m/s")
    return _make_histogram(names, "ego samples", speeds, groups, tuple(range(21)), left_out)


def _bin_actors(selection: _Selection) -> Histogram:
    """Return the histogram of actors (instances) a labelled scenario."""
    scenario_rows = selection.column("instance", "scenario_row")
    numbers = np.bincount(scenario_rows, minlength=len(selection.scenario_group)).astype(float)
    names = ("actors", "Actors a scenario", "actors", "actors")
    edges = range(0, 201, 10)
    return _make_histogram(
        names, "scenarios", numbers, selection.labelled_group, edges, selection.unlabelled
    )


def _ego_size_quantiles(selection: _Selection) -> QuantileTable:
    """Return quantiles of the size of `ego_vehicle`, once a scenario, from its own label row."""
    ego = selection.column("agent", "name") == AGENTS.index(_EGO)
    sizes = selection.column("agent", "size")[ego]
    groups = selection.group("agent")[ego]
    known = ~np.isnan(sizes).any(axis=1)
    rows: list[QuantileRow] = []
    for axis, field in enumerate(_SIZES):
        rows += _quantile_rows(field, _EGO, sizes[known, axis], groups[known])
    left_out = LeftOut(
        what="scenarios whose ego has no label row of its own",
        counts=_count_by_group(groups[~known]),
    )
    return QuantileTable(
        name="ego_sizes",
        title="Size of the ego vehicle",
        unit="m",
        counted="scenarios",
        quantiles=tuple(rows),
        left_out=left_out,
    )


def _box_size_quantiles(selection: _Selection) -> QuantileTable:
    """Return quantiles of length, width and height of all annotations, by category."""
    categories = selection.column("annotation", "category")
    sizes = selection.column("annotation", "size")
    groups = selection.group("annotation")
    rows: list[QuantileRow] = []
    for code, name in enumerate(CATEGORIES):
        indices = np.flatnonzero((categories == code) & (groups >= 0))
        for axis, field in enumerate(_SIZES):
            rows += _quantile_rows(field, name, sizes[indices, axis], groups[indices])
    return QuantileTable(
        name="box_sizes",
        title="Sizes of boxes",
        unit="m",
        counted="annotations",
        quantiles=tuple(rows),
        left_out=selection.unlabelled,
    )


def _describe_distances(selection: _Selection) -> tuple[Histogram, QuantileTable]:
    """Return horizontal distances of annotations from their agent's LiDAR, without its own box."""
    x, y = selection.column("annotation", "translation")[:, :2].T
    is_own = selection.column("annotation", "actor_id") == OWN_ACTOR_ID
    groups = np.where(is_own, np.int8(-1), selection.group("annotation"))
    names = ("distances", "Distance from the agent", "distance", "m")
    binning = ("annotations of others", tuple(range(0, 101, 5)), selection.unlabelled)
    categories = selection.column("annotation", "category")
    return _describe_values(names, binning, np.hypot(x, y), categories, groups)


def _describe_speeds(selection: _Selection) -> tuple[Histogram, QuantileTable]:
    """Return horizontal speeds of moving traffic, once an actor and frame, as labels have them.

    Parked actors are left out.
    """
    parked_instances = selection.column("instance", "actor_id") >= STATIC_ACTOR_ID
    x, y = selection.column("track", "velocity")[:, :2].T
    speeds = np.hypot(x, y)
    is_parked = parked_instances[selection.column("track", "instance_row")]
    groups = np.where(is_parked, np.int8(-1), selection.group("track"))
    left_out = LeftOut(
        what="moments of actors whose label has no velocity, and that no agent saw in the frame"
        " before or after",
        counts=_count_by_group(groups[~np.isfinite(speeds)]),
    )
    names = ("speeds", "Speed of actors that are not parked", "speed", "m/s")
    binning = ("moments of actors", tuple(range(21)), left_out)
    categories = selection.column("track", "category")
    return _describe_values(names, binning, speeds, categories, groups)


def _describe_values(
    names: tuple[str, str, str, str],
    binning: tuple[str, tuple[int, ...], LeftOut],
    values: FloatArray,
    categories: AnyArray,
    groups: AnyArray,
) -> tuple[Histogram, QuantileTable]:
    """Return the histogram of values (N,) over all categories and their quantiles by category.

    `binning` is what is counted, the edges and what is left out.
    """
    _, title, field, unit = names
    counted, edges, left_out = binning
    known: BoolArray = np.isfinite(values) & (groups >= 0)
    rows: list[QuantileRow] = []
    for code, category in enumerate(CATEGORIES):
        indices = np.flatnonzero(known & (categories == code))
        rows += _quantile_rows(field, category, values[indices], groups[indices])
    quantiles = QuantileTable(
        name=f"{field}_quantiles",
        title=title,
        unit=unit,
        counted=counted,
        quantiles=tuple(rows),
        left_out=left_out,
    )
    return _make_histogram(names, counted, values, groups, edges, left_out), quantiles


def _bin_interactions(selection: _Selection, **engine: Unpack[Engine]) -> list[Histogram]:
    """Return the least time to collision of pairs, and of scenarios.

    Both actors of a pair move at some frame.
    """
    pair_times = least_times(selection.dataset, list(selection.scenarios.values()), **engine)
    scenario_codes = selection.scenario_group[list(selection.scenarios)]
    pair_codes = np.repeat(scenario_codes, [len(times) for times in pair_times])
    scenario_times = np.array([times.min(initial=np.inf) for times in pair_times])
    return [
        _bin_times(
            ("pair_min_ttcs", "Least TTC of moving pairs", "pairs"),
            np.concatenate([np.zeros(0), *pair_times]),
            pair_codes,
            "moving pairs that come near each other on no collision course",
        ),
        _bin_times(
            (CRITICAL, "Least TTC of scenarios", "scenarios"),
            scenario_times,
            scenario_codes,
            "scenarios without labels or moving pairs that would collide",
        ),
    ]


def _bin_times(
    texts: tuple[str, str, str], times: FloatArray, groups: AnyArray, without_time: str
) -> Histogram:
    """Return the histogram of least times to collision (N,), inf where there is no collision.

    `texts` are its name, its title and what is counted.
    """
    name, title, counted = texts
    known = np.isfinite(times)
    left_out = LeftOut(what=without_time, counts=_count_by_group(groups[~known]))
    names = (name, title, "least time to collision", "s")
    finite_times = np.where(known, times, np.nan)
    return _make_histogram(names, counted, finite_times, groups, _TTC_EDGES_S, left_out)


def _describe_collisions(
    selection: _Selection,
) -> tuple[tuple[CollisionPair, ...], list[Histogram]]:
    """Return the pairs labelled at the last frame, and the histograms of how they meet.

    One actor that meta names twice is no pair.
    """
    tracks = _find_last_tracks(selection)
    pairs = []
    unpaired_groups = []
    for row, scenario in selection.scenarios.items():
        if scenario["collision"] is None:
            continue
        names = {agent["actor_id"]: agent["name"] for agent in selection.agents[scenario["token"]]}
        ids = _sort_agents_first(scenario["collision"]["ids"], names)
        track_rows = tracks.get(row, {})
        if len(set(ids)) == len(ids) and set(ids) <= set(track_rows):
            pair_rows = [track_rows[actor] for actor in ids]
            pairs.append(_make_pair(selection, scenario, pair_rows, list(map(names.get, ids))))
        else:
            unpaired_groups.append(selection.scenario_group[row])
    left_out = LeftOut(
        what="collisions without a pair labelled at the last frame",
        counts=_count_by_group(np.array(unpaired_groups, dtype=np.int8)),
    )
    return tuple(pairs), _bin_angles(pairs, left_out)


def _bin_angles(pairs: Sequence[CollisionPair], left_out: LeftOut) -> list[Histogram]:
    """Return the histograms of collision angles and of the other actor's bearings, degrees."""
    groups = np.array([_SPLIT_GROUPS.index(pair.split) for pair in pairs], dtype=np.int8)
    angles = np.empty(len(pairs))
    bearings = np.empty(len(pairs))
    for index, pair in enumerate(pairs):
        angles[index] = pair.angle
        bearings[index] = _wrap_angle(np.degrees(np.arctan2(pair.y, pair.x)))
    values = {
        ("collision_angles", "Collision angle", "angle", "°"): angles,
        ("collision_bearings", "Bearing of the other", "bearing", "°"): bearings,
    }
    return [
        _make_histogram(names, "collisions", degrees, groups, _ANGLE_EDGES_DEG, left_out)
        for names, degrees in values.items()
    ]


def _find_last_tracks(selection: _Selection) -> dict[int, dict[int, int]]:
    """Return scenario row → actor id → track row of colliders at the scenario's last frame."""
    is_last = np.zeros(len(selection.column("frame", "index")), dtype=bool)
    is_last[selection.column("scenario", "last_frame_row")] = True
    is_last_track = is_last[selection.column("track", "frame_row")]
    is_collider = selection.column("track", "is_collider")[:]
    rows: IntArray = np.flatnonzero(is_last_track & is_collider)
    instances = selection.column("track", "instance_row")[rows]
    actors = selection.column("instance", "actor_id")[instances].tolist()
    scenarios = selection.column("track", "scenario_row")[rows].tolist()
    tracks: dict[int, dict[int, int]] = {}
    for scenario, actor, row in zip(scenarios, actors, rows.tolist(), strict=True):
        tracks.setdefault(scenario, {})[actor] = row
    return tracks


def _make_pair(
    selection: _Selection,
    scenario: ScenarioRecord,
    tracks: Sequence[int],
    names: Sequence[str | None],
) -> CollisionPair:
    """Return the pair of two track rows, seen from the first of them."""
    rotations = selection.column("track", "rotation")[list(tracks)]
    actor_yaw, other_yaw = quaternions.yaw_of(rotations).tolist()
    centers = selection.column("track", "translation")
    x, y, _ = centers[tracks[1]] - centers[tracks[0]]
    cosine = np.cos(actor_yaw)
    sine = np.sin(actor_yaw)
    codes = selection.column("track", "category")
    return CollisionPair(
        scenario=scenario["token"],
        split=_split_of(scenario),
        end=selection.ends[scenario["token"]] or UNKNOWN_SPLIT,
        actor=names[0],
        category=CATEGORIES[codes.item(tracks[0])],
        other=names[1],
        other_category=CATEGORIES[codes.item(tracks[1])],
        angle=_wrap_angle(np.degrees(other_yaw - actor_yaw)),
        x=float(cosine * x + sine * y),
        y=float(cosine * y - sine * x),
    )


def _wrap_angle(degrees: float) -> float:
    """Return the angle in [−15, 345) degrees."""
    return float((degrees + _ANGLE_BIN_DEG / 2) % 360 - _ANGLE_BIN_DEG / 2)


def _sort_agents_first(ids: Sequence[int], names: Mapping[int | None, str]) -> list[int]:
    """Return a pair's actor ids, agents first in the order of `AGENTS`, others in their order."""
    ranks: dict[str | None, int] = {name: rank for rank, name in enumerate(AGENTS)}

    def rank(actor: int) -> int:
        return ranks.get(names.get(actor), len(AGENTS))

    return sorted(ids, key=rank)
