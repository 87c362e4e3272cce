"""Whether the agents' recordings agree on an actor that several see at one moment (centimetres, degrees)."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from deepaccident_devkit.arrays import AnyArray, BoolArray, FloatArray, IntArray
from deepaccident_devkit.tables import Finding
from deepaccident_devkit.taxonomy import UNTRACKED_ID
from deepaccident_devkit.validation.subject import Subject, actors_text, frames_text, near_pairs

POSITION = 0.05
"""Metres between two agents' views of an actor."""
HEADING = np.radians(5.0)
SIZE = 0.02
"""Metres between two agents' sizes of an actor."""
OWN_APART = 0.6
"""Metres between an agent's own row and where others see it; the real ones reach 0.3."""
_ITSELF = 3.0
"""Metres around an agent's origin in which others see the agent itself."""
SAME_PLACE = 0.1
"""Metres within which boxes of two agents are the same thing; different ids then contradict."""


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Every actor at every moment (K of them), as each agent (A) annotated it from outside; NaN and −1 where not.

    Attributes:
        actor: (K,) actor ids.
        frame: (K,) frame numbers.
        center: (K, A, 3) world, metres.
        yaw: (K, A) world, radians.
        size: (K, A, 3) metres.
        category: (K, A) codes.
    """

    actor: IntArray
    frame: IntArray
    center: FloatArray
    yaw: FloatArray
    size: FloatArray
    category: AnyArray


def check_agreement(subject: Subject) -> Iterator[Finding]:
    """Compare the agents' views of the same actors, pair by pair."""
    views = _views(subject)
    for first, second in combinations(range(len(subject.agents)), 2):
        yield from _compare(subject, views, first, second)
    yield from _own_rows(subject, views)
    yield from _missing_actors(subject, views)
    yield from _ids(subject)


def _views(subject: Subject) -> Views:
    boxes, rows = subject.boxes, np.flatnonzero(subject.seen)
    moments, moment = np.unique(
        np.column_stack([boxes.actor[rows], boxes.frame[rows]]).reshape(-1, 2), axis=0, return_inverse=True
    )
    place = (moment.reshape(-1), boxes.agent[rows])
    shape = (len(moments), len(subject.agents))
    views = Views(
        actor=moments[:, 0],
        frame=moments[:, 1],
        center=np.full((*shape, 3), np.nan),
        yaw=np.full(shape, np.nan),
        size=np.full((*shape, 3), np.nan),
        category=np.full(shape, -1, dtype=np.int8),
    )
    views.center[place] = subject.centers[rows]
    views.yaw[place] = subject.yaw[rows]
    views.size[place] = boxes.labels.size[rows]
    views.category[place] = boxes.labels.category[rows]
    return views


def _compare(subject: Subject, views: Views, first: int, second: int) -> Iterator[Finding]:
    where = f"{subject.token}: {subject.agents[first]} and {subject.agents[second]}"
    apart = np.linalg.norm(views.center[:, first] - views.center[:, second], axis=1)
    turned = np.abs(_wrapped(views.yaw[:, first] - views.yaw[:, second]))
    grown = np.abs(views.size[:, first] - views.size[:, second]).max(axis=1)
    both = np.isfinite(apart)
    for code, values, limit, unit in (
        ("positions-differ", apart, POSITION, "{:.2f} m apart"),
        ("headings-differ", np.degrees(turned), np.degrees(HEADING), "turned by {:.0f}°"),
        ("sizes-differ", grown, SIZE, "sizes {:.2f} m apart"),
    ):
        bad = both & (values > limit)
        if bad.any():
            yield subject.finding(code, where, _worst(views, bad, values, both, unit))
    other_class = both & (views.category[:, first] != views.category[:, second])
    if other_class.any():
        what = f"{actors_text(views.actor[other_class])}, {frames_text(views.frame[other_class])}"
        yield subject.finding("classes-differ", where, what)


def _worst(views: Views, bad: BoolArray, values: FloatArray, both: BoolArray, unit: str) -> str:
    worst = int(np.argmax(np.where(bad, values, -1)))
    share = bad.sum() / both.sum()
    return (
        f"{actors_text(views.actor[bad])} in {frames_text(views.frame[bad])} ({share:.0%} of what both see), worst "
        f"actor {views.actor[worst]} at frame {views.frame[worst]}: {unit.format(values[worst])}"
    )


