"""Whether the classes of detected boxes have changed places: cars called trucks, all counted from 1, another order."""

from __future__ import annotations

from typing import Final

import numpy as np

from deepaccident_devkit.arrays import IntArray
from deepaccident_devkit.evaluation.metrics.detection import DetectedBoxes
from deepaccident_devkit.evaluation.runs.sanity.pairs import NEAR
from deepaccident_devkit.evaluation.runs.sanity.probes import MARGIN, Candidate, percent
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.taxonomy import CATEGORIES, OWN_ACTOR_ID

_NAME: Final = "classes swapped"
_FEWEST: Final = 5
"""Boxes found of a class from which on it tells."""
_LEAST: Final = 0.5
"""Share of a class that has to have one other class's name."""
_MOST: Final = 0.5
"""Share of all boxes that a single class has to be, if it alone has another name."""
_OWN: Final = 1e-3
"""The bonus of a class's own name, so that a class that is never detected keeps it."""


def class_names(found: DetectedBoxes, truth: Boxes) -> IntArray:
    """(C, C) int64 how many true boxes of each class (rows) are found under the name of each (columns)."""
    others = truth.select(truth.actor_id != OWN_ACTOR_ID)
    names = np.zeros((len(CATEGORIES), len(CATEGORIES)), dtype=np.int64)
    if len(found) and len(others):
        apart = np.linalg.norm(others.center[:, None, :2] - found.boxes.center[:, :2], axis=-1)
        near = apart.min(axis=1) < NEAR
        np.add.at(names, (others.category[near], found.boxes.category[apart.argmin(axis=1)[near]]), 1)
    return names


def class_candidate(names: IntArray) -> Candidate:
    """The one exchange of names that explains most of what is found.

    It is suspected if each class that it changes has mostly the other's name, and these are several classes or most
    boxes: a detector that takes all trucks for vans is no mistake of order.

    Args:
        names: (C, C) as `class_names` counts them, of all samples.
    """
    from scipy.optimize import linear_sum_assignment

    number = names.sum(axis=1)
    share = names / np.maximum(number, 1)[:, None]
    _, other = linear_sum_assignment(share + _OWN * np.eye(len(names)), maximize=True)
    changed = np.flatnonzero((other != np.arange(len(names))) & (number >= _FEWEST))
    whole = int(number[changed].sum())
    given = int(names[changed, changed].sum())
    named = int(names[changed, other[changed]].sum())
    telling = len(changed) > 1 or whole >= _MOST * number.sum()
    mostly = bool((share[changed, other[changed]] >= _LEAST).all())
    mapping = ", ".join(f"{CATEGORIES[one]} is called {CATEGORIES[other[one]]}" for one in changed)
    order = f"the classes are, in this order, {', '.join(CATEGORIES)}, counted from 0"
    return Candidate(
        name=_NAME,
        description=f"{mapping or 'classes are swapped'}; {order}",
        score=named / whole if whole else None,
        given=given / whole if whole else None,
        suspected=bool(whole and telling and mostly and named >= MARGIN * given),
    )


def class_warning(candidate: Candidate) -> str:
    """A sentence for the candidate if it is suspected."""
    return (
        f"{candidate.name}: {candidate.description} ({percent(candidate.score or 0.0)} of these boxes have that name, "
        f"{percent(candidate.given or 0.0)} their own)"
    )
