"""Motion labels as coloured points, one for each cell of an actor; and predictions beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from foxglove_schemas_protobuf.SpherePrimitive_pb2 import SpherePrimitive

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.evaluation.detection import DetectedBoxes
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.export.mcap import Predictions
from deepaccident_devkit.export.mcap.messages import (
    COLORED_POINT,
    McapRecording,
    Moment,
    Roles,
    box_segments,
    cloud_message,
    color_message,
    colored_points,
    cube,
    entity,
    frame_id,
    join_points,
    label,
    lines,
    pose,
    rgb,
    scene_update,
    segment_points,
    vector,
)
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import (
    OWN_BOX_ID,
    MotionLabelConfig,
    MotionLabels,
    motion_labels_of,
    predict_instances,
)
from deepaccident_devkit.render.styles import (
    AGENT_COLORS,
    COLLIDER_COLOR,
    INSTANCE_COLORS,
    PREDICTED_COLOR,
)
from deepaccident_devkit.support.arrays import AnyArray, BoolArray
from deepaccident_devkit.taxonomy import CATEGORIES

CELL_POINT: Final = np.dtype(
    [
        *((name, COLORED_POINT[name].str) for name in COLORED_POINT.names or ()),
        ("instance", "<i4"),
        ("frame", "<i4"),
    ]
)
"""A point of a map: `instance` is the map's id, `frame` counts from 0, the present."""
FRAME_HEIGHT: Final = 0.2
"""Metres from each future frame up to the next one, so that no frame hides another."""
# Share of its opacity that an instance loses until the last frame.
_FADED_SHARE: Final = 0.6
# Diameter of the spheres at the positions of a predicted accident, and their height.
_MARK_DIAMETER_M: Final = 1.0
_MARK_HEIGHT_M: Final = 1.0
_NO_ROTATION: Final = np.array([1.0, 0.0, 0.0, 0.0])


class MotionMapMessages:
    """Renders the motion labels of moments in the agents' ego frames."""

    def __init__(self, dataset: Dataset, scenario: str, config: MotionLabelConfig) -> None:
        """Prepare the labels of a scenario."""
        self._dataset, self._config = dataset, config
        self._roles = Roles(dataset, scenario)

    def write(self, moment: Moment, recording: McapRecording) -> None:
        """Write the motion labels of the samples of a moment that have labels."""
        records = {}
        for agent, sample in moment.samples.items():
            record = self._dataset.get("sample", sample)
            if record["labelled"]:
                records[agent] = record
        all_labels = motion_labels_of(self._dataset, records.values(), self._config)
        for (agent, record), labels in zip(records.items(), all_labels, strict=True):
            own_actor = self._dataset.get("agent", record["agent_token"])["actor_id"]
            points = self._points(labels.to_present(), agent, own_actor)
            message = cloud_message(points, frame_id(agent, "ego"), moment.index)
            recording.write(f"/{agent}/motion_labels/points", message, moment.index)

    def _points(self, labels: MotionLabels, agent: str, own_actor: int | None) -> AnyArray:
        """Return the points of an agent's labels; colliders and agents have their own colours."""
        colors = {}
        for actor, name in labels.id_map.items():
            if actor == OWN_BOX_ID:
                colors[name] = AGENT_COLORS[agent]
        actors = {}
        for actor, name in labels.id_map.items():
            actors[own_actor if actor == OWN_BOX_ID else actor] = name
        for known_actor, name in actors.items():
            if known_actor in self._roles.pair:
                colors[name] = COLLIDER_COLOR
            elif known_actor is not None and known_actor in self._roles.agents:
                colors[name] = AGENT_COLORS[self._roles.agents[known_actor]]
        return cell_points(labels.instance, labels.config.grid, labels.label_valid, colors)


def cell_points(
    instance: AnyArray,
    grid: BevGrid,
    valid: BoolArray | None = None,
    colors: Mapping[int, str] | None = None,
) -> AnyArray:
    """Return the cells of instance maps as points (N,) of `CELL_POINT`, by frame.

    Later frames are paler and higher.

    Args:
        instance: Instance maps, shape (T, H, W), all in the present ego frame.
        grid: BEV grid of the maps.
        valid: Whether a frame counts, shape (T,); None for all.
        colors: Id → colour; other ids have the colours of a palette.
    """
    count = len(instance)
    is_drawn = instance > 0
    if valid is not None:
        is_drawn &= valid[:, None, None]
    frame, row, column = np.nonzero(is_drawn)
    ids = instance[frame, row, column]
    unique_ids, id_index = np.unique(ids, return_inverse=True)
    points = np.zeros(len(ids), dtype=CELL_POINT)
    points["x"], points["y"] = grid.centers()[row, column].T
    points["z"] = frame * FRAME_HEIGHT
    point_colors = _colors(unique_ids.tolist(), colors or {})[id_index.reshape(-1)]
    points["red"], points["green"], points["blue"] = point_colors.T
    points["alpha"] = np.rint(255 * (1 - _FADED_SHARE * frame / max(count - 1, 1)))
    points["instance"], points["frame"] = ids, frame
    return points


