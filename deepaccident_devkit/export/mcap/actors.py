"""The actors of a moment: the union of all agents' boxes, and each agent's own boxes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray, IntArray
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.export.mcap.drawing import (
    above,
    box_segments,
    cube,
    entity,
    joined,
    label,
    lines,
    scene_update,
    segment_points,
    strip,
    strip_points,
)
from deepaccident_devkit.export.mcap.messages import cloud_message, frame_id
from deepaccident_devkit.export.mcap.moment import Moment
from deepaccident_devkit.export.mcap.recording import Recording
from deepaccident_devkit.export.mcap.roles import Roles
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.render.colors import AGENT_COLORS
from deepaccident_devkit.render.roles import role_colors
from deepaccident_devkit.taxonomy import AGENTS, CATEGORIES, UNTRACKED_ID
from deepaccident_devkit.v2x import cooperative_view
from deepaccident_devkit.v2x.cooperation import visible_actors
from deepaccident_devkit.v2x.tracks import scenario_tracks

TRAIL_FRAMES: Final = 20
"""How many frames (2 s) an actor's trail goes back, and its path goes ahead."""
_PATH_ALPHA: Final = 0.5


class Actors:
    """Renders the boxes of moments."""

    def __init__(self, dataset: Dataset, scenario: str) -> None:
        """Prepare the boxes of a scenario."""
        self._dataset = dataset
        self._roles = Roles(dataset, scenario)
        tracks = scenario_tracks(dataset, scenario)
        self._paths: Mapping[int, tuple[IntArray, FloatArray]] = {
            actor: (tracks.index[rows], tracks.boxes.center[rows])
            for actor in np.unique(tracks.actor_id).tolist()
            for rows in [np.flatnonzero(tracks.actor_id == actor)]
        }

    def write(self, moment: Moment, recording: Recording) -> None:
        """Write all actors of a moment in world, and the annotations of each agent in its LiDAR frame."""
        self._write_actors(moment, recording)
        for agent, sample in moment.samples.items():
            if self._dataset.get("sample", sample)["labelled"]:
                self._write_annotations(agent, sample, moment.index, recording)

    def _write_actors(self, moment: Moment, recording: Recording) -> None:
        view = cooperative_view(self._dataset, moment.first_sample, agents=tuple(moment.samples))
        boxes, segments = view.boxes, box_segments(view.boxes)
        colors = role_colors(self._dataset, moment.first_sample, boxes)
        seen = {
            agent: set(visible_actors(self._dataset, sample, agents=(agent,)).tolist())
            for agent, sample in moment.samples.items()
        }
        entities, points = [], []
        for row, actor in enumerate(boxes.actor_id.tolist()):
            color = colors[row]
            trail, path = self._trail(actor, moment.index)
            annotated = [name for bit, name in enumerate(AGENTS) if view.seen_by[row] >> bit & 1]
            facts = {
                **self._facts(boxes, row, actor),
                "annotated_by": ", ".join(annotated),
                "seen_by": ", ".join(agent for agent, actors in seen.items() if actor in actors),
            }
            name = str(actor)
            if actor == UNTRACKED_ID:
                name = f"untracked/{AGENTS[view.source[row]]}/{boxes.row[row]}"
            entities.append(
                entity(
                    name,
                    "world",
                    moment.index,
                    facts,
                    cubes=[cube(boxes, row, color)],
                    lines=[
                        lines(segments[row, -1:], color),
                        *(strip(part, color) for part in (trail, path) if len(part) > 1),
                    ],
                    texts=[label(facts["text"], above(boxes, row), color)],
                )
            )
            points += [
                segment_points(segments[row], color),
                strip_points(trail, color),
                strip_points(path, color, _PATH_ALPHA),
            ]
        recording.write("/actors", scene_update(entities, moment.index), moment.index)
        recording.write("/actors/points", cloud_message(joined(points), "world", moment.index), moment.index)

    def _write_annotations(self, agent: str, sample: str, index: int, recording: Recording) -> None:
        boxes, actors = self._dataset.boxes(sample, "lidar"), self._dataset.actor_ids(sample).tolist()
        segments, color = box_segments(boxes), AGENT_COLORS[agent]
        entities = []
        for row, actor in enumerate(actors):
            facts = {**self._facts(boxes, row, actor), "label_id": str(boxes.actor_id[row])}
            name = f"{actor}/{boxes.row[row]}"
            entities.append(entity(name, frame_id(agent, "lidar"), index, facts, lines=[lines(segments[row], color)]))
        frame = frame_id(agent, "lidar")
        recording.write(f"/{agent}/annotations", scene_update(entities, index), index)
        points = segment_points(segments.reshape(-1, 2, 3), color)
        recording.write(f"/{agent}/annotations/points", cloud_message(points, frame, index), index)

    def _facts(self, boxes: Boxes, row: int, actor: int) -> dict[str, str]:
        category, velocity = CATEGORIES[boxes.category[row]], boxes.velocity[row]
        role = self._roles.role(actor)
        identity = "untracked" if actor == UNTRACKED_ID else str(actor)
        return {
            "text": f"{category} {identity}" + (f" ({role})" if role else ""),
            "actor_id": identity,
            "category": category,
            "role": role,
            "speed": f"{np.linalg.norm(velocity):.2f}",
            "velocity": " ".join(f"{value:.3f}" for value in velocity.tolist()),
            "size": " ".join(f"{value:.3f}" for value in boxes.size[row].tolist()),
            "num_lidar_pts": str(boxes.num_lidar_pts[row]),
            "camera_visible": str(bool(boxes.camera_visible[row])).lower(),
        }

    def _trail(self, actor: int, index: int) -> tuple[FloatArray, FloatArray]:
        """Where an actor was and where it will be, (n, 3) each, in world; both include the present."""
        none = np.zeros((0, 3))
        frames, centers = self._paths.get(actor, (np.zeros(0, dtype=np.int64), none))
        past = (frames <= index) & (frames >= index - TRAIL_FRAMES)
        future = (frames >= index) & (frames <= index + TRAIL_FRAMES)
        return centers[past], centers[future]
