"""Checks that files agree: the agents' views of the same actors, and meta with the labels."""

import re
from collections.abc import Callable
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
from deepaccident_devkit.validation.subject import (
    Findings,
    Subject,
    actors_text,
    frames_text,
    near_pairs,
)

POSITION_TOLERANCE_M = 0.05
"""Largest distance between two agents' positions of the same actor."""
HEADING_TOLERANCE_RAD = np.radians(5.0)
# Largest difference between two agents' sizes of the same actor.
_SIZE_TOLERANCE_M = 0.02
OWN_ROW_TOLERANCE_M = 0.6
"""Largest distance of an agent's own row from where others see it; it reaches 0.3 in real data."""
# Radius around an agent's origin within which others' boxes show the agent itself.
_AGENT_RADIUS_M = 3.0
SAME_POSITION_M = 0.1
"""Distance within which boxes of two agents are the same object, so that ids should agree."""
# Largest distance between the centres of two boxes that may overlap.
_OVERLAP_RADIUS_M = 10.0
# Smallest distance that a moving actor covers between frames.
_MIN_STEP_M = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class _ActorViews:
    """K views (one actor in one frame), as annotated by each of the A agents from outside.

    Values are NaN or −1 where an agent has no annotation.

    Attributes:
        actor: Actor ids, shape (K,).
        frame: Frame numbers, shape (K,).
        center: Centres in the world frame in metres, shape (K, A, 3).
        yaw: Headings in the world frame in radians, shape (K, A).
        size: Sizes, shape (K, A, 3), metres.
        category: Category codes, shape (K, A).
    """

    actor: IntArray
    frame: IntArray
    center: FloatArray
    yaw: FloatArray
    size: FloatArray
    category: AnyArray


def check_agreement(subject: Subject) -> Findings:
    """Compare how different agents annotated the same actors, for each pair of agents."""
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
    moments, moment_of_row = np.unique(keys, axis=0, return_inverse=True)
    cells = (moment_of_row.reshape(-1), boxes.agent[rows])
    shape = (len(moments), len(subject.agents))
    views = _ActorViews(
        actor=moments[:, 0],
        frame=moments[:, 1],
        center=np.full((*shape, 3), np.nan),
        yaw=np.full(shape, np.nan),
        size=np.full((*shape, 3), np.nan),
        category=np.full(shape, -1, dtype=np.int8),
    )
    views.center[cells] = subject.centers[rows]
    views.yaw[cells] = subject.yaw[rows]
    views.size[cells] = boxes.labels.size[rows]
    views.category[cells] = boxes.labels.category[rows]
    return views


def _compare_agents(subject: Subject, views: _ActorViews, agent: int, other: int) -> Findings:
    location = f"{subject.token}: {subject.agents[agent]} and {subject.agents[other]}"
    offset = views.center[:, agent] - views.center[:, other]
    distance = np.linalg.norm(offset, axis=1)
    yaw_difference = views.yaw[:, agent] - views.yaw[:, other]
    turn = np.degrees(np.abs(wrap_angle(yaw_difference)))
    max_turn = np.degrees(HEADING_TOLERANCE_RAD)
    size_differences = np.abs(views.size[:, agent] - views.size[:, other])
    growth = size_differences.max(axis=1)
    is_shared = np.isfinite(distance)
    for code, values, limit, unit in (
        ("positions-differ", distance, POSITION_TOLERANCE_M, "{:.2f} m apart"),
        ("headings-differ", turn, max_turn, "turned by {:.0f}°"),
        ("sizes-differ", growth, _SIZE_TOLERANCE_M, "sizes {:.2f} m apart"),
    ):
        differs = is_shared & (values > limit)
        if differs.any():
            message = _difference_text(views, differs, values, is_shared, unit)
            yield subject.finding(code, location, message)
    differs = is_shared & (views.category[:, agent] != views.category[:, other])
    if differs.any():
        actors = actors_text(views.actor[differs])
        frames = frames_text(views.frame[differs])
        yield subject.finding("classes-differ", location, f"{actors}, {frames}")


