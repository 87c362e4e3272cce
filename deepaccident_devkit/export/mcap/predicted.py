"""Motion labels and predictions in an MCAP file; each cell of an actor is a coloured point."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from foxglove_schemas_protobuf.SpherePrimitive_pb2 import SpherePrimitive
from google.protobuf.wrappers_pb2 import DoubleValue

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.evaluation.drawing import (
    Drawing,
    DrawnBoxes,
    DrawnPath,
    DrawnPlaces,
    Role,
)
from deepaccident_devkit.evaluation.motion import predicted_instances
from deepaccident_devkit.evaluation.predictions import MotionOutput
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.export.mcap import Predictions
from deepaccident_devkit.export.mcap.messages import (
    COLORED_POINT,
    McapRecording,
    Moment,
    Roles,
    color_points,
    compute_box_segments,
    join_points,
    make_cloud,
    make_color,
    make_cube,
    make_entity,
    make_label,
    make_lines,
    make_pose,
    make_scene_update,
    make_vector,
    name_frame,
    parse_color,
    sample_segments,
)
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import (
    OWN_BOX_ID,
    MotionLabelConfig,
    MotionLabels,
    motion_labels_of,
)
from deepaccident_devkit.render.outcomes.described import task_drawing
from deepaccident_devkit.render.outcomes.drawings import ROLE_COLORS, path_opacity
from deepaccident_devkit.render.styles import (
    AGENT_COLORS,
    COLLIDER_COLOR,
    INSTANCE_COLORS,
)
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray
from deepaccident_devkit.taxonomy import CATEGORIES, INFRASTRUCTURE, POLE_HEIGHT

CELL_POINT: Final = np.dtype(
    [
        *((name, COLORED_POINT[name].str) for name in COLORED_POINT.names or ()),
        ("instance", "<i4"),
        ("frame", "<i4"),
    ]
)
"""A point of a map: `instance` is its id in the map; `frame` counts from 0, the current frame."""
FRAME_HEIGHT: Final = 0.2
"""Metres from each future frame up to the next one, so that no frame hides another one."""
# Share of its opacity that an instance loses until the last frame.
_FADED_SHARE = 0.6
# Height of paths above the ground, metres.
_PATH_HEIGHT_M = 0.1
# Viewers have dark backgrounds, so the truth is white there instead of black.
_COLORS: Mapping[Role, str] = {**ROLE_COLORS, "truth": "#ffffff"}
_TRUE_ROLES = ("truth", "missed")
# Diameter of the spheres at marked positions, and their height above the ground.
_MARK_DIAMETER_M = 1.0
_MARK_HEIGHT_M = 1.0
_NO_ROTATION = np.array([1.0, 0.0, 0.0, 0.0])


class MotionMapMessages:
    """Renderings of the motion labels of moments, in the agents' ego frames."""

    def __init__(self, dataset: Dataset, scenario: str, config: MotionLabelConfig) -> None:
        """Prepare the labels of a scenario."""
        self._dataset, self._config = dataset, config
        self._roles = Roles(dataset, scenario)

    def write(self, moment: Moment, recording: McapRecording) -> None:
        """Write the motion labels of all samples of a moment that have labels."""
        records = {}
        for agent, sample in moment.samples.items():
            record = self._dataset.get("sample", sample)
            if record["labelled"]:
                records[agent] = record
        all_labels = motion_labels_of(self._dataset, records.values(), self._config)
        for (agent, record), labels in zip(records.items(), all_labels, strict=True):
            own_actor = self._dataset.get("agent", record["agent_token"])["actor_id"]
            points = self._make_label_points(labels.to_present(), agent, own_actor)
            message = make_cloud(points, name_frame(agent, "ego"), moment.frame_number)
            recording.write(f"/{agent}/motion_labels/points", message, moment.frame_number)

    def _make_label_points(
        self, labels: MotionLabels, agent: str, own_actor: int | None
    ) -> AnyArray:
        """Return the points of an agent's labels; colliders and agents have their own colours."""
        colors = {}
        instances = {}
        for actor, instance in labels.id_map.items():
            if actor == OWN_BOX_ID:
                colors[instance] = AGENT_COLORS[agent]
                instances[own_actor] = instance
            else:
                instances[actor] = instance
        for known_actor, instance in instances.items():
            if known_actor in self._roles.pair:
                colors[instance] = COLLIDER_COLOR
            elif known_actor is not None and known_actor in self._roles.agents:
                colors[instance] = AGENT_COLORS[self._roles.agents[known_actor]]
        return make_cell_points(labels.instance, labels.config.grid, labels.label_valid, colors)


