"""The evidence of a sample for and against ways in which predictions may be wrong as a whole.

A suspicion is tried by correcting the predictions as if it were true. If it is, they then fit the truth, and not as
they were given. Each has its own measure: a share of cells or of actors, for both readings.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal, get_args

import numpy as np

from deepaccident_devkit.arrays import AnyArray, BoolArray, FloatArray, ShortRepr
from deepaccident_devkit.evaluation.metrics.evaluator import Counts
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS, Orientation, turned

Group = Literal[
    "channels",
    "place",
    "time",
    "size",
    "height",
    "heading",
    "velocity",
    "score",
    "exchange",
    "offset",
    "flow",
]
MARGIN: Final = 2.0
"""The least advantage of most suspicions over the predictions as given."""
_AFTER_PLACES: Final[frozenset[Group]] = frozenset(get_args(Group)) - {"channels", "place"}
_HIDES: Final[Mapping[Group, frozenset[Group]]] = {
    "channels": _AFTER_PLACES | {"place"},
    "place": _AFTER_PLACES,
    "exchange": frozenset({"offset", "flow"}),
}
"""Group → the groups that are not checked if one of its suspicions is raised."""
SCALES: Final[Mapping[str, float]] = {f"scaled by {scale:g}": scale for scale in (0.5, 0.8, 1.25, 2.0)}
"""Name → how many times too far from the ego all is; cell sizes of 0.25, 0.4, 0.625 and 1 m for 0.5 m."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Suspicion:
    """A way in which predictions may be wrong as a whole.

    Attributes:
        name: short: `mirrored y`, `one step late`.
        group: of those that exclude one another; the best of a group is told.
        says: what is wrong then, a clause.
        remedy: what to do about it, a clause.
        measure: what the scores are.
        least: the score that it has to reach.
        evidence: of how many cells, actors, samples or metres at least: the whole of the tallies.
        also: names of further tallies in which it has to fit better than as given.
        margin: by how much it has to fit better than as given.
        deviations: by how many standard deviations of a coin's tosses it fits more often than as given; 0 for any.
        chance: the score that predictions at random have, told in place of the one as given; None to tell that one.
    """

    name: str
    group: Group
    says: str
    remedy: str
    measure: str
    least: float
    evidence: float
    also: tuple[str, ...] = ()
    margin: float = MARGIN
    deviations: float = 0.0
    chance: float | None = None


def tally(
    part: float, whole: float, given_part: float, given_whole: float | None = None, misfit: float = 0.0
) -> list[float]:
    """What a sample says of a suspicion: part of the whole that fits so; the same as given; and how badly it fits."""
    return [part, whole, given_part, whole if given_whole is None else given_whole, misfit]


def nearer_tally(before: FloatArray, after: FloatArray, change: FloatArray, misfit: float = 0.0) -> list[float]:
    """What points say of a suspicion by how much nearer they are then to where they should be.

    Args:
        before: (N,) distances of the points found from the true ones.
        after: (N,) distances of the points found from where the true ones would be found.
        change: (N,) how far apart these two are, at most the sum of the other two: what a point counts.
        misfit: how badly the suspicion fits.

    Returns:
        A tally in which a point half way counts half for and half against.
    """
    part = float((change + np.clip(before - after, -change, change)).sum()) / 2
    whole = float(change.sum())
    return tally(part, whole, whole - part, misfit=misfit)


def overlap(predicted: BoolArray, true: BoolArray, where: BoolArray) -> tuple[int, int]:
    """Cells of the intersection and of the union, of some cells."""
    both = int(np.count_nonzero(predicted & true & where))
    return both, int(np.count_nonzero((predicted | true) & where))


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate(ShortRepr):
    """How well predictions fit the truth if one thing were wrong with all of them.

    Attributes:
        name: of the suspicion.
        description: what is wrong then, and what to do about it.
        score: in [0, 1], of the predictions set right; None where no sample tells.
        given: the same of the predictions as they were given.
        suspected: whether the score is so much better that it should be looked into.
    """

    name: str
    description: str
    score: float | None
    given: float | None
    suspected: bool


def candidates_of(suspicions: Iterable[Suspicion], samples: Iterable[Mapping[str, Any]]) -> tuple[Candidate, ...]:
    """All that was looked for, of the tallies of samples by the suspicions' names.

    At most one of a group is suspected: the one that the predictions fit best. Groups that hide others (`_HIDES`) come
    first: predictions at other places tell nothing of when.
    """
    every = list(samples)
    sums = {each.name: _sum(each.name, every) for each in suspicions}
    by_group: dict[str, list[Suspicion]] = {}
    for each in suspicions:
        if _is_suspected(each, sums[each.name]) and all(_fits_better(_sum(name, every)) for name in each.also):
            by_group.setdefault(each.group, []).append(each)
    best = {
        group: min(among, key=lambda each: (sums[each.name][4], -(_share(*sums[each.name][:2]) or 0.0))).name
        for group, among in by_group.items()
    }
    for group, hidden in _HIDES.items():
        if group in best:
            best = {each: name for each, name in best.items() if each not in hidden}
    return tuple(
        Candidate(
            name=each.name,
            description=f"{each.says}; remedy: {each.remedy}",
            score=_share(*sums[each.name][:2]),
            given=_share(*sums[each.name][2:4]),
            suspected=best.get(each.group) == each.name,
        )
        for each in suspicions
    )