def _colors(ids: Sequence[int], fixed_colors: Mapping[int, str]) -> AnyArray:
    """Return the colour of each id, shape (N, 3) uint8."""
    colors = []
    for number in ids:
        default_color = INSTANCE_COLORS[number % len(INSTANCE_COLORS)]
        colors.append(rgb(fixed_colors.get(number, default_color)))
    return np.array(colors, dtype=np.uint8).reshape(-1, 3)


class PredictedScenes:
    """Renders predictions of moments, on topics below `/<agent>/prediction`."""

    def __init__(self, prediction: Predictions) -> None:
        """Store predictions by sample token; raises ConfigError for other objects."""
        if not isinstance(prediction, Results | Mapping):
            raise ConfigError(
                "prediction: expected Results, or a mapping from sample token to what is "
                f"predicted, found {type(prediction).__name__}"
            )
        self._prediction = prediction

    def has(self, sample: str) -> bool:
        """Return whether a sample has a prediction."""
        return sample in self._prediction

    def write(self, moment: Moment, recording: McapRecording) -> None:
        """Write the predictions of a moment's samples; raises ConfigError or ResultsError."""
        for agent, sample in moment.samples.items():
            if self.has(sample):
                _write(agent, self._prediction_of(sample), moment.index, recording)

    def _prediction_of(self, sample: str) -> object:
        predictions = self._prediction
        if isinstance(predictions, Results):
            return predictions.prediction(sample)
        return predictions[sample]


def _write(agent: str, prediction: object, index: int, recording: McapRecording) -> None:
    """Write a prediction of any kind; raises ConfigError for other objects."""
    topic = f"/{agent}/prediction"
    if isinstance(prediction, MotionOutput):
        points = cell_points(_instances(prediction), prediction.grid)
        cloud = cloud_message(points, frame_id(agent, "ego"), index)
        recording.write(f"{topic}/motion/points", cloud, index)
    elif isinstance(prediction, DetectedBoxes):
        _write_boxes(agent, prediction, f"{topic}/boxes", index, recording)
    elif isinstance(prediction, Sequence) and all(
        isinstance(item, Accident) for item in prediction
    ):
        _write_accidents(agent, prediction, f"{topic}/accidents", index, recording)
    else:
        raise ConfigError(
            "prediction: expected a MotionOutput, a list of Accident or DetectedBoxes for each "
            f"sample, found {type(prediction).__name__}"
        )


def _instances(output: MotionOutput) -> Any:
    """Return the instances (T, H, W) of the last prediction, in the grid's orientation."""
    if output.heads is not None:
        return predict_instances(output.heads[-1], "motion").instance
    return np.asarray(output.instances)[-1]


def _write_boxes(
    agent: str, detected: DetectedBoxes, topic: str, index: int, recording: McapRecording
) -> None:
    boxes, frame = detected.boxes, frame_id(agent, detected.boxes.frame)
    segments = box_segments(boxes)
    entities = []
    for row, score in enumerate(detected.scores.tolist()):
        facts = {"category": CATEGORIES[boxes.category[row]], "score": f"{score:.3f}"}
        entities.append(
            entity(
                str(row),
                frame,
                index,
                facts,
                cubes=[cube(boxes, row, PREDICTED_COLOR)],
                lines=[lines(segments[row], PREDICTED_COLOR)],
            )
        )
    recording.write(topic, scene_update(entities, index), index)
    points = segment_points(segments.reshape(-1, 2, 3), PREDICTED_COLOR)
    recording.write(f"{topic}/points", cloud_message(points, frame, index), index)


def _write_accidents(
    agent: str, accidents: Sequence[Accident], topic: str, index: int, recording: McapRecording
) -> None:
    frame, entities, points = frame_id(agent, "ego"), [], []
    for number, accident in enumerate(accidents):
        positions = np.column_stack([accident.positions, np.full(2, _MARK_HEIGHT_M)])
        text = f"accident in {accident.time:.1f} s (score {accident.score:.2f})"
        facts = {"text": text, "time": f"{accident.time:.3f}", "score": f"{accident.score:.3f}"}
        if accident.ids is not None:
            facts["actor_ids"] = ", ".join(map(str, accident.ids))
        label_position = positions.mean(axis=0) + np.array([0.0, 0.0, _MARK_DIAMETER_M])
        entities.append(
            entity(
                str(number),
                frame,
                index,
                facts,
                spheres=list(map(_sphere, positions)),
                lines=[lines(positions[None], PREDICTED_COLOR)],
                texts=[label(text, label_position, PREDICTED_COLOR)],
            )
        )
        points += [
            colored_points(positions, PREDICTED_COLOR),
            segment_points(positions[None], PREDICTED_COLOR),
        ]
    recording.write(topic, scene_update(entities, index), index)
    recording.write(f"{topic}/points", cloud_message(join_points(points), frame, index), index)


def _sphere(position: Any) -> Any:
    return SpherePrimitive(
        pose=pose(position, _NO_ROTATION),
        size=vector(np.full(3, _MARK_DIAMETER_M)),
        color=color_message(PREDICTED_COLOR, 0.8),
    )
