"""Motion labels and predictions in an MCAP file; each cell of an actor is a coloured point."""

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
"""A point of a map: `instance` is its id in the map; `frame` counts from 0, the current frame."""
FRAME_HEIGHT: Final = 0.2
"""Metres from each future frame up to the next one, so that no frame hides another one."""
# Share of its opacity that an instance loses until the last frame.
_FADED_SHARE = 0.6
# Diameter of the spheres at the positions of a predicted accident, and their height.
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

    def __init__(self, prediction: Predictions) -> None:
        """Store predictions by sample token; raise ConfigError for an object of another type."""
        if not isinstance(prediction, Results | Mapping):
            raise ConfigError(
                "prediction: expected Results, or a mapping from sample tokens to predictions, "
                f"found {type(prediction).__name__}"
            )
        self._prediction = prediction

    def has(self, sample: str) -> bool:
        """Return whether a sample has a prediction."""
        return sample in self._prediction

    def write(self, moment: Moment, recording: McapRecording) -> None:
        """Write the predictions for the samples of a moment.

        Raises ConfigError for a prediction of an unknown type, and ResultsError if results cannot
        be read.
        """
        for agent, sample in moment.samples.items():
            if self.has(sample):
                if isinstance(self._prediction, Results):
                    prediction: object = self._prediction.prediction(sample)
                else:
                    prediction = self._prediction[sample]
                _write_prediction(agent, prediction, moment.frame_number, recording)


def _write_prediction(
    agent: str, prediction: object, frame_number: int, recording: McapRecording
) -> None:
    """Write a prediction of any kind; raise ConfigError for an object of another type."""
    topic = f"/{agent}/prediction"
    if isinstance(prediction, MotionOutput):
        points = make_cell_points(_decode_instances(prediction), prediction.grid)
        cloud = make_cloud(points, name_frame(agent, "ego"), frame_number)
        recording.write(f"{topic}/motion/points", cloud, frame_number)
    elif isinstance(prediction, DetectedBoxes):
        _write_boxes(agent, prediction, f"{topic}/boxes", frame_number, recording)
    elif isinstance(prediction, Sequence) and all(
        isinstance(item, Accident) for item in prediction
    ):
        _write_accidents(agent, prediction, f"{topic}/accidents", frame_number, recording)
    else:
        raise ConfigError(
            "prediction: expected a MotionOutput, a list of Accident or DetectedBoxes for each "
            f"sample, found {type(prediction).__name__}"
        )


def _decode_instances(output: MotionOutput) -> Any:
    """Return the instance maps (T, H, W) of the last prediction, in the orientation of the grid."""
    if output.heads is not None:
        return predict_instances(output.heads[-1], "motion").instance
    maps = np.asarray(output.instances)
    return maps[-1]


def _write_boxes(
    agent: str, detected: DetectedBoxes, topic: str, frame_number: int, recording: McapRecording
) -> None:
    boxes = detected.boxes
    frame = name_frame(agent, boxes.frame)
    segments = compute_box_segments(boxes)
    entities = []
    for row, score in enumerate(detected.scores.tolist()):
        facts = {"category": CATEGORIES[boxes.category[row]], "score": f"{score:.3f}"}
        entities.append(
            make_entity(
                str(row),
                frame,
                frame_number,
                facts,
                cubes=[make_cube(boxes, row, PREDICTED_COLOR)],
                lines=[make_lines(segments[row], PREDICTED_COLOR)],
            )
        )
    recording.write(topic, make_scene_update(entities, frame_number), frame_number)
    points = sample_segments(segments.reshape(-1, 2, 3), PREDICTED_COLOR)
    recording.write(f"{topic}/points", make_cloud(points, frame, frame_number), frame_number)


def _write_accidents(
    agent: str,
    accidents: Sequence[Accident],
    topic: str,
    frame_number: int,
    recording: McapRecording,
) -> None:
    frame = name_frame(agent, "ego")
    entities = []
    points = []
    for number, accident in enumerate(accidents):
        positions = np.column_stack([accident.positions, np.full(2, _MARK_HEIGHT_M)])
        text = f"accident in {accident.time:.1f} s (score {accident.score:.2f})"
        facts = {"text": text, "time": f"{accident.time:.3f}", "score": f"{accident.score:.3f}"}
        if accident.ids is not None:
            facts["actor_ids"] = ", ".join(map(str, accident.ids))
        label_position = positions.mean(axis=0) + np.array([0.0, 0.0, _MARK_DIAMETER_M])
        entities.append(
            make_entity(
                str(number),
                frame,
                frame_number,
                facts,
                spheres=list(map(_make_sphere, positions)),
                lines=[make_lines(positions[None], PREDICTED_COLOR)],
                texts=[make_label(text, label_position, PREDICTED_COLOR)],
            )
        )
        points += [
            color_points(positions, PREDICTED_COLOR),
            sample_segments(positions[None], PREDICTED_COLOR),
        ]
    recording.write(topic, make_scene_update(entities, frame_number), frame_number)
    recording.write(
        f"{topic}/points", make_cloud(join_points(points), frame, frame_number), frame_number
    )


def _make_sphere(position: Any) -> Any:
    return SpherePrimitive(
        pose=make_pose(position, _NO_ROTATION),
        size=make_vector(np.full(3, _MARK_DIAMETER_M)),
        color=make_color(PREDICTED_COLOR, 0.8),
    )
