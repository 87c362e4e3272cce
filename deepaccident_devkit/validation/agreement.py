"""Checks of agreement between files: the agents' views of each other, and meta against labels."""

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

POSITION_TOLERANCE_M = 0.05
"""Distance between two agents' views of an actor."""
HEADING_TOLERANCE_RAD = np.radians(5.0)
# Difference between two agents' sizes of an actor.
_SIZE_TOLERANCE_M = 0.02
OWN_ROW_TOLERANCE_M = 0.6
"""Distance of an agent's own row from where others see it; real ones reach 0.3."""
# Radius around an agent's origin in which others see the agent itself.
_AGENT_RADIUS_M = 3.0
SAME_POSITION_M = 0.1
"""Distance within which boxes of two agents are one object; different ids then contradict."""
# Distance of the centres of two boxes that can overlap.
_OVERLAP_RADIUS_M = 10.0
# Distance that a moving actor covers in a frame.
_MIN_STEP_M = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class _ActorViews:
    """Every actor at every moment (K of them), as each agent (A) annotated it from outside.

    Missing views are NaN or −1.

    Attributes:
        actor: Actor ids, shape (K,).
        frame: Frame numbers, shape (K,).
        center: Centres, shape (K, A, 3), world, metres.
        yaw: Headings, shape (K, A), world, radians.
        size: Sizes, shape (K, A, 3), metres.
        category: Category codes, shape (K, A).
    """

    actor: IntArray
    frame: IntArray
    center: FloatArray
    yaw: FloatArray
    size: FloatArray
    category: AnyArray


def check_agreement(subject: Subject) -> Iterator[Finding]:
    """Compare the agents' views of the same actors, pair by pair."""
    views = _collect_views(subject)
    for agent, other in combinations(range(len(subject.agents)), 2):
        yield from _compare_agents(subject, views, agent, other)
    yield from _check_own_rows(subject, views)
    yield from _check_missing_actors(subject, views)
    yield from _check_ids(subject)
    yield from _check_overlaps(subject, views)


def _collect_views(subject: Subject) -> _ActorViews:
    boxes = subject.boxes
    rows = np.flatnonzero(subject.tracked)
    keys = np.column_stack([boxes.actor[rows], boxes.frame[rows]]).reshape(-1, 2)
    moments, moment = np.unique(keys, axis=0, return_inverse=True)
    index = (moment.reshape(-1), boxes.agent[rows])
    shape = (len(moments), len(subject.agents))
    views = _ActorViews(
        actor=moments[:, 0],
        frame=moments[:, 1],
        center=np.full((*shape, 3), np.nan),
        yaw=np.full(shape, np.nan),
        size=np.full((*shape, 3), np.nan),
        category=np.full(shape, -1, dtype=np.int8),
    )
    views.center[index] = subject.centers[rows]
    views.yaw[index] = subject.yaw[rows]
    views.size[index] = boxes.labels.size[rows]
    views.category[index] = boxes.labels.category[rows]
    return views


def _compare_agents(
    subject: Subject, views: _ActorViews, agent: int, other: int
) -> Iterator[Finding]:
    location = f"{subject.token}: {subject.agents[agent]} and {subject.agents[other]}"
    distance = np.linalg.norm(views.center[:, agent] - views.center[:, other], axis=1)
    turn = np.abs(_wrap_angle(views.yaw[:, agent] - views.yaw[:, other]))
    growth = np.abs(views.size[:, agent] - views.size[:, other]).max(axis=1)
    shared = np.isfinite(distance)
    for code, values, limit, unit in (
        ("positions-differ", distance, POSITION_TOLERANCE_M, "{:.2f} m apart"),
        (
            "headings-differ",
            np.degrees(turn),
            np.degrees(HEADING_TOLERANCE_RAD),
            "turned by {:.0f}°",
        ),
        ("sizes-differ", growth, _SIZE_TOLERANCE_M, "sizes {:.2f} m apart"),
    ):
        bad = shared & (values > limit)
        if bad.any():
            message = _difference_text(views, bad, values, shared, unit)
            yield subject.finding(code, location, message)
    differs = shared & (views.category[:, agent] != views.category[:, other])
    if differs.any():
        message = f"{actors_text(views.actor[differs])}, {frames_text(views.frame[differs])}"
        yield subject.finding("classes-differ", location, message)


def _difference_text(
    views: _ActorViews, bad: BoolArray, values: FloatArray, shared: BoolArray, unit: str
) -> str:
    worst = int(np.argmax(np.where(bad, values, -1)))
    share = bad.sum() / shared.sum()
    actors = actors_text(views.actor[bad])
    frames = frames_text(views.frame[bad])
    return (
        f"{actors} in {frames} ({share:.0%} of what both see), worst "
        f"actor {views.actor[worst]} at frame {views.frame[worst]}: {unit.format(values[worst])}"
    )


