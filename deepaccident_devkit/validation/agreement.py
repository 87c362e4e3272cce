"""Checks of what several files say of one thing: agents of each other, and the story of meta and labels."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from deepaccident_devkit.errors import shortened
from deepaccident_devkit.geometry.box_arrays import gaps, signed_gaps
from deepaccident_devkit.release import Collision, Meta
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, IntArray
from deepaccident_devkit.tables import Finding
from deepaccident_devkit.taxonomy import (
    CATEGORIES,
    CONTACT_SIDES,
    DIRECTIONS,
    META_AGENTS,
    ROAD_TYPES,
    SPAWN_RELATIONS,
    SPAWN_SIDES,
    UNKNOWN_ID,
    UNTRACKED_ID,
    VEHICLE_AGENTS,
    WEATHERS,
)
from deepaccident_devkit.v2x.agents import SHEER_CURTAINS
from deepaccident_devkit.v2x.collisions import CONTACT_GAP
from deepaccident_devkit.validation.subject import Subject, actors_text, frames_text, near_pairs

POSITION = 0.05
"""Metres between two agents' views of an actor."""
HEADING = np.radians(5.0)
# Metres between two agents' sizes of an actor.
_SIZE_TOLERANCE = 0.02
OWN_APART = 0.6
"""Metres between an agent's own row and where others see it; the real ones reach 0.3."""
# Metres around an agent's origin in which others see the agent itself.
_ITSELF = 3.0
SAME_PLACE = 0.1
"""Metres within which boxes of two agents are the same thing; different ids then contradict."""
# Metres between the centres of two whose boxes can overlap.
_NEAR = 10.0
# Metres that a mover goes in a frame, at least.
_STEP = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class _ActorViews:
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
    yield from _overlaps(subject, views)


