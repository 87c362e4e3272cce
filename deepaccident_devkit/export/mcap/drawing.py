"""Boxes as Foxglove's scene entities (cubes and lines), and as coloured points for viewers without these.

rerun shows point clouds but no SceneUpdate, so every rendering is there again as points, on a topic that ends in
`/points`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.KeyValuePair_pb2 import KeyValuePair
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.TextPrimitive_pb2 import TextPrimitive

from deepaccident_devkit.arrays import AnyArray, FloatArray
from deepaccident_devkit.export.mcap.messages import COLORED_POINT, color_message, points3, pose, rgb, vector
from deepaccident_devkit.export.mcap.recording import frame_timestamp
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.render.boxes import EDGES
from deepaccident_devkit.taxonomy import FRAME_PERIOD

_NO_TURN: Final = np.array([1.0, 0.0, 0.0, 0.0])
_FACE_ALPHA: Final = 0.4
_LINE_PIXELS: Final = 2.0
_TEXT_PIXELS: Final = 14.0
_TEXT_ABOVE: Final = 0.6
"""Metres from a box's top to its text."""
POINT_SPACING: Final = 0.25
"""Metres between the points of a rendered line."""


def scene_update(entities: Sequence[Any], index: int) -> Any:
    """A SceneUpdate that shows these entities and removes all others of its topic."""
    everything = SceneEntityDeletion(timestamp=frame_timestamp(index), type=SceneEntityDeletion.ALL)
    return SceneUpdate(deletions=[everything], entities=entities)


def entity(name: str, frame: str, index: int, facts: Mapping[str, str], **primitives: Sequence[Any]) -> Any:
    """A SceneEntity in a coordinate frame: its primitives, and facts that the viewer shows after a click on it."""
    seconds = (index - 1) * FRAME_PERIOD
    return SceneEntity(
        timestamp=frame_timestamp(index),
        frame_id=frame,
        id=name,
        frame_locked=False,
        metadata=[KeyValuePair(key=key, value=value) for key, value in {**facts, "seconds": f"{seconds:.1f}"}.items()],
        **primitives,
    )


def cube(boxes: Boxes, row: int, color: str) -> Any:
    """One of some boxes as a transparent CubePrimitive."""
    return CubePrimitive(
        pose=pose(boxes.center[row], boxes.rotation[row]),
        size=vector(boxes.size[row]),
        color=color_message(color, _FACE_ALPHA),
    )


def lines(segments: FloatArray, color: str) -> Any:
    """Segments (N, 2, 3) as a LinePrimitive, equally thick at all distances."""
    return _line(LinePrimitive.LINE_LIST, segments.reshape(-1, 3), color)


def strip(points: FloatArray, color: str) -> Any:
    """A line through points (N, 3) as a LinePrimitive."""
    return _line(LinePrimitive.LINE_STRIP, points, color)


def label(text: str, place: FloatArray, color: str) -> Any:
    """Words at a place (3,) as a TextPrimitive, equally large at all distances."""
    return TextPrimitive(
        pose=pose(place, _NO_TURN),
        billboard=True,
        font_size=_TEXT_PIXELS,
        scale_invariant=True,
        color=color_message(color),
        text=text,
    )


def box_segments(boxes: Boxes) -> FloatArray:
    """(N, 13, 2, 3): the twelve edges of each box and, on the floor, a line from its middle to its front."""
    corners, floor = boxes.corners(), boxes.bottom_corners()
    edges = corners[:, np.array(EDGES)]
    front = np.stack([floor.mean(axis=1), floor[:, :2].mean(axis=1)], axis=1)
    return np.concatenate([edges, front[:, None]], axis=1)


def above(boxes: Boxes, row: int) -> FloatArray:
    """(3,) the place of a box's text."""
    height = boxes.size[row, 2] / 2 + _TEXT_ABOVE
    place: FloatArray = boxes.center[row] + np.array([0.0, 0.0, height])
    return place


def segment_points(segments: FloatArray, color: str, alpha: float = 1.0) -> AnyArray:
    """Points (M,) of `COLORED_POINT` along segments (N, 2, 3), ends included."""
    if not len(segments):
        return np.zeros(0, dtype=COLORED_POINT)
    lengths = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    counts = np.ceil(lengths / POINT_SPACING).astype(np.int64) + 1
    which = np.repeat(np.arange(len(segments)), counts)
    step = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
    share = (step / np.maximum(counts - 1, 1)[which])[:, None]
    return colored_points(segments[which, 0] * (1 - share) + segments[which, 1] * share, color, alpha)


def strip_points(points: FloatArray, color: str, alpha: float = 1.0) -> AnyArray:
    """Points of `COLORED_POINT` along a line through points (N, 3)."""
    return segment_points(np.stack([points[:-1], points[1:]], axis=1), color, alpha)


def colored_points(xyz: FloatArray, color: str, alpha: float = 1.0) -> AnyArray:
    """Points (N, 3) as (N,) `COLORED_POINT` of one colour."""
    points = np.zeros(len(xyz), dtype=COLORED_POINT)
    points["x"], points["y"], points["z"] = xyz.T
    points["red"], points["green"], points["blue"] = rgb(color).tolist()
    points["alpha"] = round(255 * alpha)
    return points


def joined(parts: Sequence[AnyArray]) -> AnyArray:
    """Points of several renderings in one array."""
    return np.concatenate([np.zeros(0, dtype=COLORED_POINT), *parts])


def _line(kind: int, points: FloatArray, color: str) -> Any:
    return LinePrimitive(
        type=kind,
        pose=pose(np.zeros(3), _NO_TURN),
        thickness=_LINE_PIXELS,
        scale_invariant=True,
        points=points3(points),
        color=color_message(color),
    )