def _check_own_rows(subject: Subject, views: _ActorViews) -> Iterator[Finding]:
    """Compare each agent's own row with the others' views of the actor that meta names for it."""
    moments = zip(views.actor.tolist(), views.frame.tolist(), strict=True)
    view_of_moment = {moment: view for view, moment in enumerate(moments)}
    boxes = subject.boxes
    pairs = []
    for row in np.flatnonzero(subject.own & (boxes.actor != UNTRACKED_ID)).tolist():
        view = view_of_moment.get((boxes.actor[row].item(), boxes.frame[row].item()))
        if view is not None:
            pairs.append((row, view))
    if not pairs:
        return
    own_rows, view_rows = np.array(pairs).T
    distances = np.linalg.norm(subject.centers[own_rows, None] - views.center[view_rows], axis=2)
    distance = np.nanmin(distances, axis=1)
    seen_size = np.nanmedian(views.size[view_rows], axis=1)
    size_difference = np.abs(boxes.labels.size[own_rows] - seen_size).max(axis=1)
    resized = subject.mask(own_rows[size_difference > _SIZE_TOLERANCE_M])
    displaced = subject.mask(own_rows[distance > OWN_ROW_TOLERANCE_M])
    for agent, rows in subject.rows_by_agent(resized):
        frames = frames_text(boxes.frame[rows])
        message = f"the own row has another size than others see, {frames}"
        yield subject.finding("sizes-differ", subject.label_folder(agent), message)
    for agent, rows in subject.rows_by_agent(displaced):
        max_distance = distance[np.isin(own_rows, rows)].max()
        message = (
            f"others see actor {boxes.actor[rows[0]]}, which meta says it is, up to "
            f"{max_distance:.2f} m away in {frames_text(boxes.frame[rows])}"
        )
        yield subject.finding("own-box-apart", subject.label_folder(agent), message)


def _check_missing_actors(subject: Subject, views: _ActorViews) -> Iterator[Finding]:
    """Find near actors that one agent lacks, although its labels are complete (`Subject.reach`)."""
    annotated = np.isfinite(views.center[..., 0])
    center = np.nanmean(views.center, axis=1)
    for agent, reach in enumerate(subject.reach.tolist()):
        if subject.agents[agent] not in subject.files.scan.labelled:
            continue
        offset = center[:, :2] - subject.positions[agent][views.frame - 1, :2]
        distance = np.linalg.norm(offset, axis=1)
        expected = (distance < reach) & (distance > _AGENT_RADIUS_M)
        missing = np.flatnonzero(expected & ~annotated[:, agent])
        missing = missing[~subject.has_untracked(agent, views.frame[missing], center[missing])]
        if len(missing):
            actors = actors_text(views.actor[missing])
            frames = frames_text(views.frame[missing])
            message = f"others see {actors} within {reach:.0f} m, {frames}"
            yield subject.finding("actor-missing", subject.label_folder(agent), message)


def _check_ids(subject: Subject) -> Iterator[Finding]:
    """Find boxes of two agents at the same position and moment that carry different ids."""
    boxes = subject.boxes
    own = subject.own
    rows = np.flatnonzero(subject.tracked | (own & (boxes.actor != UNTRACKED_ID)))
    pairs, _ = near_pairs(subject.centers[rows], boxes.frame[rows], OWN_ROW_TOLERANCE_M)
    row, other = rows[pairs].T
    differ = (boxes.actor[row] != boxes.actor[other]) & (boxes.agent[row] != boxes.agent[other])
    row = row[differ]
    other = other[differ]
    distance = np.linalg.norm(subject.centers[row] - subject.centers[other], axis=1)
    alike = boxes.labels.category[row] == boxes.labels.category[other]
    # An own row lies up to 0.3 m off.
    coincide = (distance < SAME_POSITION_M) | ((own[row] | own[other]) & alike)
    row = row[coincide]
    other = other[coincide]
    agents = np.sort(np.column_stack([boxes.agent[row], boxes.agent[other]]), axis=1)
    for agent_pair in np.unique(agents, axis=0).tolist():
        of_pair = (agents == agent_pair).all(axis=1)
        actors = np.concatenate([boxes.actor[row[of_pair]], boxes.actor[other[of_pair]]])
        frames = frames_text(boxes.frame[row[of_pair]])
        names = " and ".join(subject.agents[agent] for agent in agent_pair)
        message = f"{actors_text(actors)} stand in the same places, {frames}"
        yield subject.finding("ids-differ", f"{subject.token}: {names}", message)


