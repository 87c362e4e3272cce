"""The layout of a junction: its arms, lanes and edges, in metres from its middle, and where vehicles park."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.synth.roads.terrain import ARMS, OUTWARD, Arm, Hump
from deepaccident_devkit.text import choice

RoadKind = Literal["four-way", "three-way"]

LANE_WIDTH = 3.5
PARKING_WIDTH = 2.4
SIDEWALK_WIDTH = 3.0
CROSSWALK_WIDTH = 3.0
MAX_LANES = 2
_GUTTER = 0.4
_MOUTH = 2.0
"""How many metres the mouth of an arm lies before the end of the rounded kerb."""
_STOP_LINE = 0.4
_KERB_RADII = (3.0, 10.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class RoadSpec:
    """A junction of straight roads at right angles; checked when made, raises ConfigError.

    Attributes:
        kind: a three-way junction has no north arm.
        signalized: whether it has traffic lights.
        lanes: number of lanes in each direction, 1 or 2.
        crosswalks: whether there are zebra crossings across the arms.
        parking: whether there are parking strips beside the lanes.
        hump: a rise on one arm, or None.
        kerb_radius: radius of the rounded corners, metres.
    """

    kind: RoadKind = "four-way"
    signalized: bool = True
    lanes: int = 1
    crosswalks: bool = True
    parking: bool = True
    hump: Hump | None = None
    kerb_radius: float = 5.0

    def __post_init__(self) -> None:
        """Check every field."""
        object.__setattr__(self, "kind", choice("road.kind", self.kind, get_args(RoadKind), error=ConfigError))
        if not 1 <= self.lanes <= MAX_LANES:
            raise ConfigError(f"road.lanes: expected 1 or {MAX_LANES} in each direction, found {self.lanes}")
        low, high = _KERB_RADII
        if not low <= self.kerb_radius <= high:
            raise ConfigError(f"road.kerb_radius: expected {low:g} to {high:g} metres, found {self.kerb_radius:g}")
        if self.hump is not None:
            self._check_hump(self.hump)

    @property
    def arms(self) -> tuple[Arm, ...]:
        """The arms that the junction has, counter-clockwise from the west."""
        return ARMS if self.kind == "four-way" else ARMS[:3]

    @property
    def yielding_arms(self) -> tuple[Arm, ...]:
        """The arms that have a yield line: at a junction without lights, those of the road from south to north."""
        if self.signalized:
            return ()
        return tuple(arm for arm in self.arms if arm in ("south", "north"))

    @property
    def lanes_edge(self) -> float:
        """Metres from an arm's middle line to the outer edge of its lanes."""
        return self.lanes * LANE_WIDTH

    @property
    def road_edge(self) -> float:
        """Metres from an arm's middle line to the kerb."""
        return self.lanes_edge + (PARKING_WIDTH if self.parking else _GUTTER)

    @property
    def sidewalk_edge(self) -> float:
        """Metres from an arm's middle line to where the sidewalk ends."""
        return self.road_edge + SIDEWALK_WIDTH

    @property
    def mouth(self) -> float:
        """Metres from the junction's middle along an arm to where the arm and its crosswalk begin."""
        return self.road_edge + self.kerb_radius - _MOUTH

    @property
    def crosswalk(self) -> tuple[float, float]:
        """Where the crosswalk begins and ends, metres along an arm."""
        return self.mouth, self.mouth + CROSSWALK_WIDTH

    @property
    def stop_line(self) -> tuple[float, float]:
        """Where the stop line begins and ends, metres along an arm."""
        near = self.crosswalk[1] + 0.7 if self.crosswalks else self.road_edge + self.kerb_radius + 0.4
        return near, near + _STOP_LINE

    def lane_center(self, lane: int) -> float:
        """Metres from the middle line to where vehicles drive in a lane; lane 0 is the rightmost."""
        return (self.lanes - lane - 0.5) * LANE_WIDTH

    def _check_hump(self, hump: Hump) -> None:
        if hump.arm not in self.arms:
            raise ConfigError(
                f"road.hump.arm: a {self.kind} junction has no {hump.arm} arm; choose one of {', '.join(self.arms)}"
            )
        least = self.stop_line[1] + hump.length / 2
        if hump.distance < least:
            raise ConfigError(
                f"road.hump.distance: {hump.distance:g} m puts the foot of the hump into the junction; choose "
                f"{least:.1f} m or more, or a shorter hump"
            )


SLOT_LENGTH = 5.8
"""Length of a parking slot, metres: the gaps between parked cars are about one metre."""
_KEPT_FREE = 6.0
"""Metres before the stop line that have no parking slots."""
_LAST = 110.0


def slot_edges(spec: RoadSpec) -> FloatArray:
    """The edges of the parking slots, metres along an arm, (S + 1,)."""
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
