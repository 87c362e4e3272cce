"""Meta files `meta/<scenario>.txt`: setup and end of a scenario (docs/format.md, Meta)."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

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
_SHORT_NAMES = {name: short for short, name in META_AGENTS.items()}


@dataclass(frozen=True, slots=True, kw_only=True)
class Collision:
    """Collision that ended a scenario.

    Attributes:
        ids: Actor ids of the pair.
        classes: Category names of the pair (`pedestrian` is possible).
        impact: The simulator's impulse of the contact.
        spawn_relation: Relation of the spawn points in the words of the file, such as `same`.
        contact_side: Side of the contact in the words of the file, such as `front_side`.
        agents: Agents of the pair, None for a road user that records nothing; None if the file
            lacks them.
    """

    ids: tuple[int, int]
    classes: tuple[str, str]
    impact: float
    spawn_relation: str
    contact_side: str
    agents: tuple[AgentName | None, AgentName | None] | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Meta(ShortRepr):
    """Content of a meta file; None where the file lacks the line.

    Attributes:
        weather: Weather, such as `HardRain`.
        time_of_day: Time of day, `Noon`, `Sunset` or `Night`.
        collision: Collision at the end; None if the scenario ended without one.
        simulated_frames: Number of the recorded frames and 10 of warm-up.
        agent_ids: Actor ids of ego, ego_behind, other, other_behind.
        road_type: Road type, `four-way junction` or `three-way junction`.
        spawn_side: Side from which the other vehicle comes: `left`, `right` or `opposite…`.
        ego_direction: Direction of the ego, `straight`, `left` or `right`.
        other_direction: Direction of the other vehicle, `straight`, `left` or `right`.
        planned_agents: Pair that `colliding agents:` names in a scenario without a collision: the
            two agents that should have collided. None if it names no agents, or if there was a
            collision.
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
    planned_agents: tuple[AgentName | None, AgentName | None] | None = None

    @property
    def recorded_frames(self) -> int:
        """Number of frames of a complete recording."""
        return self.simulated_frames - WARM_UP_FRAMES


def read_meta(path: ReleasePath) -> Meta:
    """Return the content of a meta file.

    Raises:
        MissingFileError: There is no such file.
        MetaError: The first line does not have nine words, or has a word instead of a number, or
            another line's ids are no numbers.
    """
    numbered_lines = []
    for number, line in enumerate(read_lines(path, "meta", MetaError), start=1):
        if line.strip():
            numbered_lines.append((number, line.strip()))
    if not numbered_lines:
        raise MetaError(f"{path}:1: expected '{_FIRST_LINE}', found an empty file; {REMEDY}")
    return _parse(path, numbered_lines[0], _entries(path, numbered_lines[1:]))


def write_meta(path: Path, meta: Meta) -> None:
    """Write a meta file like the release's generator.

    All lines after the first begin with a blank, and the last one has no line end.
    """
    collision = meta.collision
    words: list[object] = [meta.weather + (meta.time_of_day or "")]
    if collision is None:
        words += [UNTRACKED_ID] * 7
    else:
        (id1, id2), (class1, class2) = collision.ids, collision.classes
        words += [
            id1,
            class1,
            id2,
            class2,
            collision.impact,
            collision.spawn_relation,
            collision.contact_side,
        ]
    lines = [" ".join(map(str, [*words, meta.simulated_frames]))]
    agents = collision.agents if collision else meta.planned_agents or (None, None)
    entries = {
        "colliding agents": agents and " ".join(_SHORT_NAMES[agent] for agent in agents),
        "agents id": meta.agent_ids and " ".join(map(str, meta.agent_ids)),
        "road_type": meta.road_type,
        "another_vehicle_spawn_side": meta.spawn_side,
        "ego_vehicle_direction": meta.ego_direction,
        "other_vehicle_direction": meta.other_direction,
    }
    lines += [f" {key}: {value}" for key, value in entries.items() if value is not None]
    write_bytes(path, "\n".join(lines).encode())


def _entries(path: ReleasePath, lines: Sequence[tuple[int, str]]) -> dict[str, tuple[int, str]]:
    """Return key → (line number, value) of the lines after the first."""
    entries = {}
    for number, line in lines:
        key, colon, value = line.partition(":")
        if not colon:
            raise MetaError(
                f"{path}:{number}: expected '<key>: <value>', found {shortened(line)!r}; {REMEDY}"
            )
        entries[key.strip()] = (number, value.strip())
    return entries


