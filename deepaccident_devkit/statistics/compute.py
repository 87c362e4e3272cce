"""All statistics of a release, or of some of its scenarios, computed from table columns."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from deepaccident_devkit import taxonomy
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.interactions.scenario import min_times_to_collision
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
"""A token or record of a scenario, or several; None for all."""
# The groups that add up to the total. A row's code is an index into them; −1 if it is not counted.
_SPLIT_GROUPS = GROUPS[1:]
# Name, title, field and unit of a histogram.
_HistogramNames = tuple[str, str, str, str]
_ValueTables = tuple[Histogram, QuantileTable]
_EGO = AGENTS[0]
_SIZES = ("length", "width", "height")
# Bin width in degrees, and edges of twelve bins centred at 0°, 30°, …, 330°.
_ANGLE_BIN_DEG = 30
_ANGLE_EDGES_DEG = tuple(range(-_ANGLE_BIN_DEG // 2, 360, _ANGLE_BIN_DEG))
# Edges of the bins of times to collision.
_TTC_EDGES_S = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.5, 10.0)
# Name of a table of counts → title, field, words that are always listed, what is counted.
_SCENARIO_TABLES = {
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
    """Compute the paper's statistics from table columns, without building annotation records.

    Everything is counted for all scenarios and for each split. Scenarios without labels are only
    counted where calib, meta and folders suffice; other tables state their number in `left_out`.

    Args:
        dataset: Release to describe.
        scenarios: Tokens or records of the scenarios to count, such as `find` returns, or a single
            one; None for all.
        interactions: Whether to add how soon moving pairs would collide (`da.interactions`); this
            takes 0.1 s per scenario unless it is cached.
        **engine: `workers`, `executor` and `progress` of the interactions (`parallel.Engine`).

    Raises:
        TokenError: If a token belongs to no scenario in the release.
        ChoiceError: If `scenarios` has another type, or `workers` is less than 1.
        WorkerError: If a worker was killed, or cannot do the work.
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
    """The selected scenarios, and the release's columns with the group in which each row counts.

    Attributes:
        dataset: The release.
        scenarios: Row number → record of each selected scenario.
        agents: Token of a selected scenario → its agents.
        scenario_group: Group code of each scenario in the release, int8.
        labelled_group: Group code of each scenario; −1 for scenarios without labels, int8.
        ends: Token of a selected scenario → how it ended.
        unlabelled: Number of selected scenarios without labels.
    """

    def __init__(self, dataset: Dataset, rows: Sequence[int]) -> None:
        self.dataset = dataset
        self._groups: dict[str, AnyArray] = {}
        self.scenarios: dict[int, ScenarioRecord] = {row: dataset.scenario[row] for row in rows}
        self.agents: dict[str, list[AgentRecord]] = {}
        for scenario in self.scenarios.values():
            self.agents[scenario["token"]] = []
        for agent in dataset.agent[:]:
            if agent["scenario_token"] in self.agents:
                self.agents[agent["scenario_token"]].append(agent)
        self.scenario_group = np.full(len(dataset.scenario), -1, dtype=np.int8)
        self.ends: dict[str, str | None] = {}
        for row, scenario in self.scenarios.items():
            token = scenario["token"]
            self.scenario_group[row] = _SPLIT_GROUPS.index(_split_of(scenario))
            self.ends[token] = scenario_end(scenario, self.agents[token])
        labelled_samples = self.column("sample", "labelled")
        labelled_rows = self.column("sample", "scenario_row")[labelled_samples]
        is_labelled = np.zeros(len(self.scenario_group), dtype=bool)
        is_labelled[labelled_rows] = True
        self.labelled_group = np.where(is_labelled, self.scenario_group, np.int8(-1))
        unlabelled_group = np.where(is_labelled, np.int8(-1), self.scenario_group)
        self.unlabelled = LeftOut(
            what="scenarios without labels", counts=_count_by_group(unlabelled_group)
        )

    def column(self, table: str, name: str) -> Any:
        """Return a stored column, which is read-only."""
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
    """Return the group in which a scenario counts, apart from the total."""
    return scenario["split"] or UNKNOWN_SPLIT


