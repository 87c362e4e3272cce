"""Where vehicles park: slots on the strips beside the lanes."""

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.synth.roads.layout import PARKING_WIDTH, RoadSpec
from deepaccident_devkit.synth.roads.terrain import OUTWARD

SLOT_LENGTH = 5.8
"""Metres: parked cars stand about one metre apart."""
_KEPT_FREE = 6.0
"""Metres before the stop line."""
_LAST = 110.0


def slot_edges(spec: RoadSpec) -> FloatArray:
    """Metres along an arm between which its slots lie, (S + 1,)."""
    first = spec.stop_line[1] + _KEPT_FREE
    edges: FloatArray = first + SLOT_LENGTH * np.arange(int((_LAST - first) / SLOT_LENGTH) + 1, dtype=np.float64)
    return edges


def parking_places(spec: RoadSpec) -> FloatArray:
    """x, y (metres), yaw (radians) of the middles of all slots (N, 3), in the direction of the traffic beside them."""
    if not spec.parking:
        return np.zeros((0, 3))
    edges = slot_edges(spec)
    along = (edges[:-1] + edges[1:]) / 2
    beside = spec.road_edge - PARKING_WIDTH / 2
    places = []
    for arm in spec.arms:
        x, y = OUTWARD[arm]
        outward = np.arctan2(y, x)
        for side, yaw in ((1, outward + np.pi), (-1, outward)):
            wrapped = np.arctan2(np.sin(yaw), np.cos(yaw))
            places.append(
                np.column_stack(
                    [
                        along * x - side * beside * y,
                        along * y + side * beside * x,
                        np.full(len(along), wrapped),
                    ]
                )
            )
    return np.concatenate(places)
