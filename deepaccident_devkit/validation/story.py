"""Whether meta fits the recording: words, counts, ids, and an impact at the end (docs/format.md, Meta)."""

import re
from collections.abc import Callable, Iterator

import numpy as np

from deepaccident_devkit.arrays import FloatArray, IntArray
from deepaccident_devkit.reading import shortened
from deepaccident_devkit.release import Collision, Meta
from deepaccident_devkit.tables import Finding
from deepaccident_devkit.taxonomy import (
    CATEGORIES,
    META_AGENTS,
    UNTRACKED_ID,
    VEHICLE_AGENTS,
)
from deepaccident_devkit.v2x.collisions import CONTACT_GAP
from deepaccident_devkit.validation.subject import Subject

WEATHERS = ("Clear", "Cloudy", "HardRain", "MidRain", "SoftRain", "Wet", "WetCloudy")
ROAD_TYPES = ("four-way junction", "three-way junction")
SPAWN_SIDES = ("left", "right", "opposite")
DIRECTIONS = ("straight", "left", "right")
SHEER_CURTAINS = ("Town05_type001_subtype0002_scenario00035", "Town05_type001_subtype0002_scenario00004")
COLLIDING_NORMAL = ("Town07_type001_subtype0002_scenario00028",)
"""Scenarios of the release's _normal folders whose meta names a collision."""


def check_story(subject: Subject) -> Iterator[Finding]:
    """All that meta says, compared with the format and the recordings."""
    if subject.files.scenario.name in SHEER_CURTAINS:
        what = "vehicles behind sheer curtains are marked invisible"
        yield subject.finding("sheer-curtain", subject.token, what)
    yield from _name(subject)
    if subject.files.meta is not None:
        for check in _CHECKS:
            yield from check(subject, subject.files.meta)


def _name(subject: Subject) -> Iterator[Finding]:
    """The scenario's name says its type and subtype once more."""
    scenario = subject.files.scenario
    folder = re.match(r"type(\d+)_subtype(\d+)_", scenario.scenario_type)
    name = re.search(r"_type(\d+)_subtype(\d+)_", scenario.name)
    if folder and name and [int(word) for word in folder.groups()] != [int(word) for word in name.groups()]:
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
            yield _at_meta(subject, "meta-word", f"{name} is {shortened(word)!r}, expected one of {', '.join(known)}")
    if meta.time_of_day is None:
        yield _at_meta(subject, "meta-word", f"{shortened(meta.weather)!r} does not end in a time of day")
    absent = [name for name, (word, _) in said.items() if word is None]
    absent += ["agents id"] if meta.agent_ids is None else []
    if absent:
        yield _at_meta(subject, "meta-incomplete", f"lacks {', '.join(absent)}")


def _counts(subject: Subject, meta: Meta) -> Iterator[Finding]:
    expected = meta.recorded_frames
    if expected != subject.num_frames:
        what = (
            f"counts {meta.simulated_frames} simulated frames, so {expected} recorded ones, found {subject.num_frames}"
        )
        yield _at_meta(subject, "meta-frames", what)


def _folder(subject: Subject, meta: Meta) -> Iterator[Finding]:
    accident = subject.files.scenario.scenario_type.endswith("_accident")
    if meta.collision and not accident:
        known = "known-" if subject.files.scenario.name in COLLIDING_NORMAL else ""
        yield _at_meta(subject, f"{known}collision-in-normal", f"names a collision of {meta.collision.ids}")
    if accident and not meta.collision:
        yield _at_meta(subject, "no-collision-in-accident", "names no collision")


def _pair(subject: Subject, meta: Meta) -> Iterator[Finding]:
    collision = meta.collision
    if collision is None:
        return
    if collision.agents is not None and meta.agent_ids is not None:
        id_of = dict(zip(VEHICLE_AGENTS, meta.agent_ids, strict=True))
        short = {name: word for word, name in META_AGENTS.items()}
        expected = {id_of[agent] for agent in collision.agents if agent is not None}
        if not expected <= set(collision.ids):
            names = " ".join(short[agent] for agent in collision.agents)
            yield _at_meta(subject, "meta-pair", f"the colliding agents '{names}' are not the pair {collision.ids}")
        named = {agent for agent, actor in id_of.items() if actor in collision.ids}
        if not named <= set(collision.agents):
            what = f"the pair {collision.ids} has an agent that 'colliding agents' does not name"
            yield _at_meta(subject, "meta-pair", what)
    if not subject.files.scan.labelled:
        return
    agent_of = dict(zip(meta.agent_ids or (), VEHICLE_AGENTS, strict=False))
    told_by = [agent_of[actor] for actor in collision.ids if actor in agent_of]
    if not set(told_by) & set(subject.files.scan.labelled):
        return  # nobody of the pair was downloaded, and the others may be far off
    for actor, name in zip(collision.ids, collision.classes, strict=True):
        rows = np.flatnonzero(subject.boxes.actor == actor)
        found = sorted({CATEGORIES[code] for code in subject.boxes.labels.category[rows].tolist()})
        if not len(rows):
            yield _at_meta(subject, "pair-not-seen", f"nobody annotated actor {actor}")
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
    from shapely import distance, polygons

    last = subject.boxes.frame == subject.num_frames
    rows = [np.flatnonzero(last & (subject.boxes.actor == actor)) for actor in collision.ids]
    rows = [found[np.unique(subject.boxes.agent[found], return_index=True)[1]] for found in rows]
    if UNTRACKED_ID in collision.ids or not all(len(found) for found in rows):
        return None
    first, second = (np.asarray(polygons(_footprints(subject, found))) for found in rows)
    return float(np.min(distance(first[:, None], second[None])))


def _footprints(subject: Subject, rows: IntArray) -> FloatArray:
    """(M, 4, 2) corners in world, metres."""
    length, width = subject.boxes.labels.size[rows, 0], subject.boxes.labels.size[rows, 1]
    yaw = subject.yaw[rows]
    signs = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)]) / 2
    along = np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
    across = np.stack([-np.sin(yaw), np.cos(yaw)], axis=-1)
    corners: FloatArray = (
        subject.centers[rows, None, :2]
        + signs[None, :, :1] * (length[:, None] * along)[:, None]
        + signs[None, :, 1:] * (width[:, None] * across)[:, None]
    )
    return corners


def _at_meta(subject: Subject, code: str, what: str) -> Finding:
    return subject.finding(code, str(subject.files.scenario.meta_path), what)


_CHECKS: tuple[Callable[[Subject, Meta], Iterator[Finding]], ...] = (_words, _counts, _folder, _pair, _impact)