def make_cell_points(
    instance: AnyArray,
    grid: BevGrid,
    valid: BoolArray | None = None,
    colors: Mapping[int, str] | None = None,
) -> AnyArray:
    """Return the cells of instance maps as `CELL_POINT`s (N,), frame by frame.

    Later frames are paler and higher.

    Args:
        instance: Instance maps, shape (T, H, W), all in the ego frame at t = 0.
        grid: BEV grid of the maps.
        valid: Whether a frame counts, shape (T,); None for all.
        colors: Colour by id; all other ids take colours from a palette.
    """
    is_drawn = instance > 0
    if valid is not None:
        is_drawn &= valid[:, None, None]
    frame, row, column = np.nonzero(is_drawn)
    ids = instance[frame, row, column]
    unique_ids, id_index = np.unique(ids, return_inverse=True)
    points = np.zeros(len(ids), dtype=CELL_POINT)
    points["x"], points["y"] = grid.centers()[row, column].T
    points["z"] = frame * FRAME_HEIGHT
    point_colors = _choose_colors(unique_ids.tolist(), colors or {})[id_index.reshape(-1)]
    points["red"], points["green"], points["blue"] = point_colors.T
    last_frame = max(len(instance) - 1, 1)
    points["alpha"] = np.rint(255 * (1 - _FADED_SHARE * frame / last_frame))
    points["instance"] = ids
    points["frame"] = frame
    return points


def _choose_colors(ids: Sequence[int], fixed_colors: Mapping[int, str]) -> AnyArray:
    """Return the colour of each id, shape (N, 3) uint8."""
    colors = []
    for number in ids:
        default_color = INSTANCE_COLORS[number % len(INSTANCE_COLORS)]
        colors.append(parse_color(fixed_colors.get(number, default_color)))
    return np.array(colors, dtype=np.uint8).reshape(-1, 3)


class PredictedScenes:
    """Renderings of the predictions of moments, on topics below `/<agent>/prediction`."""

    def __init__(self, dataset: Dataset, prediction: Predictions, task: str | None = None) -> None:
        """Store predictions by sample token; raise ConfigError for an object of another type.

        `task` is the name of the task that draws them; None for the one that they are for.
        """
        if not isinstance(prediction, Results | Mapping):
            raise ConfigError(
                "prediction: expected Results, or a mapping from sample tokens to predictions, "
                f"found {type(prediction).__name__}"
            )
        self._dataset = dataset
        self._prediction = prediction
        self._task = task
        if task is None and isinstance(prediction, Results):
            self._task = prediction.task

    def has(self, sample: str) -> bool:
        """Return whether a sample has a prediction."""
        return sample in self._prediction

    def write(self, moment: Moment, recording: McapRecording) -> None:
        """Write the predictions for the samples of a moment.

        Raises ChoiceError for a prediction of an unknown type or for another task, and ResultsError
        if results cannot be read.
        """
        for agent, sample in moment.samples.items():
            if self.has(sample):
                if isinstance(self._prediction, Results):
                    prediction: object = self._prediction.prediction(sample)
                else:
                    prediction = self._prediction[sample]
                messages = _PredictionMessages(agent, moment.frame_number, recording)
                if isinstance(prediction, MotionOutput):
                    messages.write_cells(prediction)
                messages.write(task_drawing(self._dataset, sample, prediction, self._task))


