"""Who is matched with whom: three greedy rules over the pairs that are near enough, of one sample.

A *candidate* is a detection within the problem of one class; `Reach` has those that are near enough to any true box,
in descending order of their scores (equal ones in the order given), each with the true boxes that it reaches, in the
order given, and the pair's rank: of two pairs that compete the lower wins. No two ranks are equal.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

Reach = Mapping[int, Sequence[tuple[int, int]]]
"""Candidate → (true box, rank) of the pairs that are near enough."""
_NOBODY: Final = -1


@dataclass(slots=True)
class Steps:
    """How matches come about while the score that is asked for falls: whose arrival changes which count.

    Attributes:
        tp: candidates on whose arrival one more true box has a detection, both of which count.
        spent: those on whose arrival one more detection that counts goes to a true box that does not.
        excused: those on whose arrival a true box that counts gets a detection that does not (+1) or gets rid of it
            (−1): it is neither found nor missed.
        holder: true box → the candidate that it has once all have arrived.
    """

    tp: list[int] = field(default_factory=list)
    spent: list[int] = field(default_factory=list)
    excused: list[tuple[int, int]] = field(default_factory=list)
    holder: dict[int, int] = field(default_factory=dict)

    def note(self, arriving: int, changes: Sequence[int]) -> None:
        """Take what an arrival changed: found, spent, excused (and pairs of which neither counts)."""
        found, spent, excused, _ = changes
        if found:
            self.tp.append(arriving)
        if spent:
            self.spent.append(arriving)
        if excused:
            self.excused.append((arriving, excused))


def nearest_by_truth(reach: Reach, counts: Mapping[int, bool], truth_counts: Sequence[bool]) -> Steps:
    """Each true box in turn takes the candidate of the lowest rank that is left, for every score at once.

    A candidate that arrives is offered to the true boxes in their order. The first that has none or ranks it lower
    takes it and hands what it had on to those behind it: that is just what matching anew with one candidate more gives,
    since those before it would not have taken what it hands on.

    Args:
        reach: the pairs.
        counts: whether each candidate counts, or is there to be matched alone.
        truth_counts: whether each true box does.
    """
    steps, ranks = Steps(), dict[int, int]()
    for arriving in reach:
        # pairs of which both count, of which the truth does not, the candidate does not, neither does
        changes = [0, 0, 0, 0]
        offered: int | None = arriving
        behind = _NOBODY
        while offered is not None:
            behind, rank = _taker(reach[offered], behind, ranks)
            if behind == _NOBODY:
                break
            handed_on = steps.holder.get(behind)
            steps.holder[behind], ranks[behind] = offered, rank
            for candidate, change in ((offered, 1), (handed_on, -1)):
                if candidate is not None:
                    changes[2 * (not counts[candidate]) + (not truth_counts[behind])] += change
            offered = handed_on
        if any(changes):
            steps.note(arriving, changes)
    return steps


def _taker(pairs: Sequence[tuple[int, int]], behind: int, ranks: Mapping[int, int]) -> tuple[int, int]:
    """The first true box after `behind` that takes a candidate with these pairs, and their rank."""
    for truth, rank in pairs:
        if truth > behind and ranks.get(truth, rank) >= rank:
            return truth, rank
    return _NOBODY, 0


def highest_score_by_truth(reach: Reach) -> dict[int, int]:
    """Each true box in turn takes the candidate with the highest score that is left: true box → candidate."""
    wanted: dict[int, list[int]] = {}
    for candidate, pairs in reach.items():
        for truth, _ in pairs:
            wanted.setdefault(truth, []).append(candidate)
    taken: set[int] = set()
    result: dict[int, int] = {}
    for truth in sorted(wanted):
        for candidate in wanted[truth]:
            if candidate not in taken:
                taken.add(candidate)
                result[truth] = candidate
                break
    return result


def nearest_by_score(reach: Reach) -> dict[int, int]:
    """Each candidate in turn takes the true box of the lowest rank that is left: true box → candidate."""
    result: dict[int, int] = {}
    for candidate, pairs in reach.items():
        free = [(rank, truth) for truth, rank in pairs if truth not in result]
        if free:
            result[min(free)[1]] = candidate
    return result