def scale_says(scale: float) -> str:
    """What is wrong if all is so many times as far away: a clause."""
    return f"everything is {scale:g} times as far from the agent as it should be"


def percent(share: float) -> str:
    """A share in percent for people: `99 %`, `0.3 %`."""
    return f"{100 * share:.2g} %" if share < 0.995 else f"{100 * share:.0f} %"


def warning_of(suspicion: Suspicion, candidate: Candidate) -> str:
    """A sentence for a candidate that is suspected."""
    score = f"{candidate.score or 0.0:.2f}"
    if suspicion.chance is None:
        scores = f"{score} if this is corrected, {candidate.given or 0.0:.2f} as given"
    else:
        scores = f"{score}, and {suspicion.chance:.2f} is chance"
    return f"{suspicion.name}: it looks as if {candidate.description} ({suspicion.measure}: {scores})"


def _sum(name: str, samples: Iterable[Counts]) -> list[float]:
    rows = [each[name] for each in samples if name in each]
    return [math.fsum(column) for column in zip(*rows, strict=True)] if rows else [0.0] * 5


def _is_suspected(suspicion: Suspicion, sums: list[float]) -> bool:
    score, given = _share(*sums[:2]), _share(*sums[2:4]) or 0.0
    enough = sums[1] >= suspicion.evidence
    if suspicion.deviations:
        enough &= sums[0] - sums[2] >= suspicion.deviations * math.sqrt(sums[1])
    return enough and score is not None and score >= suspicion.least and score >= suspicion.margin * given


def _fits_better(sums: list[float]) -> bool:
    return (_share(*sums[:2]) or 0.0) > (_share(*sums[2:4]) or 0.0)


def _share(part: float, whole: float) -> float | None:
    return part / whole if whole else None


@dataclass(frozen=True, slots=True)
class Symmetry:
    """A point x forward, y left of the truth is found at x_sign · x, y_sign · y, or with x and y swapped before that.

    Attributes:
        name: `mirrored x`, `turned by 90°`, …
        says: what one sees then.
        swapped: whether x and y change places.
        x_sign: 1 or −1.
        y_sign: 1 or −1.
    """

    name: str
    says: str
    swapped: bool
    x_sign: int
    y_sign: int

    @property
    def matrix(self) -> FloatArray:
        """(2, 2) from true to found, of columns x, y."""
        x, y = float(self.x_sign), float(self.y_sign)
        return np.array([[0.0, x], [y, 0.0]] if self.swapped else [[x, 0.0], [0.0, y]])

    def apply(self, points: FloatArray) -> FloatArray:
        """Points (…, 2) where they are found."""
        result: FloatArray = points @ self.matrix.T
        return result

    def undo(self, points: FloatArray) -> FloatArray:
        """Points (…, 2) as found, where they should be."""
        result: FloatArray = points @ self.matrix
        return result

    def undo_raster(self, raster: AnyArray) -> AnyArray:
        """A raster (…, rows, columns) in the devkit's orientation as found, with each cell where it should be."""
        flipped = raster[..., :: self.y_sign, :: self.x_sign]
        return flipped.swapaxes(-1, -2) if self.swapped else flipped


IDENTITY: Final = Symmetry("as given", "", swapped=False, x_sign=1, y_sign=1)
SYMMETRIES: Final = (
    Symmetry("mirrored x", "what is ahead is behind", swapped=False, x_sign=-1, y_sign=1),
    Symmetry("mirrored y", "what is on the left is on the right", swapped=False, x_sign=1, y_sign=-1),
    Symmetry("transposed", "x and y are swapped", swapped=True, x_sign=1, y_sign=1),
    Symmetry("anti-transposed", "x and y are swapped and negated", swapped=True, x_sign=-1, y_sign=-1),
    Symmetry("turned by 90°", "what is ahead is on the left", swapped=True, x_sign=-1, y_sign=1),
    Symmetry("turned by 180°", "what is ahead on the left is behind on the right", swapped=False, x_sign=-1, y_sign=-1),
    Symmetry("turned by 270°", "what is ahead is on the right", swapped=True, x_sign=1, y_sign=-1),
)
"""All but the one that changes nothing; turns are counter-clockwise, seen from above."""
_PATTERN: Final = np.arange(4).reshape(2, 2)
"""The smallest raster that no symmetry leaves as it is."""


def orientation_mistaken(symmetry: Symmetry, stated: Orientation) -> Orientation | None:
    """The orientation that maps must be in to look like this where another one is stated; None if there is none."""
    found = turned(_PATTERN, stated)
    for other in ORIENTATIONS:
        if other != stated and np.array_equal(symmetry.undo_raster(found), turned(_PATTERN, other)):
            return other
    return None