def _difference_text(
    views: _ActorViews, differs: BoolArray, values: FloatArray, is_shared: BoolArray, unit: str
) -> str:
    row = int(np.argmax(np.where(differs, values, -1)))
    share = differs.sum() / is_shared.sum()
    actors = actors_text(views.actor[differs])
    frames = frames_text(views.frame[differs])
    return (
        f"{actors} in {frames} ({100 * share:.0f} % of what both see), worst "
        f"actor {views.actor[row]} at frame {views.frame[row]}: {unit.format(values[row])}"
    )


def _check_own_rows(subject: Subject, views: _ActorViews) -> Findings:
    """Compare each agent's own row with how others see the actor that meta names for it."""
    moments = zip(views.actor.tolist(), views.frame.tolist(), strict=True)
    view_of_moment = {moment: view for view, moment in enumerate(moments)}
    boxes = subject.boxes
    pairs = []
    has_actor = subject.own & (boxes.actor != UNTRACKED_ID)
    for row in np.flatnonzero(has_actor).tolist():
        moment = (boxes.actor[row].item(), boxes.frame[row].item())
        view = view_of_moment.get(moment)
        if view is not None:
            pairs.append((row, view))
    if not pairs:
        return
    own_rows, view_rows = np.array(pairs).T
    offsets = subject.centers[own_rows, None] - views.center[view_rows]
    distance = np.nanmin(np.linalg.norm(offsets, axis=2), axis=1)
    seen_size = np.nanmedian(views.size[view_rows], axis=1)
    size_difference = np.abs(boxes.labels.size[own_rows] - seen_size).max(axis=1)
    resized = subject.mask(own_rows[size_difference > _SIZE_TOLERANCE_M])
    displaced = subject.mask(own_rows[distance > OWN_ROW_TOLERANCE_M])
    for agent, rows in subject.rows_by_agent(resized):
        frames = frames_text(boxes.frame[rows])
        message = f"the size in the own row differs from what other agents see, {frames}"
        yield subject.label_finding("sizes-differ", agent, message)
    for agent, rows in subject.rows_by_agent(displaced):
        max_distance = distance[np.isin(own_rows, rows)].max()
        message = (
            f"meta says that this agent is actor {boxes.actor[rows[0]]}, but others see that actor "
            f"up to {max_distance:.2f} m away in {frames_text(boxes.frame[rows])}"
        )
        yield subject.label_finding("own-box-apart", agent, message)


def _check_missing_actors(subject: Subject, views: _ActorViews) -> Findings:
    """Find actors missing from an agent's labels, although these are complete around the agent.

    Within `Subject.reach`, labels are taken to be complete.
    """
    is_annotated = np.isfinite(views.center[..., 0])
    center = np.nanmean(views.center, axis=1)
    for agent, reach in enumerate(subject.reach.tolist()):
        if subject.agents[agent] not in subject.labelled:
            continue
        own_position = subject.positions[agent][views.frame - 1]
        offset = center[:, :2] - own_position[:, :2]
        distance = np.linalg.norm(offset, axis=1)
        is_expected = (distance < reach) & (distance > _AGENT_RADIUS_M)
        missing = np.flatnonzero(is_expected & ~is_annotated[:, agent])
        missing = missing[~subject.has_untracked(agent, views.frame[missing], center[missing])]
        if len(missing):
            actors = actors_text(views.actor[missing])
            frames = frames_text(views.frame[missing])
            message = f"missing, but other agents see {actors} within {reach:.0f} m, {frames}"
            yield subject.label_finding("actor-missing", agent, message)