def _parse(
    path: ReleasePath, first_line: tuple[int, str], entries: dict[str, tuple[int, str]]
) -> Meta:
    """Return the content of a file from its first line and its entries, or raise MetaError."""
    number, line = first_line
    words = line.split()
    if len(words) != 9:
        raise MetaError(
            f"{path}:{number}: expected 9 words '{_FIRST_LINE}', "
            f"found {len(words)}: {shortened(line)!r}; {REMEDY}"
        )
    location = f"{path}:{number}"
    weather, time_of_day = _weather_and_time(words[0])
    agents = _colliding_agents(path, entries)
    collision = _collision(location, words, agents)
    return Meta(
        weather=weather,
        time_of_day=time_of_day,
        collision=collision,
        simulated_frames=_integer(location, "simulated frames", words[8]),
        agent_ids=_agent_ids(path, entries),
        road_type=_text(entries, "road_type"),
        spawn_side=_text(entries, "another_vehicle_spawn_side"),
        ego_direction=_text(entries, "ego_vehicle_direction"),
        other_direction=_text(entries, "other_vehicle_direction"),
        planned_agents=None if collision or agents == (None, None) else agents,
    )


def _weather_and_time(word: str) -> tuple[str, str | None]:
    """Return the weather and the time of day in a word."""
    for time_of_day in TIMES_OF_DAY:
        if word.endswith(time_of_day) and word != time_of_day:
            return word.removesuffix(time_of_day), time_of_day
    return word, None


def _collision(
    location: str, words: Sequence[str], agents: tuple[AgentName | None, AgentName | None] | None
) -> Collision | None:
    """Return the collision in the words of the first line; None if there is none."""
    ids = (_integer(location, "first id", words[1]), _integer(location, "second id", words[3]))
    if UNTRACKED_ID in ids:
        return None
    return Collision(
        ids=ids,
        classes=(words[2], words[4]),
        impact=_finite(location, "impact", words[5]),
        spawn_relation=words[6],
        contact_side=words[7],
        agents=agents,
    )


def _colliding_agents(
    path: ReleasePath, entries: dict[str, tuple[int, str]]
) -> tuple[AgentName | None, AgentName | None] | None:
    """Return the agents of the entry `colliding agents`; None without it."""
    if "colliding agents" not in entries:
        return None
    number, value = entries["colliding agents"]
    names = value.split()
    if len(names) != 2 or not set(names) <= set(META_AGENTS):
        known = ", ".join(META_AGENTS)
        raise MetaError(
            f"{path}:{number}: expected two of {known}, found {shortened(value)!r}; {REMEDY}"
        )
    return META_AGENTS[names[0]], META_AGENTS[names[1]]


def _agent_ids(
    path: ReleasePath, entries: dict[str, tuple[int, str]]
) -> tuple[int, int, int, int] | None:
    """Return the ids of the entry `agents id`; None without it."""
    if "agents id" not in entries:
        return None
    number, value = entries["agents id"]
    ids = [_integer(f"{path}:{number}", "agent's id", word) for word in value.split()]
    if len(ids) != 4:
        raise MetaError(
            f"{path}:{number}: expected four agents' ids, found {shortened(value)!r}; {REMEDY}"
        )
    return ids[0], ids[1], ids[2], ids[3]


def _text(entries: dict[str, tuple[int, str]], key: str) -> str | None:
    """Return the value of an entry; None if it is missing or empty."""
    _, value = entries.get(key, (0, ""))
    return value or None


def _integer(location: str, name: str, word: str) -> int:
    """Return a word as an integer, or raise MetaError."""
    value = integer_of(word)
    if value is None:
        raise MetaError(
            f"{location}: {name}: expected an integer, found {shortened(word)!r}; {REMEDY}"
        )
    return value


def _finite(location: str, name: str, word: str) -> float:
    """Return a word as a finite number, or raise MetaError."""
    value = number_of(word)
    if value is None or not in_range(value):
        fault = f"found {shortened(word)!r} (at most {LARGEST_NUMBER:.0e} counts)"
        raise MetaError(f"{location}: {name}: expected a finite number, {fault}; {REMEDY}")
    return value