def _views(subject: Subject) -> _ActorViews:
    boxes, rows = subject.boxes, np.flatnonzero(subject.seen)
    moments, moment = np.unique(
        np.column_stack([boxes.actor[rows], boxes.frame[rows]]).reshape(-1, 2),
        axis=0,
        return_inverse=True,
    )
    place = (moment.reshape(-1), boxes.agent[rows])
    shape = (len(moments), len(subject.agents))
    views = _ActorViews(
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


def _compare(subject: Subject, views: _ActorViews, first: int, second: int) -> Iterator[Finding]:
    where = f"{subject.token}: {subject.agents[first]} and {subject.agents[second]}"
    apart = np.linalg.norm(views.center[:, first] - views.center[:, second], axis=1)
    turned = np.abs(_wrapped(views.yaw[:, first] - views.yaw[:, second]))
    grown = np.abs(views.size[:, first] - views.size[:, second]).max(axis=1)
    both = np.isfinite(apart)
    for code, values, limit, unit in (
        ("positions-differ", apart, POSITION, "{:.2f} m apart"),
        ("headings-differ", np.degrees(turned), np.degrees(HEADING), "turned by {:.0f}°"),
        ("sizes-differ", grown, _SIZE_TOLERANCE, "sizes {:.2f} m apart"),
    ):
        bad = both & (values > limit)
        if bad.any():
            yield subject.finding(code, where, _worst(views, bad, values, both, unit))
    other_class = both & (views.category[:, first] != views.category[:, second])
    if other_class.any():
        what = f"{actors_text(views.actor[other_class])}, {frames_text(views.frame[other_class])}"
        yield subject.finding("classes-differ", where, what)


def _worst(
    views: _ActorViews, bad: BoolArray, values: FloatArray, both: BoolArray, unit: str
) -> str:
    worst = int(np.argmax(np.where(bad, values, -1)))
    share = bad.sum() / both.sum()
    return (
        f"{actors_text(views.actor[bad])} in {frames_text(views.frame[bad])} ({share:.0%} of what both see), worst "
        f"actor {views.actor[worst]} at frame {views.frame[worst]}: {unit.format(values[worst])}"
    )


def _own_rows(subject: Subject, views: _ActorViews) -> Iterator[Finding]:
    """Each agent's own row against what the others see of the actor that meta says it is."""
    key = {
        moment: index
        for index, moment in enumerate(zip(views.actor.tolist(), views.frame.tolist(), strict=True))
    }
    rows = np.flatnonzero(subject.own & (subject.boxes.actor != UNTRACKED_ID))
    moments = zip(
        subject.boxes.actor[rows].tolist(), subject.boxes.frame[rows].tolist(), strict=True
    )
    pairs = [
        (row, key[moment])
        for row, moment in zip(rows.tolist(), moments, strict=True)
        if moment in key
    ]
    if not pairs:
        return
    own, seen = np.array(pairs).T
    apart = np.linalg.norm(subject.centers[own, None] - views.center[seen], axis=2)
    far = np.nanmin(apart, axis=1)
    bad = subject.mask(own[far > OWN_APART])
    seen_size = np.nanmedian(views.size[seen], axis=1)
    other_size = np.abs(subject.boxes.labels.size[own] - seen_size).max(axis=1) > _SIZE_TOLERANCE
    for agent, picked in subject.rows_by_agent(subject.mask(own[other_size])):
        what = f"the own row has another size than others see, {frames_text(subject.boxes.frame[picked])}"
        yield subject.finding("sizes-differ", subject.label_where(agent), what)
    for agent, picked in subject.rows_by_agent(bad):
        what = (
            f"others see actor {subject.boxes.actor[picked[0]]}, which meta says it is, up to "
            f"{far[np.isin(own, picked)].max():.2f} m away in {frames_text(subject.boxes.frame[picked])}"
        )
        yield subject.finding("own-box-apart", subject.label_where(agent), what)


def _missing_actors(subject: Subject, views: _ActorViews) -> Iterator[Finding]:
    """Near actors that others annotate and one agent lacks, although its labels are complete (`Subject.reach`)."""
    there = np.isfinite(views.center[..., 0])
    place = np.nanmean(views.center, axis=1)
    for agent, reach in enumerate(subject.reach.tolist()):
        if subject.agents[agent] not in subject.files.scan.labelled:
            continue
        distance = np.linalg.norm(
            place[:, :2] - subject.positions[agent][views.frame - 1, :2], axis=1
        )
        expected = (distance < reach) & (distance > _ITSELF)
        missing = np.flatnonzero(expected & ~there[:, agent])
        missing = missing[~subject.has_untracked(agent, views.frame[missing], place[missing])]
        if len(missing):
            what = f"others see {actors_text(views.actor[missing])} within {reach:.0f} m"
            where = subject.label_where(agent)
            yield subject.finding(
                "actor-missing", where, f"{what}, {frames_text(views.frame[missing])}"
            )


def _ids(subject: Subject) -> Iterator[Finding]:
    """Boxes of two agents in the same place at the same moment that carry different ids."""
    boxes = subject.boxes
    rows = np.flatnonzero(subject.seen | (subject.own & (boxes.actor != UNTRACKED_ID)))
    near_ones, _ = near_pairs(subject.centers[rows], boxes.frame[rows], OWN_APART)
    first, second = rows[near_ones].T
    differ = (boxes.actor[first] != boxes.actor[second]) & (
        boxes.agent[first] != boxes.agent[second]
    )
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


def _overlaps(subject: Subject, views: _ActorViews) -> Iterator[Finding]:
    """A mover's box in another's, as others see the two, where meta names no collision; parked rows overlap anyway."""
    if subject.files.meta is None or subject.files.meta.collision is not None:
        return
    seen = (np.arange(len(views.actor)), np.isfinite(views.center[..., 0]).argmax(axis=1))
    center, size = views.center[seen], views.size[seen]
    moves = np.zeros(len(center), dtype=bool)
    moves[1:] = (np.diff(views.actor) == 0) & (
        np.linalg.norm(np.diff(center, axis=0), axis=1) > _STEP
    )
    pairs, _ = near_pairs(center, views.frame, _NEAR)
    pairs = pairs[moves[pairs].any(axis=1)]
    first, second = np.column_stack([center[:, :2], size[:, :2], views.yaw[seen]])[pairs.T]
    depth = -signed_gaps(first, second)
    over = (depth > POSITION) & (
        np.abs(np.diff(center[pairs, 2])[:, 0]) < size[pairs, 2].mean(axis=1)
    )
    if over.any():
        who, when = (
            actors_text(views.actor[pairs[over]].ravel()),
            frames_text(views.frame[pairs[over, 0]]),
        )
        what = f"{who} overlap by up to {depth[over].max():.2f} m, {when}"
        yield subject.finding("overlap-unnamed", subject.token, what)


def _wrapped(angle: FloatArray) -> FloatArray:
    """Angles in (−π, π]."""
    return np.arctan2(np.sin(angle), np.cos(angle))


def check_story(subject: Subject) -> Iterator[Finding]:
    """All that meta says, compared with the format and the recordings."""
    if subject.files.scenario.name in SHEER_CURTAINS:
        yield subject.finding(
            "sheer-curtain", subject.token, "vehicles behind sheer curtains are marked invisible"
        )
    yield from _name(subject)
    if subject.files.meta is not None:
        for check in _CHECKS:
            yield from check(subject, subject.files.meta)


def _name(subject: Subject) -> Iterator[Finding]:
    """The scenario's name says its type and subtype once more."""
    scenario = subject.files.scenario
    folder = re.match(r"type(\d+)_subtype(\d+)_", scenario.scenario_type)
    name = re.search(r"_type(\d+)_subtype(\d+)_", scenario.name)
    if (
        folder
        and name
        and [int(word) for word in folder.groups()] != [int(word) for word in name.groups()]
    ):
        what = f"its name says type {int(name[1])}, subtype {int(name[2])}, its folder {scenario.scenario_type}"
        yield subject.finding("name-and-folder", subject.token, what)


def _words(subject: Subject, meta: Meta) -> Iterator[Finding]:
    side = (meta.spawn_side or "").split()[:1]
    said = {
        "weather": (meta.weather, WEATHERS),
        "road_type": (meta.road_type, ROAD_TYPES),
        "another_vehicle_spawn_side": (side[0] if side else None, SPAWN_SIDES),
        "ego_vehicle_direction": (meta.ego_direction, DIRECTIONS),
        "other_vehicle_direction": (meta.other_direction, DIRECTIONS),
    }
    for name, (word, known) in said.items():
        if word is not None and word not in known:
            yield _at_meta(
                subject,
                "meta-word",
                f"{name} is {shortened(word)!r}, expected one of {', '.join(known)}",
            )
    told = (
        {}
        if meta.collision is None
        else {
            "spawn relation": (meta.collision.spawn_relation, SPAWN_RELATIONS),
            "contact side": (meta.collision.contact_side, CONTACT_SIDES),
        }
    )
    for name, (word, known) in told.items():
        if word not in known:
            what = f"{name} is {shortened(word)!r}, the release is known to have {', '.join(known)}"
            yield subject.finding("collision-word", f"{subject.files.scenario.meta_path}:1", what)
    if meta.time_of_day is None:
        yield _at_meta(
            subject, "meta-word", f"{shortened(meta.weather)!r} does not end in a time of day"
        )
    absent = [name for name, (word, _) in said.items() if word is None]
    absent += ["agents id"] if meta.agent_ids is None else []
    if absent:
        yield _at_meta(subject, "meta-incomplete", f"lacks {', '.join(absent)}")


def _counts(subject: Subject, meta: Meta) -> Iterator[Finding]:
    expected = meta.recorded_frames
    if expected != subject.num_frames:
        yield _at_meta(
            subject,
            "meta-frames",
            f"counts {meta.simulated_frames} simulated frames, so {expected} recorded ones, found {subject.num_frames}",
        )


def _folder(subject: Subject, meta: Meta) -> Iterator[Finding]:
    accident = subject.files.scenario.scenario_type.endswith("_accident")
    if meta.collision and not accident:
        yield _at_meta(subject, "collision-in-normal", f"names a collision of {meta.collision.ids}")
    if accident and not meta.collision:
        yield _at_meta(subject, "no-collision-in-accident", "names no collision")


def _agents(subject: Subject, meta: Meta) -> Iterator[Finding]:
    """The agents that `colliding agents` names against the ids of the pair."""
    collision = meta.collision
    if collision is None or collision.agents is None or meta.agent_ids is None:
        return
    if set(collision.agents) == {None}:
        yield _at_meta(
            subject,
            "nobody-named",
            f"the colliding agents are 'none none', the pair {collision.ids}",
        )
        return
    id_of = dict(zip(VEHICLE_AGENTS, meta.agent_ids, strict=True))
    short = {name: word for word, name in META_AGENTS.items()}
    expected = {id_of[agent] for agent in collision.agents if agent is not None}
    if not expected <= set(collision.ids) and UNKNOWN_ID not in collision.ids:
        names = " ".join(short[agent] for agent in collision.agents)
        yield _at_meta(
            subject, "meta-pair", f"the colliding agents '{names}' are not the pair {collision.ids}"
        )
    named = {agent for agent, actor in id_of.items() if actor in collision.ids}
    if not named <= set(collision.agents):
        what = f"the pair {collision.ids} has an agent that 'colliding agents' does not name"
        yield _at_meta(subject, "meta-pair", what)


def _pair(subject: Subject, meta: Meta) -> Iterator[Finding]:
    collision = meta.collision
    if collision is None or not subject.files.scan.labelled:
        return
    agent_of = dict(zip(meta.agent_ids or (), VEHICLE_AGENTS, strict=False))
    told_by = [agent_of[actor] for actor in collision.ids if actor in agent_of]
    if not set(told_by) & set(subject.files.scan.labelled):
        return  # nobody of the pair was downloaded, and the others may be far off
    for actor, name in zip(collision.ids, collision.classes, strict=True):
        rows = np.flatnonzero(subject.boxes.actor == actor)
        found = sorted({CATEGORIES[code] for code in subject.boxes.labels.category[rows].tolist()})
        if not len(rows):
            code = "pair-not-seen" if actor in agent_of else "counterpart-unknown"
            yield _at_meta(subject, code, f"nobody annotated actor {actor}")
        elif found != [name]:
            what = f"actor {actor} is a {shortened(name)}, the labels say {', '.join(found)}"
            yield _at_meta(subject, "meta-pair", what)


def _impact(subject: Subject, meta: Meta) -> Iterator[Finding]:
    if meta.collision is None:
        return
    gap = pair_gap(subject, meta.collision)
    if gap is not None and gap > CONTACT_GAP:
        what = f"at the last frame actors {meta.collision.ids[0]} and {meta.collision.ids[1]} are {gap:.2f} m apart"
        yield _at_meta(subject, "no-contact", what)


def pair_gap(subject: Subject, collision: Collision) -> float | None:
    """Metres between the pair's boxes seen from above at the last frame; None if one is not annotated there.

    Of an actor that several agents annotated, the two boxes that are nearest count; each agent's first.
    """
    last = subject.boxes.frame == subject.num_frames
    rows = [np.flatnonzero(last & (subject.boxes.actor == actor)) for actor in collision.ids]
    rows = [found[np.unique(subject.boxes.agent[found], return_index=True)[1]] for found in rows]
    if UNTRACKED_ID in collision.ids or not all(len(found) for found in rows):
        return None
    first, second = (_footprints(subject, found) for found in rows)
    return float(gaps(first, second).min())


def _footprints(subject: Subject, rows: IntArray) -> FloatArray:
    """(M, 5) boxes in world from above: x, y, length, width, yaw."""
    return np.column_stack(
        [subject.centers[rows, :2], subject.boxes.labels.size[rows, :2], subject.yaw[rows]]
    )


def _at_meta(subject: Subject, code: str, what: str) -> Finding:
    return subject.finding(code, str(subject.files.scenario.meta_path), what)


_CHECKS: tuple[Callable[[Subject, Meta], Iterator[Finding]], ...] = (
    _words,
    _counts,
    _folder,
    _agents,
    _pair,
    _impact,
)
