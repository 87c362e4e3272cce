"""Statistics of actors: instances, annotations, their sizes, distances and speeds."""

from __future__ import annotations

from typing import Final

import numpy as np

from deepaccident_devkit.arrays import BoolArray
from deepaccident_devkit.statistics.results import CountTable, Histogram, LeftOut, QuantileTable
from deepaccident_devkit.statistics.selected import Selected
from deepaccident_devkit.statistics.tally import LEFT_OUT, Tally
from deepaccident_devkit.taxonomy import CATEGORIES, OWN_ACTOR_ID, STATIC_ACTOR_ID

_DISTANCE_EDGES = tuple(range(0, 101, 5))
_SPEED_EDGES = tuple(range(21))
_ACTOR_EDGES = tuple(range(0, 201, 10))
_SIZES: Final = ("length", "width", "height")
_COUNTED: Final = {
    ("instances", "Instances"): "instances",
    ("parked_instances", "Parked instances"): "instances",
    ("annotations", "Annotations"): "annotations",
}
"""Name and title of a table of counts → what it counts."""


def count_actors(selected: Selected, tally: Tally) -> None:
    """Count instances, parked ones among them, and annotations by category; actors of each labelled scenario."""
    category, group = selected.column("instance", "category"), selected.group("instance")
    parked = selected.column("instance", "actor_id") >= STATIC_ACTOR_ID
    tally.count_words("instances", CATEGORIES, category, group)
    tally.count_words("parked_instances", CATEGORIES, category[parked], group[parked])
    tally.count_words("annotations", CATEGORIES, selected.column("annotation", "category"), selected.annotation_group)
    numbers = np.bincount(selected.column("instance", "scenario_row"), minlength=len(selected.scenario_group))
    labelled = selected.labelled
    tally.count_bins("actors", numbers[labelled].astype(np.float64), selected.scenario_group[labelled], _ACTOR_EDGES)
    tally.count("unlabelled", selected.scenario_group[~labelled])


def count_boxes(selected: Selected, tally: Tally) -> None:
    """Count annotations: sizes of all, and horizontal distances from their agent of all but its own box."""
    categories, sizes = selected.column("annotation", "category"), selected.column("annotation", "size")
    x, y = selected.column("annotation", "translation")[:, :2].T
    distances, of_all = np.hypot(x, y), selected.annotation_group
    of_others = np.where(selected.column("annotation", "actor_id") != OWN_ACTOR_ID, of_all, np.int8(-1))
    tally.count_bins("distances", distances, of_others, _DISTANCE_EDGES)
    for code, name in enumerate(CATEGORIES):
        rows = np.flatnonzero(categories == code)
        for axis, field in enumerate(_SIZES):
            tally.add_values("box_sizes", field, name, sizes[rows, axis], of_all[rows])
        tally.add_values("distance_quantiles", "distance", name, distances[rows], of_others[rows])


def count_speeds(selected: Selected, tally: Tally) -> None:
    """Count horizontal speeds of actors that are not parked, once an actor and moment, by the labels' velocities."""
    parked = selected.column("instance", "actor_id") >= STATIC_ACTOR_ID
    x, y = selected.column("track", "velocity")[:, :2].T
    speeds, categories = np.hypot(x, y), selected.column("track", "category")
    known: BoolArray = np.isfinite(speeds)
    groups = np.where(parked[selected.column("track", "instance_row")], np.int8(-1), selected.group("track"))
    tally.count_bins("speeds", speeds[known], groups[known], _SPEED_EDGES)
    tally.count("speeds", groups[~known], LEFT_OUT)
    for code, name in enumerate(CATEGORIES):
        rows = np.flatnonzero(known & (categories == code))
        tally.add_values("speed_quantiles", "speed", name, speeds[rows], groups[rows])


def unlabelled(tally: Tally) -> LeftOut:
    """The scenarios without any label."""
    return LeftOut(what="scenarios without labels", counts=tally.by_group("unlabelled"))


def actor_counts(tally: Tally) -> list[CountTable]:
    """Instances, parked ones among them, and annotations, by category."""
    return [
        CountTable(
            name=name,
            title=title,
            field="category",
            counted=counted,
            counts=tally.by_word(name, CATEGORIES),
            left_out=unlabelled(tally),
        )
        for (name, title), counted in _COUNTED.items()
    ]


def actors(tally: Tally) -> Histogram:
    """Actors (instances) of each labelled scenario."""
    counts, outside = tally.by_bin("actors", _ACTOR_EDGES)
    return Histogram(
        name="actors",
        title="Actors a scenario",
        field="actors",
        unit="actors",
        counted="scenarios",
        edges=_ACTOR_EDGES,
        counts=counts,
        outside=outside,
        left_out=unlabelled(tally),
    )


def box_sizes(tally: Tally) -> QuantileTable:
    """Length, width and height of all annotations, by category."""
    rows = [row for name in CATEGORIES for field in _SIZES for row in tally.quantiles("box_sizes", field, name)]
    return QuantileTable(
        name="box_sizes",
        title="Sizes of boxes",
        unit="m",
        counted="annotations",
        quantiles=tuple(rows),
        left_out=unlabelled(tally),
    )


def distances(tally: Tally) -> tuple[Histogram, QuantileTable]:
    """Horizontal distances of annotated boxes from the LiDAR of their agent; its own box does not count."""
    names = ("distances", "Distance from the agent", "distance", "m")
    return _distribution(tally, names, "annotations of others", _DISTANCE_EDGES, unlabelled(tally))


def speeds(tally: Tally) -> tuple[Histogram, QuantileTable]:
    """Horizontal speeds of actors that are not parked, once an actor and moment, by the labels' velocities."""
    what = "moments of actors whose label has no velocity, and that no agent saw in the frame before or after"
    left_out = LeftOut(what=what, counts=tally.by_group("speeds", LEFT_OUT))
    names = ("speeds", "Speed of actors that are not parked", "speed", "m/s")
    return _distribution(tally, names, "moments of actors", _SPEED_EDGES, left_out)


def _distribution(
    tally: Tally, names: tuple[str, str, str, str], counted: str, edges: tuple[int, ...], left_out: LeftOut
) -> tuple[Histogram, QuantileTable]:
    """A number's histogram over all categories and its quantiles by category.

    Args:
        tally: of the release.
        names: name of the histogram, title, field, unit.
        counted: what the values belong to.
        edges: the histogram's.
        left_out: what has no value.
    """
    name, title, field, unit = names
    counts, outside = tally.by_bin(name, edges)
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
    table = f"{field}_quantiles"
    quantiles = QuantileTable(
        name=table,
        title=title,
        unit=unit,
        counted=counted,
        quantiles=tuple(row for category in CATEGORIES for row in tally.quantiles(table, field, category)),
        left_out=left_out,
    )
    return histogram, quantiles