def _with_total(counts: AnyArray) -> dict[str, int]:
    """Return group → count, with the total first, from the counts by split group."""
    by_group = zip(_SPLIT_GROUPS, counts.tolist(), strict=True)
    return {TOTAL: int(counts.sum()), **dict(by_group)}


def _count_by_group(groups: AnyArray, weights: Iterable[int] | None = None) -> dict[str, int]:
    """Return group → number of rows (N,) with its code, or the sum of their weights."""
    counts = np.zeros(len(_SPLIT_GROUPS), dtype=np.int64)
    is_counted = groups >= 0
    increments: Any = 1
    if weights is not None:
        increments = np.asarray(weights)[is_counted]
    np.add.at(counts, groups[is_counted], increments)
    return _with_total(counts)


def _count_by_code(
    words: Sequence[str], codes: AnyArray, groups: AnyArray
) -> dict[str, dict[str, int]]:
    """Return word → group → number of rows (N,) with the code of the word."""
    is_counted = (codes >= 0) & (groups >= 0)
    num_groups = len(_SPLIT_GROUPS)
    keys = codes[is_counted] * np.int16(num_groups) + groups[is_counted]
    counts = np.bincount(keys, minlength=len(words) * num_groups)
    rows = counts.reshape(len(words), num_groups)
    table = {}
    for word, row in zip(words, rows, strict=True):
        table[word] = _with_total(row)
    return table


def _make_histogram(
    names: _HistogramNames,
    counted: str,
    values: FloatArray,
    groups: AnyArray,
    edges: Sequence[float],
    left_out: LeftOut | None = None,
) -> Histogram:
    """Count values (N,) in bins; NaN and rows of group −1 are left out.

    Args:
        names: Name, title, field and unit of the histogram.
        counted: What is counted.
        values: Values, shape (N,).
        groups: Group code of each value, shape (N,).
        edges: Edges of the bins, ascending.
        left_out: Items without a value.
    """
    bounds = np.asarray(edges, dtype=np.float64)
    # Bin 0 contains values below the lowest edge, bin B + 1 values above the highest.
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
    """Compute the quantiles of values (N,), ignoring NaN; one row per group."""
    split_values = [values[groups == code] for code in range(len(_SPLIT_GROUPS))]
    total_values = np.concatenate(split_values)
    rows = []
    for group, group_values in zip(GROUPS, [total_values, *split_values], strict=True):
        quantiles = None
        if len(group_values):
            quantiles = tuple(np.quantile(group_values, PROBABILITIES).tolist())
        row = QuantileRow(
            field=field,
            category=category,
            group=group,
            number=len(group_values),
            values=quantiles,
        )
        rows.append(row)
    return rows


def _count_scenarios(selection: _Selection) -> list[CountTable]:
    """Count scenarios by each of their attributes, and frames by weather and time."""
    groups = selection.scenario_group[list(selection.scenarios)]
    scenarios = selection.scenarios.values()
    frames = np.array([scenario["num_frames"] for scenario in scenarios], dtype=np.int64)
    tables = []
    for name, (title, field, known_words, counted) in _SCENARIO_TABLES.items():
        words = [_scenario_word(selection, scenario, field) for scenario in scenarios]
        new_words = sorted({*words} - {*known_words, UNKNOWN_SPLIT})
        listed_words = [*known_words, *new_words]
        if UNKNOWN_SPLIT in words:
            listed_words.append(UNKNOWN_SPLIT)
        word_array = np.array(words, dtype=np.str_)
        weights = frames if counted == "frames" else np.ones_like(frames)
        counts = {}
        for word in listed_words:
            rows = np.flatnonzero(word_array == word)
            counts[word] = _count_by_group(groups[rows], weights[rows])
        table = CountTable(name=name, title=title, field=field, counted=counted, counts=counts)
        tables.append(table)
    return tables


