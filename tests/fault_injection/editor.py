"""An editor of one scenario that can undo its changes, and choices of frames for a mutation."""

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
Positions = Mapping[int, np.ndarray]
"""Frame → position of an actor in the world (x, y, z), metres, CARLA's signs."""
Sightings = Mapping[str, Mapping[int, Positions]]
"""Agent → actor id → positions in the frames in which the agent sees the actor."""

NEAR_DISTANCE_M = 35.0
"""Distance within which an agent does not lose sight of any actor."""
MIN_MOVE_M = 0.4
"""Distance from frame to frame that counts as moving."""


class NoVictimError(LookupError):
    """The scenario has no agent, actor or frame that a mutation can damage."""


class UndoableEditor(ScenarioEditor):
    """Editor of one scenario that records every change; `restore` undoes them."""

    def __init__(self, root: Path, scenario: ScenarioFolder) -> None:
        super().__init__(root, scenario)
        self.old_contents: dict[Path, bytes | None] = {}

    def changing(self, path: Path) -> None:
        """Save the content of a file before its first change; None if the file is a new one."""
        if path not in self.old_contents:
            self.old_contents[path] = _read_if_present(path)

    def restore(self) -> None:
        """Write every changed file's old content, and remove added files."""
        for path, content in self.old_contents.items():
            if content is None:
                path.unlink(missing_ok=True)
                _remove_empty_folders(path.parent, self.root)
        for path, content in self.old_contents.items():
            if content is not None:
                write_bytes(path, content)
        self.old_contents.clear()

    def changes(self) -> dict[str, bytes | None]:
        """Return the new content of each changed file; None if the file is gone."""
        contents = {path: _read_if_present(path) for path in self.old_contents}
        return {
            path.relative_to(self.root).as_posix(): content
            for path, content in contents.items()
            if content != self.old_contents[path]
        }

    def take_next(self, agent: str, kind: str, frame: int) -> None:
        """Replace an agent's file of a kind (`FILE_ENDINGS`) by that of the next frame."""
        self.take(agent, kind, frame, agent, frame + 1)

    def take(self, agent: str, kind: str, frame: int, other: str, other_frame: int) -> None:
        """Replace an agent's file of a kind by that of another agent or frame."""
        content = self.file(other, kind, other_frame).read_bytes()
        self.write(self.file(agent, kind, frame), content)

    def take_next_of_moving_agent(self, rng: np.random.Generator, kind: str) -> None:
        """Replace a moving agent's file of a kind by that of the next frame."""
        frame = int(rng.choice(self.frames[:-1]))
        self.take_next(self.moving_agent(rng, frame), kind, frame)

    def shift_one_frame_early(self, agent: str, kind: str) -> None:
        """Replace all of an agent's files of a kind, except the last, by the next frame's."""
        for frame in self.frames[:-1]:
            self.take_next(agent, kind, frame)

    def exchange_agents(self, agents: tuple[str, str], kind: str, frames: Sequence[int]) -> None:
        """Exchange two agents' files of a kind."""
        agent, other = agents
        for frame in frames:
            self.exchange(self.file(agent, kind, frame), self.file(other, kind, frame))

    def edit_any_row(self, rng: np.random.Generator, edit: Callable[[list[str]], object]) -> None:
        """Edit the words of one box line of one label file."""
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

    def any_vehicle(self, rng: np.random.Generator) -> str:
        vehicles = [agent for agent in self.agents if agent in VEHICLE_AGENTS]
        return str(rng.choice(vehicles))

    def two_agents(self, rng: np.random.Generator) -> tuple[str, str]:
        agent, other = rng.choice(self.agents, size=2, replace=False)
        return str(agent), str(other)

    def moving_agent(self, rng: np.random.Generator, frame: int | None = None) -> str:
        """Choose a vehicle that moves from the frame to the next, or over the whole scenario."""
        if frame is None:
            first, last = self.frames[0], self.frames[-1]
        else:
            first, last = frame, frame + 1
        moving = []
        for agent in self.agents:
            path = self.position(agent, last) - self.position(agent, first)
            if ground_length(path) > MIN_MOVE_M * (last - first):
                moving.append(agent)
        return one_of(moving, rng)

    def any_frame(self, rng: np.random.Generator) -> int:
        return int(rng.choice(self.frames))

    def middle_frame(self, rng: np.random.Generator) -> int:
        """Choose a frame that has both neighbours and lies before the last three.

        In the last frames a collision may throw actors.
        """
        return int(rng.choice(self.frames[1:-3]))

    def position(self, agent: str, frame: int) -> np.ndarray:
        return self.calib(agent, frame)["ego_to_world"][:3, 3]

    @cached_property
    def sightings(self) -> Sightings:
        """Where each agent sees each tracked actor in the healthy scenario.

        Ask for them before the first change.
        """
        return {agent: self._sightings_of(agent) for agent in self.agents}

    def _sightings_of(self, agent: str) -> dict[int, dict[int, np.ndarray]]:
        positions: dict[int, dict[int, np.ndarray]] = {}
        for frame in self.frames:
            calib = self.calib(agent, frame)
            world_from_lidar = calib["ego_to_world"] @ calib["lidar_to_ego"]
            for row in self.rows(agent, frame)[1:]:
                actor = int(row[FIELD["id"]])
                if actor > 0:
                    centre = [*map(float, row[1:4]), 1.0]
                    positions.setdefault(actor, {})[frame] = (world_from_lidar @ centre)[:3]
        return positions

    def actors_always_seen(self, agent: str, *, moving: bool = False) -> set[int]:
        """Return the actors that the agent sees in every frame, or only the moving ones of them."""
        return {
            actor
            for actor, positions in self.sightings[agent].items()
            if len(positions) == len(self.frames) and (not moving or self._moves(positions))
        }

    def _moves(self, positions: Positions) -> bool:
        path = positions[self.frames[-1]] - positions[self.frames[0]]
        return ground_length(path) > MIN_MOVE_M * (len(self.frames) - 1)

    def shared_actor(
        self, rng: np.random.Generator, *, moving: bool = False, within: float = np.inf
    ) -> tuple[str, int]:
        """Choose an agent and an actor that this and another agent see in every frame.

        The actor is always at most `within` metres from the agent.
        """
        steady = {agent: self.actors_always_seen(agent, moving=moving) for agent in self.agents}
        pairs = []
        for agent in self.agents:
            seen_by_others = set().union(
                *(steady[other] for other in self.agents if other != agent)
            )
            for actor in sorted(steady[agent] & seen_by_others):
                if self._is_near(agent, actor, within):
                    pairs.append((agent, actor))
        return one_of(pairs, rng)

    def steady_actors(
        self, rng: np.random.Generator, count: int, *, moving: bool = False
    ) -> tuple[str, list[int]]:
        """Choose an agent and `count` of the actors that it sees in every frame."""
        steady = {
            agent: sorted(self.actors_always_seen(agent, moving=moving)) for agent in self.agents
        }
        agent = one_of([agent for agent in self.agents if len(steady[agent]) >= count], rng)
        actors = rng.choice(steady[agent], size=count, replace=False)
        return agent, actors.tolist()

    def lone_actor(self, rng: np.random.Generator, *, vehicle: bool = False) -> tuple[str, int]:
        """Choose an agent and a near moving actor that it always sees; remove all other agents.

        The agent's labels include hidden actors: from other labels an actor may be missing because
        it is hidden.
        """
        classes = {
            int(row[FIELD["id"]]): row[0]
            for agent in self.agents
            for row in self.rows(agent, self.frames[0])[1:]
        }
        agent_ids = self.agent_ids()
        pairs = []
        for agent in filter(self._annotates_hidden_actors, self.agents):
            for actor in sorted(self.actors_always_seen(agent, moving=True)):
                fits = not vehicle or classes[actor] in ("car", "truck", "van")
                if fits and actor not in agent_ids and self._is_near(agent, actor, NEAR_DISTANCE_M):
                    pairs.append((agent, actor))

        chosen_agent, actor = one_of(pairs, rng)
        for other in self.agents:
            if other != chosen_agent:
                for kind in FILE_ENDINGS:
                    self.remove_folder(self.folder(other, kind))
        return chosen_agent, actor

    def _annotates_hidden_actors(self, agent: str) -> bool:
        return any(
            int(row[FIELD["id"]]) > 0
            and int(row[FIELD["num_lidar_pts"]]) == 0
            and row[FIELD["camera_visible"]] == "False"
            and np.hypot(float(row[FIELD["x"]]), float(row[FIELD["y"]])) < NEAR_DISTANCE_M
            for frame in self.frames
            for row in self.rows(agent, frame)[1:]
        )

    def _is_near(self, agent: str, actor: int, max_distance: float) -> bool:
        return all(
            ground_length(position - self.position(agent, frame)) <= max_distance
            for frame, position in self.sightings[agent][actor].items()
        )

    def agent_ids(self) -> list[int]:
        """Return the vehicle agents' actor ids from the meta file."""
        line = next(line for line in self.meta_lines() if "agents id:" in line)
        return [int(word) for word in line.split(":")[1].split()]

    def row_of(self, rows: LabelRows, actor: int) -> list[str]:
        return next(row for row in rows[1:] if int(row[FIELD["id"]]) == actor)

    def any_row(self, rng: np.random.Generator, rows: LabelRows) -> list[str]:
        """Choose a box line that is not the agent's own."""
        other_rows = [row for row in rows[1:] if int(row[FIELD["id"]]) != OWN_ACTOR_ID]
        return other_rows[rng.integers(len(other_rows))]


FrameChoice = Callable[[UndoableEditor, np.random.Generator], Sequence[int]]


def all_frames(editor: UndoableEditor, _: np.random.Generator) -> Sequence[int]:
    return editor.frames


def one_frame(editor: UndoableEditor, rng: np.random.Generator) -> Sequence[int]:
    return [editor.any_frame(rng)]


def one_middle_frame(editor: UndoableEditor, rng: np.random.Generator) -> Sequence[int]:
    return [editor.middle_frame(rng)]


def one_of(candidates: Sequence[Candidate], rng: np.random.Generator) -> Candidate:
    """Choose one of the candidates. Raises NoVictimError if there is none."""
    if not candidates:
        raise NoVictimError("nobody in this scenario is what the mutation needs")
    return candidates[rng.integers(len(candidates))]


def ground_length(vector: np.ndarray) -> float:
    """Return the length of a vector over the ground (x, y), in metres."""
    return float(np.hypot(vector[0], vector[1]))


def _read_if_present(path: Path) -> bytes | None:
    return path.read_bytes() if path.is_file() else None


def _remove_empty_folders(folder: Path, root: Path) -> None:
    while folder != root and folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()
        folder = folder.parent