def _check_overlaps(subject: Subject, views: _ActorViews) -> Iterator[Finding]:
    """Find moving boxes inside others, as others see the two, where meta names no collision.

    Parked rows overlap in any case.
    """
    if subject.files.meta is None or subject.files.meta.collision is not None:
        return
    views_index = (np.arange(len(views.actor)), np.isfinite(views.center[..., 0]).argmax(axis=1))
    center = views.center[views_index]
    size = views.size[views_index]
    steps = np.linalg.norm(np.diff(center, axis=0), axis=1)
    moves = np.zeros(len(center), dtype=bool)
    moves[1:] = (np.diff(views.actor) == 0) & (steps > _MIN_STEP_M)
    pairs, _ = near_pairs(center, views.frame, _OVERLAP_RADIUS_M)
    pairs = pairs[moves[pairs].any(axis=1)]
    outlines = np.column_stack([center[:, :2], size[:, :2], views.yaw[views_index]])
    depth = -signed_gaps(*outlines[pairs.T])
    height_difference = np.abs(np.diff(center[pairs, 2])[:, 0])
    same_height = height_difference < size[pairs, 2].mean(axis=1)
    overlaps = (depth > POSITION_TOLERANCE_M) & same_height
    if overlaps.any():
        actors = actors_text(views.actor[pairs[overlaps]].ravel())
        frames = frames_text(views.frame[pairs[overlaps, 0]])
        message = f"{actors} overlap by up to {depth[overlaps].max():.2f} m, {frames}"
        yield subject.finding("overlap-unnamed", subject.token, message)


def _wrap_angle(angle: FloatArray) -> FloatArray:
    """Return angles in (−π, π]."""
    return np.arctan2(np.sin(angle), np.cos(angle))


def check_story(subject: Subject) -> Iterator[Finding]:
    """Compare all of meta with the format and the recordings."""
    if subject.files.scenario.name in SHEER_CURTAINS:
        message = "vehicles behind sheer curtains are marked invisible"
        yield subject.finding("sheer-curtain", subject.token, message)
    yield from _check_name(subject)
    if subject.files.meta is not None:
        for check in _META_CHECKS:
            yield from check(subject, subject.files.meta)


def _check_name(subject: Subject) -> Iterator[Finding]:
    """Compare the type and subtype in the scenario's name with its folder."""
    scenario = subject.files.scenario
    folder = re.match(r"type(\d+)_subtype(\d+)_", scenario.scenario_type)
    name = re.search(r"_type(\d+)_subtype(\d+)_", scenario.name)
    if not folder or not name:
        return
    if list(map(int, folder.groups())) != list(map(int, name.groups())):
        message = f"its name says type {int(name[1])}, subtype {int(name[2])}"
        message += f", its folder {scenario.scenario_type}"
        yield subject.finding("name-and-folder", subject.token, message)


def _check_words(subject: Subject, meta: Meta) -> Iterator[Finding]:
    side = (meta.spawn_side or "").split()[:1]
    words = {
        "weather": (meta.weather, WEATHERS),
        "road_type": (meta.road_type, ROAD_TYPES),
        "another_vehicle_spawn_side": (side[0] if side else None, SPAWN_SIDES),
        "ego_vehicle_direction": (meta.ego_direction, DIRECTIONS),
        "other_vehicle_direction": (meta.other_direction, DIRECTIONS),
    }
    for name, (word, known) in words.items():
        if word is not None and word not in known:
            message = f"{name} is {shortened(word)!r}, expected one of {', '.join(known)}"
            yield _meta_finding(subject, "meta-word", message)
    if meta.collision is not None:
        yield from _check_collision_words(subject, meta.collision)
    if meta.time_of_day is None:
        message = f"{shortened(meta.weather)!r} does not end in a time of day"
        yield _meta_finding(subject, "meta-word", message)
    missing = [name for name, (word, _) in words.items() if word is None]
    if meta.agent_ids is None:
        missing.append("agents id")
    if missing:
        yield _meta_finding(subject, "meta-incomplete", f"lacks {', '.join(missing)}")


def _check_collision_words(subject: Subject, collision: Collision) -> Iterator[Finding]:
    words = {
        "spawn relation": (collision.spawn_relation, SPAWN_RELATIONS),
        "contact side": (collision.contact_side, CONTACT_SIDES),
    }
    location = f"{subject.files.scenario.meta_path}:1"
    for name, (word, known) in words.items():
        if word not in known:
            message = f"{name} is {shortened(word)!r}"
            message += f", the release is known to have {', '.join(known)}"
            yield subject.finding("collision-word", location, message)


def _check_frame_count(subject: Subject, meta: Meta) -> Iterator[Finding]:
    expected = meta.recorded_frames
    if expected != subject.num_frames:
        message = f"counts {meta.simulated_frames} simulated frames, so {expected} recorded ones"
        yield _meta_finding(subject, "meta-frames", f"{message}, found {subject.num_frames}")