class _PredictionMessages:
    """Renderings of the drawing of an agent's sample; positions are in its ego frame."""

    def __init__(self, agent: str, frame_number: int, recording: McapRecording) -> None:
        self._agent = agent
        self._frame_number = frame_number
        self._recording = recording
        self._topic = f"/{agent}/prediction"
        self._ground = -POLE_HEIGHT if agent == INFRASTRUCTURE else 0.0

    def write(self, drawing: Drawing) -> None:
        """Write paths, boxes and marks, and the score of the alarm."""
        self._write_scene("paths", "ego", [*map(self._render_path, drawing.paths)])
        boxes_frame = "ego"
        boxes = []
        for drawn in drawing.boxes:
            boxes_frame = drawn.boxes.frame
            boxes += self._render_boxes(drawn)
        self._write_scene("boxes", boxes_frame, boxes)
        self._write_scene("marks", "ego", [*map(self._render_places, drawing.places)])
        if drawing.alarm is not None:
            score = DoubleValue(value=drawing.alarm.score)
            self._recording.write(f"{self._topic}/alarm", score, self._frame_number)

    def write_cells(self, output: MotionOutput) -> None:
        """Write the cells of predicted instances."""
        points = make_cell_points(predicted_instances(output), output.grid)
        cloud = make_cloud(points, self._agent, self._frame_number)
        self._recording.write(f"{self._topic}/motion/points", cloud, self._frame_number)

    def _write_scene(
        self, name: str, frame: str, renderings: Sequence[tuple[Any, AnyArray]]
    ) -> None:
        """Write entities and their points; without entities, remove the topic's earlier ones."""
        topic = f"{self._topic}/{name}"
        if not renderings and topic not in self._recording.topics:
            return
        number = self._frame_number
        entities: list[Any] = []
        for entity, _ in renderings:
            entity.id = f"{entity.id} {len(entities)}"
            entities.append(entity)
        self._recording.write(topic, make_scene_update(entities, number), number)
        points = join_points([points for _, points in renderings])
        cloud = make_cloud(points, name_frame(self._agent, frame), number)
        self._recording.write(f"{topic}/points", cloud, number)

    def _render_path(self, path: DrawnPath) -> tuple[Any, AnyArray]:
        positions = self._at_height(path.xy, _PATH_HEIGHT_M)
        segments = np.stack([positions[:-1], positions[1:]], axis=1)
        color = _COLORS[path.role]
        opacity = path_opacity(path)
        facts = {
            "label": path.label,
            "probability": f"{path.probability:.3f}",
            "end": f"{path.times[-1]:.3f}",
        }
        lines = [make_lines(segments, color, opacity)]
        entity = make_entity(path.role, self._agent, self._frame_number, facts, lines=lines)
        return entity, sample_segments(segments, color, opacity)

    def _render_boxes(self, drawn: DrawnBoxes) -> list[tuple[Any, AnyArray]]:
        """Render boxes; true ones have no faces."""
        boxes = drawn.boxes
        frame = name_frame(self._agent, boxes.frame)
        color = _COLORS[drawn.role]
        renderings = []
        for row, segments in enumerate(compute_box_segments(boxes)):
            facts = {"label": drawn.label, "category": CATEGORIES[boxes.category[row]]}
            if drawn.scores is not None:
                facts["score"] = f"{drawn.scores[row]:.3f}"
            cubes = []
            if drawn.role not in _TRUE_ROLES:
                cubes = [make_cube(boxes, row, color)]
            entity = make_entity(
                drawn.role,
                frame,
                self._frame_number,
                facts,
                cubes=cubes,
                lines=[make_lines(segments, color)],
            )
            renderings.append((entity, sample_segments(segments, color)))
        return renderings

    def _render_places(self, places: DrawnPlaces) -> tuple[Any, AnyArray]:
        positions = self._at_height(places.xy, _MARK_HEIGHT_M)
        color = _COLORS[places.role]
        segments = np.stack([positions[:-1], positions[1:]], axis=1)
        label_position = positions.mean(axis=0) + np.array([0.0, 0.0, _MARK_DIAMETER_M])
        entity = make_entity(
            places.role,
            self._agent,
            self._frame_number,
            {"label": places.label, "note": places.note, "time": f"{places.time:.3f}"},
            spheres=[_make_sphere(position, color) for position in positions],
            lines=[make_lines(segments, color)],
            texts=[make_label(places.note, label_position, color)],
        )
        points = [color_points(positions, color), sample_segments(segments, color)]
        return entity, join_points(points)

    def _at_height(self, xy: FloatArray, height: float) -> FloatArray:
        """Return positions (N, 2) as points (N, 3) at a height above the ground, metres."""
        return np.column_stack([xy, np.full(len(xy), self._ground + height)])


def _make_sphere(position: FloatArray, color: str) -> Any:
    return SpherePrimitive(
        pose=make_pose(position, _NO_ROTATION),
        size=make_vector(np.full(3, _MARK_DIAMETER_M)),
        color=make_color(color, 0.8),
    )