def _check_ids(subject: Subject) -> Findings:
    """Find boxes of two agents at the same position and time that have different ids."""
    boxes = subject.boxes
    is_own = subject.own
    has_actor = subject.tracked | (is_own & (boxes.actor != UNTRACKED_ID))
    candidates = np.flatnonzero(has_actor)
    pairs, _ = near_pairs(subject.centers[candidates], boxes.frame[candidates], OWN_ROW_TOLERANCE_M)
    rows, other_rows = candidates[pairs].T
    other_actor = boxes.actor[rows] != boxes.actor[other_rows]
    other_agent = boxes.agent[rows] != boxes.agent[other_rows]
    differ = other_actor & other_agent
    rows = rows[differ]
    other_rows = other_rows[differ]
    distance = np.linalg.norm(subject.centers[rows] - subject.centers[other_rows], axis=1)
    same_class = boxes.labels.category[rows] == boxes.labels.category[other_rows]
    # An agent's own row can be off by 0.3 m.
    has_own_row = is_own[rows] | is_own[other_rows]
    coincide = (distance < SAME_POSITION_M) | (has_own_row & same_class)
    rows = rows[coincide]
    other_rows = other_rows[coincide]
    agents = np.column_stack([boxes.agent[rows], boxes.agent[other_rows]])
    agents = np.sort(agents, axis=1)
    for agent_pair in np.unique(agents, axis=0).tolist():
        is_pair = (agents == agent_pair).all(axis=1)
        actors = np.concatenate([boxes.actor[rows[is_pair]], boxes.actor[other_rows[is_pair]]])
        frames = frames_text(boxes.frame[rows[is_pair]])
        names = " and ".join(subject.agents[agent] for agent in agent_pair)
        message = f"{actors_text(actors)} are in the same place, {frames}"
        yield subject.finding("ids-differ", f"{subject.token}: {names}", message)


def _check_overlaps(subject: Subject, views: _ActorViews) -> Findings:
    """Find moving boxes that overlap others, if meta names no collision.

    Each box is taken from the first agent that sees it. Parked cars often overlap and are ignored.
    """
    if subject.files.meta is None or subject.files.meta.collision is not None:
        return
    first_agent = np.isfinite(views.center[..., 0]).argmax(axis=1)
    first_view = (np.arange(len(views.actor)), first_agent)
    center = views.center[first_view]
    size = views.size[first_view]
    steps = np.linalg.norm(np.diff(center, axis=0), axis=1)
    same_actor = np.diff(views.actor) == 0
    moves = np.zeros(len(center), dtype=bool)
    moves[1:] = same_actor & (steps > _MIN_STEP_M)
    pairs, _ = near_pairs(center, views.frame, _OVERLAP_RADIUS_M)
    pairs = pairs[moves[pairs].any(axis=1)]
    outlines = np.column_stack([center[:, :2], size[:, :2], views.yaw[first_view]])
    depth = -signed_gaps(*outlines[pairs.T])
    height_difference = np.abs(np.diff(center[pairs, 2])[:, 0])
    mean_height = size[pairs, 2].mean(axis=1)
    overlaps = (depth > POSITION_TOLERANCE_M) & (height_difference < mean_height)
    if overlaps.any():
        overlapping_pairs = pairs[overlaps]
        actors = actors_text(views.actor[overlapping_pairs].ravel())
        frames = frames_text(views.frame[overlapping_pairs[:, 0]])
        message = f"{actors} overlap by up to {depth[overlaps].max():.2f} m, {frames}"
        yield subject.finding("overlap-unnamed", subject.token, message)


def wrap_angle(angle: FloatArray) -> FloatArray:
    """Wrap angles in radians to [−π, π]."""
    return np.arctan2(np.sin(angle), np.cos(angle))


def check_story(subject: Subject) -> Findings:
    """Compare all entries of meta with the format and with the recordings."""
    scenario = subject.files.scenario
    meta = subject.files.meta
    if scenario.name in SHEER_CURTAINS:
        message = "vehicles behind see-through obstacles are marked invisible"
        yield subject.finding("sheer-curtain", subject.token, message)
    yield from _check_name(subject)
    if meta is not None:
        for check in _META_CHECKS:
            yield from check(subject, meta)


