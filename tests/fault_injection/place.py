"""A scenario of a release that mutations may change, and that can be put back as it was."""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np

from deepaccident_devkit.release import ScenarioFolder
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID, VEHICLE_AGENTS
from deepaccident_devkit.testing.breakages.breakage import (
    FIELD,
    FILE_ENDINGS,
    LabelRows,
    ScenarioEditor,
)

Candidate = TypeVar("Candidate")
Sightings = Mapping[str, Mapping[int, Mapping[int, np.ndarray]]]
"""Agent → actor id → frame → place in the world (x, y, z), metres, CARLA's signs."""

NEAR = 35.0
"""Metres within which an agent does not lose sight of anybody."""
LEAST_MOVE = 0.4
"""What counts as moving, metres a frame."""


class NoVictimError(LookupError):
    """Nobody in a scenario is what a mutation needs."""


class Place(ScenarioEditor):
    """One scenario; every change is noted, and undone by `restore`."""

    def __init__(self, root: Path, scenario: ScenarioFolder) -> None:
        super().__init__(root, scenario)
        self.before: dict[Path, bytes | None] = {}

    def changing(self, path: Path) -> None:
        """Note what a file held; nothing, if it is not there yet."""
        if path not in self.before:
            self.before[path] = path.read_bytes() if path.is_file() else None

    def restore(self) -> None:
        """Put every changed file back, and take away what was added."""
        for path in [path for path, content in self.before.items() if content is None]:
            path.unlink(missing_ok=True)
            _remove_empty(path.parent, self.root)
        for path, content in self.before.items():
            if content is not None:
                write_bytes(path, content)
        self.before.clear()

    def changes(self) -> dict[str, bytes | None]:
        """Changed file → its new content; None if it is gone."""
        now = {path: path.read_bytes() if path.is_file() else None for path in self.before}
        return {
            path.relative_to(self.root).as_posix(): content
            for path, content in now.items()
            if content != self.before[path]
        }

    def take_next(self, agent: str, kind: str, frame: int) -> None:
        """Replace an agent's file of a kind (`FILE_ENDINGS`) by the next frame's."""
        self.take(agent, kind, frame, agent, frame + 1)

    def take(self, agent: str, kind: str, frame: int, other: str, other_frame: int) -> None:
        """Replace an agent's file of a kind by another's or that of another frame."""
        self.write(self.file(agent, kind, frame), self.file(other, kind, other_frame).read_bytes())

    def moving_takes_next(self, rng: np.random.Generator, kind: str) -> None:
        """Replace a file of a kind of an agent that moves just then by the next frame's."""
        frame = int(rng.choice(self.frames[:-1]))
        self.take_next(self.moving_agent(rng, frame), kind, frame)

    def one_frame_early(self, agent: str, kind: str) -> None:
        """Replace all of an agent's files of a kind but the last by the next frame's."""
        for frame in self.frames[:-1]:
            self.take_next(agent, kind, frame)

    def exchange_agents(self, agents: tuple[str, str], kind: str, frames: Sequence[int]) -> None:
        """Exchange two agents' files of a kind."""
        one, other = agents
        for frame in frames:
            self.exchange(self.file(one, kind, frame), self.file(other, kind, frame))

    def edit_any_row(self, rng: np.random.Generator, edit: Callable[[list[str]], object]) -> None:
        """Edit the words of a box line of an agent's label at a frame."""
        agent, frame = self.any_agent(rng), self.any_frame(rng)
        rows = self.rows(agent, frame)
        edit(self.any_row(rng, rows))
        self.write_rows(agent, frame, rows)

    def remove_row(self, agent: str, frames: Sequence[int], actor: int) -> None:
        """Remove an actor's line from an agent's labels."""
        for frame in frames:
            rows = self.rows(agent, frame)
            rows.remove(self.row_of(rows, actor))
            self.write_rows(agent, frame, rows)

    # ---- victims; call these before changing anything

    def any_agent(self, rng: np.random.Generator) -> str:
        return str(rng.choice(self.agents))

    def vehicle(self, rng: np.random.Generator) -> str:
        return str(rng.choice([agent for agent in self.agents if agent in VEHICLE_AGENTS]))

    def two_agents(self, rng: np.random.Generator) -> tuple[str, str]:
        one, other = rng.choice(self.agents, size=2, replace=False)
        return str(one), str(other)

    def moving_agent(self, rng: np.random.Generator, frame: int | None = None) -> str:
        """A vehicle that moves from the frame to the next, or over the whole scenario."""
        first, last = (self.frames[0], self.frames[-1]) if frame is None else (frame, frame + 1)
        least = LEAST_MOVE * (last - first)

        def moves(agent: str) -> bool:
            start, end = self.position(agent, first), self.position(agent, last)
            return float(np.hypot(*(end - start)[:2])) > least

        return one_of([agent for agent in self.agents if moves(agent)], rng)

    def any_frame(self, rng: np.random.Generator) -> int:
        return int(rng.choice(self.frames))

    def middle_frame(self, rng: np.random.Generator) -> int:
        """Not the first frame, and with both neighbours before the last two, when a collision may
        throw actors.
        """
        return int(rng.choice(self.frames[1:-3]))

    def position(self, agent: str, frame: int) -> np.ndarray:
        return self.calib(agent, frame)["ego_to_world"][:3, 3]

    @cached_property
    def sightings(self) -> Sightings:
        """Where each agent sees each tracked actor; of the healthy scenario, so ask before the
        first change.
        """
        return {agent: self._sightings_of(agent) for agent in self.agents}

    def _sightings_of(self, agent: str) -> dict[int, dict[int, np.ndarray]]:
        seen: dict[int, dict[int, np.ndarray]] = {}
        for frame in self.frames:
            calib = self.calib(agent, frame)
            world_from_lidar = calib["ego_to_world"] @ calib["lidar_to_ego"]
            for row in self.rows(agent, frame)[1:]:
                actor = int(row[FIELD["id"]])
                if actor > 0:
                    seen.setdefault(actor, {})[frame] = (
                        world_from_lidar @ [*map(float, row[1:4]), 1.0]
                    )[:3]
        return seen

    def steady(self, agent: str, *, moving: bool = False) -> set[int]:
        """Actors that the agent sees in every frame, and not for the moment alone."""
        return {
            actor
            for actor, places in self.sightings[agent].items()
            if len(places) == len(self.frames) and (not moving or self._moves(places))
        }

    def _moves(self, places: Mapping[int, np.ndarray]) -> bool:
        return way_length(places[self.frames[-1]] - places[self.frames[0]]) > LEAST_MOVE * (
            len(self.frames) - 1
        )

    def shared_actor(
        self, rng: np.random.Generator, *, moving: bool = False, within: float = np.inf
    ) -> tuple[str, int]:
        """An agent and an actor that it (from within so many metres) and another agent see in every
        frame.
        """
        steady = {agent: self.steady(agent, moving=moving) for agent in self.agents}
        pairs = [
            (agent, actor)
            for agent in self.agents
            for actor in sorted(steady[agent])
            if any(actor in steady[other] for other in self.agents if other != agent)
            and self._is_near(agent, actor, within)
        ]
        return one_of(pairs, rng)

    def steady_ones(
        self, rng: np.random.Generator, count: int, *, moving: bool = False
    ) -> tuple[str, list[int]]:
        """An agent and so many of the actors that it sees in every frame."""
        agent = one_of(
            [agent for agent in self.agents if len(self.steady(agent, moving=moving)) >= count], rng
        )
        return agent, rng.choice(
            sorted(self.steady(agent, moving=moving)), size=count, replace=False
        ).tolist()

    def lone_actor(self, rng: np.random.Generator, *, vehicle: bool = False) -> tuple[str, int]:
        """An agent, alone from now on (the others' files are gone), and a near moving actor that it
        sees always.

        The agent's labels leave nobody out for being hidden: of others nobody can say whether an
        actor is missing.
        """
        classes = {
            int(row[FIELD["id"]]): row[0]
            for agent in self.agents
            for row in self.rows(agent, self.frames[0])[1:]
        }
        pairs = [
            (agent, actor)
            for agent in self.agents
            for actor in sorted(self.steady(agent, moving=True))
            if self._annotates_the_hidden(agent)
            and self._is_near(agent, actor, NEAR)
            and (not vehicle or classes[actor] in ("car", "truck", "van"))
            and actor not in self.agent_ids()
        ]
        agent, actor = one_of(pairs, rng)
        for other in self.agents:
            for kind in FILE_ENDINGS if other != agent else ():
                self.remove_folder(self.folder(other, kind))
        return agent, actor

    def _annotates_the_hidden(self, agent: str) -> bool:
        return any(
            int(row[FIELD["id"]]) > 0
            and int(row[FIELD["num_lidar_pts"]]) == 0
            and row[FIELD["camera_visible"]] == "False"
            and np.hypot(float(row[FIELD["x"]]), float(row[FIELD["y"]])) < NEAR
            for frame in self.frames
            for row in self.rows(agent, frame)[1:]
        )

    def _is_near(self, agent: str, actor: int, within: float) -> bool:
        places = self.sightings[agent][actor]
        return all(
            way_length(place - self.position(agent, frame)) <= within
            for frame, place in places.items()
        )

    def agent_ids(self) -> list[int]:
        """Actor ids of the vehicle agents, as meta says."""
        line = next(line for line in self.meta_lines() if "agents id:" in line)
        return [int(word) for word in line.split(":")[1].split()]

    def row_of(self, rows: LabelRows, actor: int) -> list[str]:
        return next(row for row in rows[1:] if int(row[FIELD["id"]]) == actor)

    def any_row(self, rng: np.random.Generator, rows: LabelRows) -> list[str]:
        """A box line that is not the agent's own."""
        others = [row for row in rows[1:] if int(row[FIELD["id"]]) != OWN_ACTOR_ID]
        return others[rng.integers(len(others))]


Frames = Callable[[Place, np.random.Generator], Sequence[int]]


def always(place: Place, _: np.random.Generator) -> Sequence[int]:
    """All frames."""
    return place.frames


def once(place: Place, rng: np.random.Generator) -> Sequence[int]:
    """Any frame."""
    return [place.any_frame(rng)]


def in_the_middle(place: Place, rng: np.random.Generator) -> Sequence[int]:
    """A frame in the middle (`Place.middle_frame`)."""
    return [place.middle_frame(rng)]


def one_of(candidates: Sequence[Candidate], rng: np.random.Generator) -> Candidate:
    """Any of the candidates. Raises NoVictimError if there is none."""
    if not candidates:
        raise NoVictimError("nobody in this scenario is what the mutation needs")
    return candidates[rng.integers(len(candidates))]


def way_length(way: np.ndarray) -> float:
    """Length over the ground, metres."""
    return float(np.hypot(way[0], way[1]))


def _remove_empty(folder: Path, root: Path) -> None:
    while folder != root and folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()
        folder = folder.parent
