"""A scenario of a release that mutations may change, and that can be put back as it was."""

import io
import pickle
import shutil
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from deepaccident_devkit.files import write_bytes
from deepaccident_devkit.release import ScenarioFolder
from deepaccident_devkit.release.layout import frame_numbers
from deepaccident_devkit.taxonomy import CHANNEL_FORMAT, OWN_ACTOR_ID, VEHICLE_AGENTS

Rows = list[list[str]]
"""The words of a label file's lines; the first line is the header."""
Sightings = Mapping[str, Mapping[int, Mapping[int, np.ndarray]]]
"""Agent → actor id → frame → place in the world (x, y, z), metres, CARLA's signs."""

ENDINGS = {"label": "txt", "calib": "pkl", **CHANNEL_FORMAT}
"""Kind of file → its ending."""
_FIELDS = ("class", "x", "y", "z", "l", "w", "h", "yaw", "vx", "vy", "id", "points", "visible")
FIELD = {name: place for place, name in enumerate(_FIELDS)}
"""Field of a label line → its place in the line."""
NEAR = 35.0
"""Metres within which an agent does not lose sight of anybody."""
LEAST_MOVE = 0.4
"""What counts as moving, metres a frame."""


class Place:
    """One scenario; every change goes through here, is noted, and undone by `restore`.

    Files are always replaced, never written into, so a release of hard links is safe.
    """

    def __init__(self, root: Path, scenario: ScenarioFolder) -> None:
        self.root = root
        self.scenario = scenario
        self.token = scenario.token
        self.agents = scenario.agents
        self.frames = frame_numbers(scenario.kind_folder(scenario.agents[0], "calib"), "pkl")[0]
        self.before: dict[Path, bytes | None] = {}

    # ---- files

    def read(self, path: Path) -> bytes:
        return path.read_bytes()

    def write(self, path: Path, content: bytes) -> None:
        self._note(path)
        write_bytes(path, content)

    def remove(self, path: Path) -> None:
        self._note(path)
        path.unlink()

    def remove_folder(self, folder: Path) -> None:
        for path in _files_in(folder):
            self._note(path)
        shutil.rmtree(folder)

    def rename(self, path: Path, name: str) -> None:
        self.write(path.with_name(name), path.read_bytes())
        self.remove(path)

    def exchange(self, one: Path, other: Path) -> None:
        content, other_content = one.read_bytes(), other.read_bytes()
        self.write(one, other_content)
        self.write(other, content)

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

    def _note(self, path: Path) -> None:
        if path not in self.before:
            self.before[path] = path.read_bytes() if path.is_file() else None

    def file(self, agent: str, kind: str, frame: int) -> Path:
        return self.scenario.file(agent, kind, frame, ENDINGS[kind])

    def folder(self, agent: str, kind: str) -> Path:
        return self.scenario.kind_folder(agent, kind)

    # ---- contents

    def rows(self, agent: str, frame: int) -> Rows:
        return [line.split() for line in self.file(agent, "label", frame).read_text("ascii").splitlines()]

    def write_rows(self, agent: str, frame: int, rows: Rows) -> None:
        self.write(self.file(agent, "label", frame), "".join(" ".join(row) + "\n" for row in rows).encode("ascii"))

    def edit_rows(self, agent: str, frames: list[int], edit: Callable[[list[str]], None], **where: Any) -> None:
        """Apply `edit` to the box lines of the frames, or to those of one `actor` alone."""
        for frame in frames:
            rows = self.rows(agent, frame)
            for row in rows[1:]:
                if where.get("actor") in (None, int(row[FIELD["id"]])):
                    edit(row)
            self.write_rows(agent, frame, rows)

    def calib(self, agent: str, frame: int) -> dict[str, np.ndarray]:
        calib: dict[str, np.ndarray] = pickle.loads(self.file(agent, "calib", frame).read_bytes())
        return calib

    def write_calib(self, agent: str, frame: int, calib: Any) -> None:
        self.write(self.file(agent, "calib", frame), pickle.dumps(calib, protocol=3))

    def edit_calib(self, agent: str, frames: list[int], key: str, edit: Callable[[np.ndarray], np.ndarray]) -> None:
        for frame in frames:
            calib = self.calib(agent, frame)
            self.write_calib(agent, frame, {**calib, key: edit(calib[key])})

    def array(self, agent: str, channel: str, frame: int) -> np.ndarray:
        array: np.ndarray = np.load(self.file(agent, channel, frame))["data"]
        return array

    def write_array(self, agent: str, channel: str, frame: int, array: np.ndarray) -> None:
        content = io.BytesIO()
        np.savez(content, data=array)
        self.write(self.file(agent, channel, frame), content.getvalue())

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

        return str(rng.choice([agent for agent in self.agents if moves(agent)]))

    def any_frame(self, rng: np.random.Generator) -> int:
        return int(rng.choice(self.frames))

    def middle_frame(self, rng: np.random.Generator) -> int:
        """Not the first frame, and with both neighbours before the last two, when a collision may throw actors."""
        return int(rng.choice(self.frames[1:-3]))

    def position(self, agent: str, frame: int) -> np.ndarray:
        return self.calib(agent, frame)["ego_to_world"][:3, 3]

    @cached_property
    def sightings(self) -> Sightings:
        """Where each agent sees each tracked actor; of the healthy scenario, so ask before the first change."""
        return {agent: self._sightings_of(agent) for agent in self.agents}

    def _sightings_of(self, agent: str) -> dict[int, dict[int, np.ndarray]]:
        seen: dict[int, dict[int, np.ndarray]] = {}
        for frame in self.frames:
            calib = self.calib(agent, frame)
            world_from_lidar = calib["ego_to_world"] @ calib["lidar_to_ego"]
            for row in self.rows(agent, frame)[1:]:
                actor = int(row[FIELD["id"]])
                if actor > 0:
                    place = world_from_lidar @ [*map(float, row[1:4]), 1.0]
                    seen.setdefault(actor, {})[frame] = place[:3]
        return seen

    def steady(self, agent: str, *, moving: bool = False) -> set[int]:
        """Actors that the agent sees in every frame, and not for the moment alone."""
        return {
            actor
            for actor, places in self.sightings[agent].items()
            if len(places) == len(self.frames) and (not moving or self._moves(places))
        }

    def _moves(self, places: Mapping[int, np.ndarray]) -> bool:
        way = places[self.frames[-1]] - places[self.frames[0]]
        return way_length(way) > LEAST_MOVE * (len(self.frames) - 1)

    def shared_actor(
        self, rng: np.random.Generator, *, moving: bool = False, within: float = np.inf
    ) -> tuple[str, int]:
        """An agent and an actor that it (from within so many metres) and another agent see in every frame."""
        steady = {agent: self.steady(agent, moving=moving) for agent in self.agents}
        pairs = [
            (agent, actor)
            for agent in self.agents
            for actor in sorted(steady[agent])
            if any(actor in steady[other] for other in self.agents if other != agent)
            and self._is_near(agent, actor, within)
        ]
        return pairs[rng.integers(len(pairs))]

    def lone_actor(self, rng: np.random.Generator, *, vehicle: bool = False) -> tuple[str, int]:
        """An agent, alone from now on (the others' files are gone), and a near moving actor that it sees always."""
        agent = self.any_agent(rng)
        classes = {int(row[FIELD["id"]]): row[0] for row in self.rows(agent, self.frames[0])[1:]}
        actors = [
            actor
            for actor in sorted(self.steady(agent, moving=True))
            if self._is_near(agent, actor, NEAR)
            and (not vehicle or classes[actor] in ("car", "truck", "van"))
            and actor not in self.agent_ids()
        ]
        actor = actors[rng.integers(len(actors))]
        for other in self.agents:
            for kind in ENDINGS if other != agent else ():
                self.remove_folder(self.folder(other, kind))
        return agent, actor

    def _is_near(self, agent: str, actor: int, within: float) -> bool:
        places = self.sightings[agent][actor]
        return all(way_length(place - self.position(agent, frame)) <= within for frame, place in places.items())

    def agent_ids(self) -> list[int]:
        """Actor ids of the vehicle agents, as meta says."""
        line = next(line for line in self.meta_lines() if "agents id:" in line)
        return [int(word) for word in line.split(":")[1].split()]

    def meta_lines(self) -> list[str]:
        return self.scenario.meta_path.read_text("ascii").splitlines()

    def row_of(self, rows: Rows, actor: int) -> list[str]:
        return next(row for row in rows[1:] if int(row[FIELD["id"]]) == actor)

    def any_row(self, rng: np.random.Generator, rows: Rows) -> list[str]:
        """A box line that is not the agent's own."""
        others = [row for row in rows[1:] if int(row[FIELD["id"]]) != OWN_ACTOR_ID]
        return others[rng.integers(len(others))]


def way_length(way: np.ndarray) -> float:
    """Length over the ground, metres."""
    return float(np.hypot(way[0], way[1]))


def _files_in(folder: Path) -> Iterator[Path]:
    return (path for path in sorted(folder.rglob("*")) if path.is_file())


def _remove_empty(folder: Path, root: Path) -> None:
    while folder != root and folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()
        folder = folder.parent