def _check_name(subject: Subject) -> Findings:
    """Compare the type and subtype in the scenario's name with its folder."""
    scenario = subject.files.scenario
    folder = re.match(r"type(\d+)_subtype(\d+)_", scenario.scenario_type)
    name = re.search(r"_type(\d+)_subtype(\d+)_", scenario.name)
    if not folder or not name:
        return
    folder_numbers = list(map(int, folder.groups()))
    name_numbers = list(map(int, name.groups()))
    if folder_numbers != name_numbers:
        message = f"the name says type {int(name[1])}, subtype {int(name[2])}"
        message += f", the folder says {scenario.scenario_type}"
        yield subject.finding("name-and-folder", subject.token, message)


def _check_words(subject: Subject, meta: Meta) -> Findings:
    spawn_words = (meta.spawn_side or "").split()
    spawn_side = spawn_words[0] if spawn_words else None
    words = {
        "weather": (meta.weather, WEATHERS),
        "road_type": (meta.road_type, ROAD_TYPES),
        "another_vehicle_spawn_side": (spawn_side, SPAWN_SIDES),
        "ego_vehicle_direction": (meta.ego_direction, DIRECTIONS),
        "other_vehicle_direction": (meta.other_direction, DIRECTIONS),
    }
    missing = []
    for name, (word, known_words) in words.items():
        if word is None:
            missing.append(name)
        elif word not in known_words:
            message = f"{name} is {shortened(word)!r}, expected one of {', '.join(known_words)}"
            yield _meta_finding(subject, "meta-word", message)
    if meta.collision is not None:
        yield from _check_collision_words(subject, meta.collision)
    if meta.time_of_day is None:
        message = f"{shortened(meta.weather)!r} does not end with a time of day"
        yield _meta_finding(subject, "meta-word", message)
    if meta.agent_ids is None:
        missing.append("agents id")
    if missing:
        yield _meta_finding(subject, "meta-incomplete", f"lacks {', '.join(missing)}")


def _check_collision_words(subject: Subject, collision: Collision) -> Findings:
    words = {
        "spawn relation": (collision.spawn_relation, SPAWN_RELATIONS),
        "contact side": (collision.contact_side, CONTACT_SIDES),
    }
    location = f"{subject.files.scenario.meta_path}:1"
    for name, (word, known_words) in words.items():
        if word not in known_words:
            message = f"{name} is {shortened(word)!r}"
            message += f", but known values are {', '.join(known_words)}"
            yield subject.finding("collision-word", location, message)


def _check_frame_count(subject: Subject, meta: Meta) -> Findings:
    expected = meta.recorded_frames
    if expected != subject.num_frames:
        message = f"names {meta.simulated_frames} simulated frames: expected {expected} recorded"
        yield _meta_finding(subject, "meta-frames", f"{message}, found {subject.num_frames}")


def _check_folder(subject: Subject, meta: Meta) -> Findings:
    is_accident = subject.files.scenario.scenario_type.endswith("_accident")
    if meta.collision and not is_accident:
        message = f"names a collision of {meta.collision.ids}"
        yield _meta_finding(subject, "collision-in-normal", message)
    if is_accident and not meta.collision:
        yield _meta_finding(subject, "no-collision-in-accident", "names no collision")