def _scenario_word(selection: _Selection, scenario: ScenarioRecord, field: str) -> str:
    """Return the word under which a scenario is counted in the table of a field."""
    if field == "end":
        return selection.ends[scenario["token"]] or UNKNOWN_SPLIT
    return word_of(scenario, field) or UNKNOWN_SPLIT


def _count_actors(selection: _Selection) -> list[CountTable]:
    """Count instances, parked instances and annotations by category."""
    category = selection.column("instance", "category")
    group = selection.group("instance")
    is_parked = selection.column("instance", "actor_id") >= STATIC_ACTOR_ID
    box_category = selection.column("annotation", "category")
    box_group = selection.group("annotation")
    tables = []
    for name, title, counted, codes, groups in (
        ("instances", "Instances", "instances", category, group),
        (
            "parked_instances",
            "Parked instances",
            "instances",
            category[is_parked],
            group[is_parked],
        ),
        ("annotations", "Annotations", "annotations", box_category, box_group),
    ):
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
    """Make the histogram of recorded frames per scenario (ten fewer than in the meta file)."""
    scenarios = selection.scenarios.values()
    lengths = np.array([scenario["num_frames"] for scenario in scenarios], dtype=np.float64)
    groups = selection.scenario_group[list(selection.scenarios)]
    names = ("lengths", "Lengths of scenarios", "length", "frames")
    return _make_histogram(names, "scenarios", lengths, groups, range(30, 101, 10))


def _bin_ego_speeds(selection: _Selection) -> Histogram:
    """Make the histogram of the ego's speed in its samples, from the labels' first lines."""
    is_ego = selection.column("sample", "agent") == AGENTS.index(_EGO)
    velocities = selection.column("sample", "velocity")[is_ego]
    speeds = np.linalg.norm(velocities, axis=1)
    groups = selection.group("sample")[is_ego]
    is_unknown = ~np.isfinite(speeds)
    left_out = LeftOut(
        what="ego samples without a label", counts=_count_by_group(groups[is_unknown])
    )
    names = ("ego_speeds", "Speed of the ego vehicle", "speed", "m/s")
    return _make_histogram(names, "ego samples", speeds, groups, tuple(range(21)), left_out)


def _bin_actors(selection: _Selection) -> Histogram:
    """Make the histogram of actors (instances) per labelled scenario."""
    scenario_rows = selection.column("instance", "scenario_row")
    numbers = np.bincount(scenario_rows, minlength=len(selection.scenario_group)).astype(float)
    names = ("actors", "Actors a scenario", "actors", "actors")
    edges = range(0, 201, 10)
    return _make_histogram(
        names, "scenarios", numbers, selection.labelled_group, edges, selection.unlabelled
    )


