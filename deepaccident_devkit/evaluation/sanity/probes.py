"""What a sample says for and against the ways in which predictions may be wrong as a whole.

A suspicion is tried by setting the predictions right as though it were true. Where it is, they fit the truth then, and
not as they were given. Each tells of its own: a share of cells or of actors, of both readings.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import fsum
from typing import Any, Final, Literal

from deepaccident_devkit.evaluation.evaluator import Counts

Group = Literal["place", "time", "size", "heading", "offset", "flow"]
MARGIN: Final = 2.0
"""By how much a suspicion has to beat the predictions as they were given."""
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
        evidence: of how many cells, actors or samples at least.
        also: names of further tallies in which it has to fit better than as given.
    """

    name: str
    group: Group
    says: str
    remedy: str
    measure: str
    least: float
    evidence: int
    also: tuple[str, ...] = ()


def tally(
    part: float, whole: float, given_part: float, given_whole: float | None = None, misfit: float = 0.0
) -> list[float]:
    """What a sample says of a suspicion: part of the whole that fits so; the same as given; and how badly it fits."""
    return [part, whole, given_part, whole if given_whole is None else given_whole, misfit]


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
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

    At most one of a group is suspected: the one that the predictions fit best. Times are looked at only where places
    are right: predictions at other places tell nothing of when.
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
    if "place" in best:
        best = {"place": best["place"]}
    return tuple(
        Candidate(
            name=each.name,
            description=f"{each.says}; {each.remedy}",
            score=_share(*sums[each.name][:2]),
            given=_share(*sums[each.name][2:4]),
            suspected=best.get(each.group) == each.name,
        )
        for each in suspicions
    )


def scale_says(scale: float) -> str:
    """What is wrong if all is so many times as far away: a clause."""
    return f"all is {scale:g} times as far from the agent as it should be"


def warning_of(suspicion: Suspicion, candidate: Candidate) -> str:
    """A sentence for a candidate that is suspected."""
    return (
        f"{suspicion.name}: it looks as though {candidate.description} ({suspicion.measure} "
        f"{candidate.score or 0.0:.2f} if so, {candidate.given or 0.0:.2f} as given)"
    )


def _sum(name: str, samples: Iterable[Counts]) -> list[float]:
    rows = [each[name] for each in samples if name in each]
    return [fsum(column) for column in zip(*rows, strict=True)] if rows else [0.0] * 5


def _is_suspected(suspicion: Suspicion, sums: list[float]) -> bool:
    score, given = _share(*sums[:2]), _share(*sums[2:4]) or 0.0
    enough = sums[1] >= suspicion.evidence
    return enough and score is not None and score >= suspicion.least and score >= MARGIN * given


def _fits_better(sums: list[float]) -> bool:
    return (_share(*sums[:2]) or 0.0) > (_share(*sums[2:4]) or 0.0)


def _share(part: float, whole: float) -> float | None:
    return part / whole if whole else None