def _check_folder(subject: Subject, meta: Meta) -> Iterator[Finding]:
    accident = subject.files.scenario.scenario_type.endswith("_accident")
    if meta.collision and not accident:
        message = f"names a collision of {meta.collision.ids}"
        yield _meta_finding(subject, "collision-in-normal", message)
    if accident and not meta.collision:
        yield _meta_finding(subject, "no-collision-in-accident", "names no collision")


def _check_colliding_agents(subject: Subject, meta: Meta) -> Iterator[Finding]:
    """Compare the agents that `colliding agents` names with the ids of the pair."""
    collision = meta.collision
    if collision is None or collision.agents is None or meta.agent_ids is None:
        return
    if set(collision.agents) == {None}:
        message = f"the colliding agents are 'none none', the pair {collision.ids}"
        yield _meta_finding(subject, "nobody-named", message)
        return
    id_of = dict(zip(VEHICLE_AGENTS, meta.agent_ids, strict=True))
    word_of = {name: word for word, name in META_AGENTS.items()}
    expected = {id_of[agent] for agent in collision.agents if agent is not None}
    if not expected <= set(collision.ids) and UNKNOWN_ID not in collision.ids:
        names = " ".join(word_of[agent] for agent in collision.agents)
        message = f"the colliding agents '{names}' are not the pair {collision.ids}"
        yield _meta_finding(subject, "meta-pair", message)
    pair_agents = {agent for agent, actor in id_of.items() if actor in collision.ids}
    if not pair_agents <= set(collision.agents):
        message = f"the pair {collision.ids} has an agent that 'colliding agents' does not name"
        yield _meta_finding(subject, "meta-pair", message)


def _check_pair(subject: Subject, meta: Meta) -> Iterator[Finding]:
    collision = meta.collision
    if collision is None or not subject.files.scan.labelled:
        return
    agent_of = dict(zip(meta.agent_ids or (), VEHICLE_AGENTS, strict=False))
    pair_agents = {agent_of[actor] for actor in collision.ids if actor in agent_of}
    if not pair_agents & set(subject.files.scan.labelled):
        # Neither of the pair was downloaded, and the other agents may be too distant to see it.
        return
    for actor, name in zip(collision.ids, collision.classes, strict=True):
        codes = subject.boxes.labels.category[subject.boxes.actor == actor]
        classes = sorted({CATEGORIES[code] for code in codes.tolist()})
        if not classes:
            code = "pair-not-seen" if actor in agent_of else "counterpart-unknown"
            yield _meta_finding(subject, code, f"nobody annotated actor {actor}")
        elif classes != [name]:
            message = f"actor {actor} is a {shortened(name)}, the labels say {', '.join(classes)}"
            yield _meta_finding(subject, "meta-pair", message)


def _check_impact(subject: Subject, meta: Meta) -> Iterator[Finding]:
    if meta.collision is None:
        return
    gap = pair_gap(subject, meta.collision)
    if gap is not None and gap > CONTACT_GAP:
        actor, other = meta.collision.ids
        message = f"at the last frame actors {actor} and {other} are {gap:.2f} m apart"
        yield _meta_finding(subject, "no-contact", message)


def pair_gap(subject: Subject, collision: Collision) -> float | None:
    """Return the gap of the pair's boxes from above at the last frame, metres.

    None is returned if either is not annotated in it. Of an actor that several agents annotated,
    the nearest two boxes count; of each agent, its first.
    """
    is_last = subject.boxes.frame == subject.num_frames
    outlines = []
    for actor in collision.ids:
        rows = np.flatnonzero(is_last & (subject.boxes.actor == actor))
        _, first_rows = np.unique(subject.boxes.agent[rows], return_index=True)
        outlines.append(_outlines(subject, rows[first_rows]))
    actor_outlines, other_outlines = outlines
    if UNTRACKED_ID in collision.ids or not len(actor_outlines) or not len(other_outlines):
        return None
    return float(gaps(actor_outlines, other_outlines).min())


def _outlines(subject: Subject, rows: IntArray) -> FloatArray:
    """Return outlines (M, 5) in world from above: x, y, length, width, yaw."""
    centers = subject.centers[rows, :2]
    sizes = subject.boxes.labels.size[rows, :2]
    return np.column_stack([centers, sizes, subject.yaw[rows]])


def _meta_finding(subject: Subject, code: str, message: str) -> Finding:
    path = subject.files.scenario.meta_path
    return subject.finding(code, str(path), message)


_META_CHECKS: tuple[Callable[[Subject, Meta], Iterator[Finding]], ...] = (
    _check_words,
    _check_frame_count,
    _check_folder,
    _check_colliding_agents,
    _check_pair,
    _check_impact,
)
