"""Meta files `meta/<scenario>.txt`: setup and end of a scenario (docs/format.md, Meta)."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from deepaccident_devkit.errors import MetaError, shortened
from deepaccident_devkit.release.store import REMEDY, ReleasePath, read_lines
from deepaccident_devkit.support.arrays import LARGEST_NUMBER, ShortRepr, in_range
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.text import integer_of, number_of
from deepaccident_devkit.taxonomy import (
    META_AGENTS,
    TIMES_OF_DAY,
    UNTRACKED_ID,
    WARM_UP_FRAMES,
    AgentName,
)

_FIRST_LINE = (
    "<weather+time> <id1> <class1> <id2> <class2> <impact> <spawn relation> <contact side> <frames>"
)
# Agents of a pair; None for a road user that records nothing.
AgentPair: TypeAlias = tuple[AgentName | None, AgentName | None]
# Key → line number and value.
_Entries: TypeAlias = dict[str, tuple[int, str]]
_SHORT_NAMES = {name: short for short, name in META_AGENTS.items()}


@dataclass(frozen=True, slots=True, kw_only=True)
class Collision:
    """Collision that ended a scenario.

    Attributes:
        ids: Actor ids of the pair.
        classes: Category names of the pair (`pedestrian` is possible).
        impact: The simulator's collision impulse.
        spawn_relation: Relation of the spawn points, as in the file, such as `same`.
        contact_side: Side of the contact, as in the file, such as `front_side`.
        agents: Agents of the pair, None for a road user that records nothing; None if the file
            lacks them.
    """

    ids: tuple[int, int]
    classes: tuple[str, str]
    impact: float
    spawn_relation: str
    contact_side: str
    agents: AgentPair | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Meta(ShortRepr):
    """Content of a meta file; a field is None if the file lacks its line.

    Attributes:
        weather: Weather, such as `HardRain`.
        time_of_day: Time of day, `Noon`, `Sunset` or `Night`.
        collision: Collision at the end; None if the scenario ended without one.
        simulated_frames: Number of frames, including 10 of warm-up before the recording.
        agent_ids: Actor ids of ego, ego_behind, other, other_behind.
        road_type: Road type, `four-way junction` or `three-way junction`.
        spawn_side: Side from which the other vehicle comes: `left`, `right` or `opposite…`.
        ego_direction: Direction of the ego, `straight`, `left` or `right`.
        other_direction: Direction of the other vehicle, `straight`, `left` or `right`.
        planned_agents: The two agents that should have collided, which `colliding agents:` names in
            a scenario without a collision. None if it names none, or if there was a collision.
    """

    weather: str
    time_of_day: str | None
    collision: Collision | None
    simulated_frames: int
    agent_ids: tuple[int, int, int, int] | None = None
    road_type: str | None = None
    spawn_side: str | None = None
    ego_direction: str | None = None
    other_direction: str | None = None
    planned_agents: AgentPair | None = None

    @property
    def recorded_frames(self) -> int:
        """Number of frames that a complete recording has."""
        return self.simulated_frames - WARM_UP_FRAMES


def read_meta(path: ReleasePath) -> Meta:
    """Read the content of a meta file.

    Raises:
        MissingFileError: If the file does not exist.
        MetaError: If the first line does not have nine words or has a word instead of a number, or
            if the ids in another line are not numbers.
    """
    numbered_lines = []
    for number, line in enumerate(read_lines(path, "meta", MetaError), start=1):
        if line.strip():
            numbered_lines.append((number, line.strip()))
    if not numbered_lines:
        raise MetaError(f"{path}:1: expected '{_FIRST_LINE}', found an empty file; {REMEDY}")
    entries = _parse_entries(path, numbered_lines[1:])
    number, line = numbered_lines[0]
    words = line.split()
    if len(words) != 9:
        raise MetaError(
            f"{path}:{number}: expected 9 words '{_FIRST_LINE}', "
            f"found {len(words)}: {shortened(line)!r}; {REMEDY}"
        )
    location = f"{path}:{number}"
    weather, time_of_day = _split_weather_and_time(words[0])
    agents = _parse_colliding_agents(path, entries)
    collision = _parse_collision(location, words, agents)
    return Meta(
        weather=weather,
        time_of_day=time_of_day,
        collision=collision,
        simulated_frames=_parse_integer(location, "simulated frames", words[8]),
        agent_ids=_parse_agent_ids(path, entries),
        road_type=_get_text(entries, "road_type"),
        spawn_side=_get_text(entries, "another_vehicle_spawn_side"),
        ego_direction=_get_text(entries, "ego_vehicle_direction"),
        other_direction=_get_text(entries, "other_vehicle_direction"),
        planned_agents=None if collision or agents == (None, None) else agents,
    )


def write_meta(path: Path, meta: Meta) -> None:
    """Write a meta file in the format of the release's generator.

    All lines after the first start with a blank, and the last one has no line end.
    """
    collision = meta.collision
    words: list[object] = [meta.weather + (meta.time_of_day or "")]
    if collision is None:
        words += [UNTRACKED_ID] * 7
    else:
        for actor_id, category in zip(collision.ids, collision.classes, strict=True):
            words += [actor_id, category]
        words += [
            collision.impact,
            collision.spawn_relation,
            collision.contact_side,
        ]
    words.append(meta.simulated_frames)
    lines = [" ".join(map(str, words))]
    if collision:
        agents = collision.agents
    else:
        agents = meta.planned_agents or (None, None)
    entries = {
        "colliding agents": agents and " ".join([_SHORT_NAMES[agent] for agent in agents]),
        "agents id": meta.agent_ids and " ".join(map(str, meta.agent_ids)),
        "road_type": meta.road_type,
        "another_vehicle_spawn_side": meta.spawn_side,
        "ego_vehicle_direction": meta.ego_direction,
        "other_vehicle_direction": meta.other_direction,
    }
    lines += [f" {key}: {value}" for key, value in entries.items() if value is not None]
    write_bytes(path, "\n".join(lines).encode())


def _parse_entries(path: ReleasePath, lines: Sequence[tuple[int, str]]) -> _Entries:
    """Return key → line number and value, from the lines after the first."""
    entries = {}
    for number, line in lines:
        key, colon, value = line.partition(":")
        if not colon:
            raise MetaError(
                f"{path}:{number}: expected '<key>: <value>', found {shortened(line)!r}; {REMEDY}"
            )
        entries[key.strip()] = (number, value.strip())
    return entries


def _split_weather_and_time(word: str) -> tuple[str, str | None]:
    """Split a word into the weather and the time of day (None if absent)."""
    for time_of_day in TIMES_OF_DAY:
        if word.endswith(time_of_day) and word != time_of_day:
            return word.removesuffix(time_of_day), time_of_day
    return word, None


def _parse_collision(
    location: str, words: Sequence[str], agents: AgentPair | None
) -> Collision | None:
    """Return the collision described by the first line; None if there was none."""
    first_id = _parse_integer(location, "first id", words[1])
    second_id = _parse_integer(location, "second id", words[3])
    ids = (first_id, second_id)
    if UNTRACKED_ID in ids:
        return None
    return Collision(
        ids=ids,
        classes=(words[2], words[4]),
        impact=_parse_finite(location, "impact", words[5]),
        spawn_relation=words[6],
        contact_side=words[7],
        agents=agents,
    )


def _parse_colliding_agents(path: ReleasePath, entries: _Entries) -> AgentPair | None:
    """Return the agents of the entry `colliding agents`; None without it."""
    if "colliding agents" not in entries:
        return None
    number, value = entries["colliding agents"]
    names = value.split()
    if len(names) != 2 or not set(names) <= set(META_AGENTS):
        known_agents = ", ".join(META_AGENTS)
        raise MetaError(
            f"{path}:{number}: expected two of {known_agents}, found {shortened(value)!r}; {REMEDY}"
        )
    return META_AGENTS[names[0]], META_AGENTS[names[1]]


def _parse_agent_ids(path: ReleasePath, entries: _Entries) -> tuple[int, int, int, int] | None:
    """Return the ids of the entry `agents id`; None without it."""
    if "agents id" not in entries:
        return None
    number, value = entries["agents id"]
    ids = [_parse_integer(f"{path}:{number}", "agent's id", word) for word in value.split()]
    if len(ids) != 4:
        raise MetaError(
            f"{path}:{number}: expected four agents' ids, found {shortened(value)!r}; {REMEDY}"
        )
    return ids[0], ids[1], ids[2], ids[3]


def _get_text(entries: _Entries, key: str) -> str | None:
    """Return the value of an entry; None if it is missing or empty."""
    _, value = entries.get(key, (0, ""))
    return value or None


def _parse_integer(location: str, name: str, word: str) -> int:
    """Parse an integer; raise MetaError if the word is not one."""
    value = integer_of(word)
    if value is None:
        raise MetaError(
            f"{location}: {name}: expected an integer, found {shortened(word)!r}; {REMEDY}"
        )
    return value


def _parse_finite(location: str, name: str, word: str) -> float:
    """Parse a finite number; raise MetaError if the word is not one."""
    value = number_of(word)
    if value is None or not in_range(value):
        fault = f"found {shortened(word)!r} (at most {LARGEST_NUMBER:.0e} is allowed)"
        raise MetaError(f"{location}: {name}: expected a finite number, {fault}; {REMEDY}")
    return value