def _check_colliding_agents(subject: Subject, meta: Meta) -> Findings:
    """Compare the agents in meta's entry `colliding agents` with the ids of the pair."""
    collision = meta.collision
    if collision is None or collision.agents is None or meta.agent_ids is None:
        return
    if set(collision.agents) == {None}:
        message = f"the colliding agents are 'none none', but the pair is {collision.ids}"
        yield _meta_finding(subject, "nobody-named", message)
        return
    ids_by_agent = dict(zip(VEHICLE_AGENTS, meta.agent_ids, strict=True))
    words_by_agent = {name: word for word, name in META_AGENTS.items()}
    expected = {ids_by_agent[agent] for agent in collision.agents if agent is not None}
    if not expected <= set(collision.ids) and UNKNOWN_ID not in collision.ids:
        names = " ".join(words_by_agent[agent] for agent in collision.agents)
        message = f"the colliding agents '{names}' are not the pair {collision.ids}"
        yield _meta_finding(subject, "meta-pair", message)
    pair_agents = {agent for agent, actor in ids_by_agent.items() if actor in collision.ids}
    if not pair_agents <= set(collision.agents):
        message = f"'colliding agents' does not name an agent in the pair {collision.ids}"
        yield _meta_finding(subject, "meta-pair", message)


def _check_pair(subject: Subject, meta: Meta) -> Findings:
    collision = meta.collision
    if collision is None or not subject.labelled:
        return
    agents_by_id = dict(zip(meta.agent_ids or (), VEHICLE_AGENTS, strict=False))
    pair_agents = {agents_by_id[actor] for actor in collision.ids if actor in agents_by_id}
    if pair_agents.isdisjoint(subject.labelled):
        # Neither of the pair was downloaded, and the other agents may be too far away to see it.
        return
    for actor, name in zip(collision.ids, collision.classes, strict=True):
        codes = subject.boxes.labels.category[subject.boxes.actor == actor]
        classes = sorted({CATEGORIES[code] for code in codes.tolist()})
        if not classes:
            code = "pair-not-seen" if actor in agents_by_id else "counterpart-unknown"
            yield _meta_finding(subject, code, f"no agent annotated actor {actor}")
        elif classes != [name]:
            message = f"actor {actor}: meta says {shortened(name)}, labels say {', '.join(classes)}"
            yield _meta_finding(subject, "meta-pair", message)


def _check_impact(subject: Subject, meta: Meta) -> Findings:
    if meta.collision is None:
        return
    gap = pair_gap(subject, meta.collision)
    if gap is not None and gap > CONTACT_GAP:
        actor, other = meta.collision.ids
        message = f"in the last frame, actors {actor} and {other} are {gap:.2f} m apart"
        yield _meta_finding(subject, "no-contact", message)


def pair_gap(subject: Subject, collision: Collision) -> float | None:
    """Return the gap in metres between the boxes of a pair in the last frame, seen from above.

    It is None if either is not annotated in this frame. If several agents annotated an actor, the
    nearest two boxes are used; each agent contributes only its first box of the actor.
    """
    boxes = subject.boxes
    is_last = boxes.frame == subject.num_frames
    outlines = []
    for actor in collision.ids:
        rows = np.flatnonzero(is_last & (boxes.actor == actor))
        _, first_rows = np.unique(boxes.agent[rows], return_index=True)
        outlines.append(_outline_rows(subject, rows[first_rows]))
    actor_outlines, other_outlines = outlines
    if UNTRACKED_ID in collision.ids or not len(actor_outlines) or not len(other_outlines):
        return None
    return float(gaps(actor_outlines, other_outlines).min())


def _outline_rows(subject: Subject, rows: IntArray) -> FloatArray:
    """Return outlines (M, 5) in the world frame, seen from above: x, y, length, width, yaw."""
    centers = subject.centers[rows, :2]
    sizes = subject.boxes.labels.size[rows, :2]
    return np.column_stack([centers, sizes, subject.yaw[rows]])


def _meta_finding(subject: Subject, code: str, message: str) -> Finding:
    path = subject.files.scenario.meta_path
    return subject.finding(code, str(path), message)


# The checks of meta, in the order in which findings are listed.
_META_CHECKS: tuple[Callable[[Subject, Meta], Findings], ...] = (
    _check_words,
    _check_frame_count,
    _check_folder,
    _check_colliding_agents,
    _check_pair,
    _check_impact,
)