def _ego_size_quantiles(selection: _Selection) -> QuantileTable:
    """Compute quantiles of the ego's size, from its own label row, once per scenario."""
    is_ego = selection.column("agent", "name") == AGENTS.index(_EGO)
    sizes = selection.column("agent", "size")[is_ego]
    groups = selection.group("agent")[is_ego]
    is_known = ~np.isnan(sizes).any(axis=1)
    rows: list[QuantileRow] = []
    for axis, field in enumerate(_SIZES):
        rows += _quantile_rows(field, _EGO, sizes[is_known, axis], groups[is_known])
    left_out = LeftOut(
        what="scenarios whose ego has no label row of its own",
        counts=_count_by_group(groups[~is_known]),
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
    """Compute quantiles of length, width and height over all annotations, by category."""
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


def _describe_distances(selection: _Selection) -> _ValueTables:
    """Describe annotations' horizontal distances from their agent's LiDAR, except its own box."""
    x, y = selection.column("annotation", "translation")[:, :2].T
    is_own = selection.column("annotation", "actor_id") == OWN_ACTOR_ID
    groups = np.where(is_own, np.int8(-1), selection.group("annotation"))
    names = ("distances", "Distance from the agent", "distance", "m")
    binning = ("annotations of others", tuple(range(0, 101, 5)), selection.unlabelled)
    categories = selection.column("annotation", "category")
    return _describe_values(names, binning, np.hypot(x, y), categories, groups)


def _describe_speeds(selection: _Selection) -> _ValueTables:
    """Describe the labelled horizontal speeds of moving traffic, once per actor and frame.

    Parked actors are left out.
    """
    is_parked_instance = selection.column("instance", "actor_id") >= STATIC_ACTOR_ID
    is_parked = is_parked_instance[selection.column("track", "instance_row")]
    groups = np.where(is_parked, np.int8(-1), selection.group("track"))
    x, y = selection.column("track", "velocity")[:, :2].T
    speeds = np.hypot(x, y)
    is_unknown = ~np.isfinite(speeds)
    left_out = LeftOut(
        what="moments of actors whose label has no velocity, and that no agent saw in the frame"
        " before or after",
        counts=_count_by_group(groups[is_unknown]),
    )
    names = ("speeds", "Speed of actors that are not parked", "speed", "m/s")
    binning = ("moments of actors", tuple(range(21)), left_out)
    categories = selection.column("track", "category")
    return _describe_values(names, binning, speeds, categories, groups)


def _describe_values(
    names: _HistogramNames,
    binning: tuple[str, tuple[int, ...], LeftOut],
    values: FloatArray,
    categories: AnyArray,
    groups: AnyArray,
) -> _ValueTables:
    """Return the histogram of values (N,) over all categories, and quantiles by category.

    Args:
        names: Name, title, field and unit.
        binning: What is counted, the edges of the bins, and what is left out.
        values: Values, shape (N,).
        categories: Category code of each value, shape (N,).
        groups: Group code of each value, shape (N,).
    """
    _, title, field, unit = names
    counted, edges, left_out = binning
    is_known: BoolArray = np.isfinite(values) & (groups >= 0)
    rows: list[QuantileRow] = []
    for code, category in enumerate(CATEGORIES):
        indices = np.flatnonzero(is_known & (categories == code))
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
    """Make histograms of the smallest time to collision, of each pair and of each scenario.

    Only pairs in which both actors move at some time are counted.
    """
    pair_times = min_times_to_collision(
        selection.dataset, list(selection.scenarios.values()), **engine
    )
    num_pairs = [len(times) for times in pair_times]
    scenario_times = np.array([times.min(initial=np.inf) for times in pair_times])
    scenario_codes = selection.scenario_group[list(selection.scenarios)]
    pair_codes = np.repeat(scenario_codes, num_pairs)
    return [
        _bin_times(
            ("pair_min_ttcs", "Least TTC of moving pairs", "pairs"),
            np.concatenate([np.zeros(0), *pair_times]),
            pair_codes,
            "moving pairs that come near each other, but not on a collision course",
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
    """Make the histogram of smallest times to collision (N,) in seconds.

    Args:
        texts: Name, title and what is counted.
        times: Times in seconds, shape (N,); inf where there is no collision.
        groups: Group code of each time, shape (N,).
        without_time: Text for what has no time.
    """
    name, title, counted = texts
    is_known = np.isfinite(times)
    known_times = np.where(is_known, times, np.nan)
    left_out = LeftOut(what=without_time, counts=_count_by_group(groups[~is_known]))
    names = (name, title, "least time to collision", "s")
    return _make_histogram(names, counted, known_times, groups, _TTC_EDGES_S, left_out)


def _describe_collisions(
    selection: _Selection,
) -> tuple[tuple[CollisionPair, ...], list[Histogram]]:
    """Return the pairs labelled in the last frame, and histograms of how their actors meet.

    If meta names the same actor twice, that is not a pair.
    """
    tracks = _find_last_tracks(selection)
    pairs = []
    unpaired_groups = []
    for row, scenario in selection.scenarios.items():
        if scenario["collision"] is None:
            continue
        agents = selection.agents[scenario["token"]]
        agents_by_id = {agent["actor_id"]: agent["name"] for agent in agents}
        ids = _sort_agents_first(scenario["collision"]["ids"], agents_by_id)
        track_rows = tracks.get(row, {})
        if len(set(ids)) == len(ids) and set(ids) <= set(track_rows):
            pair_rows = [track_rows[actor] for actor in ids]
            names = [agents_by_id.get(actor) for actor in ids]
            pairs.append(_make_pair(selection, scenario, pair_rows, names))
        else:
            unpaired_groups.append(selection.scenario_group[row])
    left_out = LeftOut(
        what="collisions without a pair labelled at the last frame",
        counts=_count_by_group(np.array(unpaired_groups, dtype=np.int8)),
    )
    return tuple(pairs), _bin_angles(pairs, left_out)


def _bin_angles(pairs: Sequence[CollisionPair], left_out: LeftOut) -> list[Histogram]:
    """Make the histograms of collision angles and of the other actor's bearing, in degrees."""
    groups = np.array([_SPLIT_GROUPS.index(pair.split) for pair in pairs], dtype=np.int8)
    angles = np.array([pair.angle for pair in pairs])
    bearings = np.empty(len(pairs))
    for index, pair in enumerate(pairs):
        bearing = np.degrees(np.arctan2(pair.y, pair.x))
        bearings[index] = _wrap_angle(bearing)
    histograms = []
    for names, degrees in (
        (("collision_angles", "Collision angle", "angle", "°"), angles),
        (("collision_bearings", "Bearing of the other", "bearing", "°"), bearings),
    ):
        histograms.append(
            _make_histogram(names, "collisions", degrees, groups, _ANGLE_EDGES_DEG, left_out)
        )
    return histograms


def _find_last_tracks(selection: _Selection) -> dict[int, dict[int, int]]:
    """Return the colliders' track rows in the last frame: scenario row → actor id → track row."""
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
    track_rows: Sequence[int],
    agent_names: Sequence[str | None],
) -> CollisionPair:
    """Build the pair from two track rows; angle and position are relative to the first actor."""
    rotations = selection.column("track", "rotation")[list(track_rows)]
    actor_yaw, other_yaw = quaternions.yaw_of(rotations).tolist()
    centers = selection.column("track", "translation")
    x, y, _ = centers[track_rows[1]] - centers[track_rows[0]]
    cosine = np.cos(actor_yaw)
    sine = np.sin(actor_yaw)
    codes = selection.column("track", "category")
    return CollisionPair(
        scenario=scenario["token"],
        split=_split_of(scenario),
        end=selection.ends[scenario["token"]] or UNKNOWN_SPLIT,
        actor=agent_names[0],
        category=CATEGORIES[codes.item(track_rows[0])],
        other=agent_names[1],
        other_category=CATEGORIES[codes.item(track_rows[1])],
        angle=_wrap_angle(np.degrees(other_yaw - actor_yaw)),
        x=float(cosine * x + sine * y),
        y=float(cosine * y - sine * x),
    )


def _wrap_angle(degrees: float) -> float:
    """Wrap an angle to [−15, 345) degrees."""
    half_bin = _ANGLE_BIN_DEG / 2
    return float((degrees + half_bin) % 360 - half_bin)


def _sort_agents_first(ids: Sequence[int], names: Mapping[int | None, str]) -> list[int]:
    """Sort two actor ids: agents in the order of `AGENTS`, then other actors as passed."""
    ranks: dict[str | None, int] = {name: rank for rank, name in enumerate(AGENTS)}

    def rank(actor: int) -> int:
        return ranks.get(names.get(actor), len(AGENTS))

    return sorted(ids, key=rank)