def _own_rows(subject: Subject, views: Views) -> Iterator[Finding]:
    """Each agent's own row against what the others see of the actor that meta says it is."""
    key = {moment: index for index, moment in enumerate(zip(views.actor.tolist(), views.frame.tolist(), strict=True))}
    rows = np.flatnonzero(subject.own & (subject.boxes.actor != UNTRACKED_ID))
    moments = zip(subject.boxes.actor[rows].tolist(), subject.boxes.frame[rows].tolist(), strict=True)
    pairs = [(row, key[moment]) for row, moment in zip(rows.tolist(), moments, strict=True) if moment in key]
    if not pairs:
        return
    own, seen = np.array(pairs).T
    apart = np.linalg.norm(subject.centers[own, None] - views.center[seen], axis=2)
    far = np.nanmin(apart, axis=1)
    bad = subject.mask(own[far > OWN_APART])
    seen_size = np.nanmedian(views.size[seen], axis=1)
    other_size = np.abs(subject.boxes.labels.size[own] - seen_size).max(axis=1) > SIZE
    for agent, picked in subject.rows_by_agent(subject.mask(own[other_size])):
        what = f"the own row has another size than others see, {frames_text(subject.boxes.frame[picked])}"
        yield subject.finding("sizes-differ", subject.label_where(agent), what)
    for agent, picked in subject.rows_by_agent(bad):
        what = (
            f"others see actor {subject.boxes.actor[picked[0]]}, which meta says it is, up to "
            f"{far[np.isin(own, picked)].max():.2f} m away in {frames_text(subject.boxes.frame[picked])}"
        )
        yield subject.finding("own-box-apart", subject.label_where(agent), what)


def _missing_actors(subject: Subject, views: Views) -> Iterator[Finding]:
    """Near actors that others annotate and one agent lacks, although its labels are complete (`Subject.reach`)."""
    there = np.isfinite(views.center[..., 0])
    place = np.nanmean(views.center, axis=1)
    for agent, reach in enumerate(subject.reach.tolist()):
        if subject.agents[agent] not in subject.files.scan.labelled:
            continue
        distance = np.linalg.norm(place[:, :2] - subject.positions[agent][views.frame - 1, :2], axis=1)
        expected = (distance < reach) & (distance > _ITSELF)
        missing = np.flatnonzero(expected & ~there[:, agent])
        missing = missing[~subject.has_untracked(agent, views.frame[missing], place[missing])]
        if len(missing):
            what = f"others see {actors_text(views.actor[missing])} within {reach:.0f} m"
            where = subject.label_where(agent)
            yield subject.finding("actor-missing", where, f"{what}, {frames_text(views.frame[missing])}")


def _ids(subject: Subject) -> Iterator[Finding]:
    """Boxes of two agents in the same place at the same moment that carry different ids."""
    boxes = subject.boxes
    rows = np.flatnonzero(subject.seen | (subject.own & (boxes.actor != UNTRACKED_ID)))
    near_ones, _ = near_pairs(subject.centers[rows], boxes.frame[rows], OWN_APART)
    first, second = rows[near_ones].T
    differ = (boxes.actor[first] != boxes.actor[second]) & (boxes.agent[first] != boxes.agent[second])
    first, second = first[differ], second[differ]
    near = np.linalg.norm(subject.centers[first] - subject.centers[second], axis=1) < SAME_PLACE
    alike = boxes.labels.category[first] == boxes.labels.category[second]
    near |= (subject.own[first] | subject.own[second]) & alike  # an own row lies up to 0.3 m off
    first, second = first[near], second[near]
    pairs = np.sort(np.column_stack([boxes.agent[first], boxes.agent[second]]), axis=1)
    for agent, other in np.unique(pairs, axis=0).tolist():
        of_pair = (pairs == (agent, other)).all(axis=1)
        actors = np.concatenate([boxes.actor[first[of_pair]], boxes.actor[second[of_pair]]])
        where = f"{subject.token}: {subject.agents[agent]} and {subject.agents[other]}"
        what = f"{actors_text(actors)} stand in the same places, {frames_text(boxes.frame[first[of_pair]])}"
        yield subject.finding("ids-differ", where, what)


def _wrapped(angle: FloatArray) -> FloatArray:
    """Angles in (−π, π]."""
    return np.arctan2(np.sin(angle), np.cos(angle))
