"""Statistics of actors: instances, annotations, their sizes, distances and speeds."""

from __future__ import annotations

import numpy as np

from deepaccident_devkit.arrays import AnyArray, BoolArray, FloatArray
from deepaccident_devkit.statistics.results import CountTable, Histogram, LeftOut, QuantileRow, QuantileTable
from deepaccident_devkit.statistics.selected import Selected, binned, cross_counts, group_counts, quantile_rows
from deepaccident_devkit.taxonomy import CATEGORIES, OWN_ACTOR_ID, STATIC_ACTOR_ID

_DISTANCE_EDGES = tuple(range(0, 101, 5))
_SPEED_EDGES = tuple(range(21))
_ACTOR_EDGES = tuple(range(0, 201, 10))


def actor_counts(selected: Selected) -> list[CountTable]:
    """Instances, parked ones among them, and annotations, by category."""
    unlabelled = selected.unlabelled
    category, group = selected.column("instance", "category"), selected.group("instance")
    parked = selected.column("instance", "actor_id") >= STATIC_ACTOR_ID
    rows = {
        ("instances", "Instances", "instances"): (category, group),
        ("parked_instances", "Parked instances", "instances"): (category[parked], group[parked]),
        ("annotations", "Annotations", "annotations"): (
            selected.column("annotation", "category"),
            selected.annotation_group,
        ),
    }
    return [
        CountTable(
            name=name,
            title=title,
            field="category",
            counted=counted,
            counts=dict(zip(CATEGORIES, cross_counts(*columns, len(CATEGORIES)), strict=True)),
            left_out=unlabelled,
        )
        for (name, title, counted), columns in rows.items()
    ]


def actors(selected: Selected) -> Histogram:
    """Actors (instances) of each labelled scenario."""
    numbers = np.bincount(selected.column("instance", "scenario_row"), minlength=len(selected.scenario_group))
    labelled = selected.labelled
    counts, outside = binned(numbers[labelled].astype(np.float64), selected.scenario_group[labelled], _ACTOR_EDGES)
    return Histogram(
        name="actors",
        title="Actors a scenario",
        field="actors",
        unit="actors",
        counted="scenarios",
        edges=_ACTOR_EDGES,
        counts=counts,
        outside=outside,
        left_out=selected.unlabelled,
    )


def box_sizes(selected: Selected) -> QuantileTable:
    """Length, width and height of all annotations, by category."""
    sizes = selected.column("annotation", "size")
    rows: list[QuantileRow] = []
    for code, name in enumerate(CATEGORIES):
        chosen = np.flatnonzero((selected.column("annotation", "category") == code) & (selected.annotation_group >= 0))
        groups = selected.annotation_group[chosen]
        for axis, field in enumerate(("length", "width", "height")):
            rows += quantile_rows(field, name, sizes[chosen, axis], groups)
    return QuantileTable(
        name="box_sizes",
        title="Sizes of boxes",
        unit="m",
        counted="annotations",
        quantiles=tuple(rows),
        left_out=selected.unlabelled,
    )


def distances(selected: Selected) -> tuple[Histogram, QuantileTable]:
    """Horizontal distances of annotated boxes from the LiDAR of their agent; its own box does not count."""
    others = selected.column("annotation", "actor_id") != OWN_ACTOR_ID
    x, y = selected.column("annotation", "translation")[:, :2].T
    return _distribution(
        ("distances", "Distance from the agent", "distance", "m"),
        "annotations of others",
        np.hypot(x, y),
        (selected.column("annotation", "category"), np.where(others, selected.annotation_group, np.int8(-1))),
        (_DISTANCE_EDGES, selected.unlabelled),
    )


def speeds(selected: Selected) -> tuple[Histogram, QuantileTable]:
    """Horizontal speeds of actors that are not parked, once an actor and moment, by the labels' velocities."""
    parked = selected.column("instance", "actor_id") >= STATIC_ACTOR_ID
    x, y = selected.column("track", "velocity")[:, :2].T
    speed = np.hypot(x, y)
    known: BoolArray = np.isfinite(speed)
    groups = np.where(parked[selected.column("track", "instance_row")], np.int8(-1), selected.group("track"))
    what = "moments of actors whose label has no velocity, and that no agent saw in the frame before or after"
    return _distribution(
        ("speeds", "Speed of actors that are not parked", "speed", "m/s"),
        "moments of actors",
        speed[known],
        (selected.column("track", "category")[known], groups[known]),
        (_SPEED_EDGES, LeftOut(what=what, counts=group_counts(groups[~known]))),
    )


def _distribution(
    names: tuple[str, str, str, str],
    counted: str,
    values: FloatArray,
    keys: tuple[AnyArray, AnyArray],
    binning: tuple[tuple[int, ...], LeftOut],
) -> tuple[Histogram, QuantileTable]:
    """A number's histogram over all categories and its quantiles by category.

    Args:
        names: name of the histogram, title, field, unit.
        counted: what the values belong to.
        values: (N,) without NaN.
        keys: (N,) category codes, (N,) group codes.
        binning: the histogram's edges, what has no value.
    """
    (name, title, field, unit), (categories, groups), (edges, left_out) = names, keys, binning
    counts, outside = binned(values, groups, edges)
    histogram = Histogram(
        name=name,
        title=title,
        field=field,
        unit=unit,
        counted=counted,
        edges=edges,
        counts=counts,
        outside=outside,
        left_out=left_out,
    )
    rows: list[QuantileRow] = []
    for code, category in enumerate(CATEGORIES):
        chosen = np.flatnonzero((categories == code) & (groups >= 0))
        rows += quantile_rows(field, category, values[chosen], groups[chosen])
    quantiles = QuantileTable(
        name=f"{field}_quantiles",
        title=title,
        unit=unit,
        counted=counted,
        quantiles=tuple(rows),
        left_out=left_out,
    )
    return histogram, quantiles
