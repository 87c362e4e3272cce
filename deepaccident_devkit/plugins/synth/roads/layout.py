"""The layout of a junction, in metres from its middle: arms, lanes, parking slots, and terrain."""

from dataclasses import dataclass
from typing import Literal, TypeVar, get_args

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.support.arrays import Float32Array, FloatArray
from deepaccident_devkit.support.text import choice

Arm = Literal["west", "south", "east", "north"]
RoadKind = Literal["four-way", "three-way"]
_Distance = TypeVar("_Distance", float, FloatArray)
ARMS: tuple[Arm, ...] = get_args(Arm)
"""The four sides of a junction, counter-clockwise."""
OUTWARD: dict[Arm, tuple[int, int]] = {
    "west": (-1, 0),
    "south": (0, -1),
    "east": (1, 0),
    "north": (0, 1),
}
"""Unit vectors from the middle of the junction along its arms, ground frame."""
EXTENT = 150.0
"""The ground covers −`EXTENT` to `EXTENT` in x and y, metres."""
MAX_GRADE = 0.21
# Share of each half of a hump that is curved at its crest, and as much at its foot; the grade
# between them is constant.
_CURVED_SHARE = 0.25
# Distances from the arm's middle line, to either side, at which a hump begins to fall and ends,
# metres.
_SHOULDER_DISTANCES = (22.0, 45.0)
# Distance between the corners of triangles along a hump.
_TRIANGLE_STEP_M = 1.0
LANE_WIDTH = 3.5
PARKING_WIDTH = 2.4
SIDEWALK_WIDTH = 3.0
CROSSWALK_WIDTH = 3.0
KERB_RADIUS = 5.0
"""Radius of the rounded corners, metres."""
MAX_LANES = 2
# Distance from the mouth of an arm to the end of the rounded kerb.
_MOUTH_DISTANCE_M = 2.0
_STOP_LINE_WIDTH_M = 0.4
SLOT_LENGTH = 5.8
"""Length of a parking slot, metres; it leaves gaps of about one metre between parked cars."""
# Length of the road before the stop line that has no parking slots.
_SLOT_FREE_LENGTH_M = 6.0
# Distance from the junction's middle at which the parking slots end.
_SLOTS_END_M = 110.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Hump:
    """A rise of the road, the same on both sides of its crest.

    Values are checked on construction; a wrong one raises ConfigError.

    Attributes:
        arm: Arm of the junction that it lies on.
        distance: Distance from the junction's middle to the crest, metres.
        height: Height of the crest, metres.
        length: Length along the road, up and down, metres.
    """

    arm: Arm = "west"
    distance: float = 50.0
    height: float = 2.4
    length: float = 70.0

    def __post_init__(self) -> None:
        """Check that the hump fits on its arm, and that cars can climb it."""
        object.__setattr__(self, "arm", choice("hump.arm", self.arm, ARMS, error=ConfigError))
        if self.length <= 0 or self.height < 0:
            raise ConfigError(
                "hump: expected a length above 0 and a height of 0 or more, "
                f"found {self.length} and {self.height}"
            )
        if self.distance + self.length / 2 > EXTENT or self.distance - self.length / 2 < 0:
            raise ConfigError(
                f"hump: {self.length:g} m around {self.distance:g} m do not fit on an arm of "
                f"{EXTENT:g} m; make it shorter, or change its distance"
            )
        if self.grade > MAX_GRADE:
            raise ConfigError(
                f"hump: {self.height:g} m over {self.length:g} m are a grade of {self.grade:.1%}; "
                f"make it longer or lower; {MAX_GRADE:.0%} is the maximum"
            )

    @property
    def grade(self) -> float:
        """The steepest slope, in metres of height for each metre of road."""
        half_length = self.length / 2
        return self.height / (half_length * (1 - _CURVED_SHARE))


@dataclass(frozen=True, slots=True)
class Terrain:
    """The height of the ground in the ground frame.

    Attributes:
        hump: The only rise; None if all ground is flat.
    """

    hump: Hump | None = None

    @property
    def is_flat(self) -> bool:
        """Whether the height is 0 everywhere."""
        if self.hump is None:
            return True
        return self.hump.height == 0

    def height(self, xy: ArrayLike) -> FloatArray:
        """Return heights (N,), metres, at points (N, 2)."""
        points = np.asarray(xy, dtype=np.float64)
        if self.hump is None or self.is_flat:
            return np.zeros(points.shape[:-1])
        along, to_left = _locate_on_arm(points, self.hump.arm)
        profile, _ = _compute_hump_profile(along, self.hump)
        fade, _ = _compute_hump_fade(to_left)
        return profile * fade

    def normal(self, xy: ArrayLike) -> FloatArray:
        """Return unit normals (N, 3), upwards, at points (N, 2)."""
        points = np.asarray(xy, dtype=np.float64)
        normals = np.zeros((*points.shape[:-1], 3))
        normals[..., 2] = 1.0
        if self.hump is None or self.is_flat:
            return normals
        along, to_left = _locate_on_arm(points, self.hump.arm)
        profile, profile_slope = _compute_hump_profile(along, self.hump)
        fade, fade_slope = _compute_hump_fade(to_left)
        outward = np.array(OUTWARD[self.hump.arm])
        leftward = np.array([-outward[1], outward[0]])
        outward_slope = (profile_slope * fade)[..., None]
        leftward_slope = (profile * fade_slope)[..., None]
        normals[..., :2] = -outward_slope * outward - leftward_slope * leftward
        lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
        return np.asarray(normals / lengths)

    def triangles(self) -> Float32Array:
        """Return the surface as triangles (M, 3, 3), metres, with their normals upwards.

        The triangles along a hump are small.
        """
        along = np.array([-EXTENT, EXTENT])
        to_left = along
        arm: Arm = "east"
        hump = self.hump
        if hump is not None and not self.is_flat:
            arm = hump.arm
            begin = hump.distance - hump.length / 2
            end = hump.distance + hump.length / 2
            num_steps = int(np.ceil(hump.length / _TRIANGLE_STEP_M))
            along = _add_edges(np.linspace(begin, end, num_steps + 1))
            shoulder = np.linspace(*_SHOULDER_DISTANCES, 12)
            to_left = _add_edges(np.concatenate([-shoulder[::-1], shoulder]))
        outward = np.array(OUTWARD[arm], dtype=np.float64)
        leftward = np.array([-outward[1], outward[0]])
        xy = along[:, None, None] * outward + to_left[None, :, None] * leftward
        grid = np.concatenate([xy, self.height(xy)[..., None]], axis=2)
        near_right = grid[:-1, :-1]
        far_right = grid[1:, :-1]
        near_left = grid[:-1, 1:]
        far_left = grid[1:, 1:]
        right_halves = np.stack([near_right, far_right, far_left], axis=2)
        left_halves = np.stack([near_right, far_left, near_left], axis=2)
        triangles = [right_halves.reshape(-1, 3, 3), left_halves.reshape(-1, 3, 3)]
        return np.concatenate(triangles).astype(np.float32)


def point_on_arm(arm: Arm, along: _Distance, to_left: _Distance) -> tuple[_Distance, _Distance]:
    """Return x and y of points on an arm, metres.

    Args:
        arm: The arm.
        along: Distances outward from the junction's middle, metres.
        to_left: Distances to the left of the arm's middle line, seen outward, metres.
    """
    outward_x, outward_y = OUTWARD[arm]
    x = along * outward_x - to_left * outward_y
    y = along * outward_y + to_left * outward_x
    return x, y


def _locate_on_arm(points: FloatArray, arm: Arm) -> tuple[FloatArray, FloatArray]:
    """Return how far points (…, 2) are along an arm, and to the left of its middle line, metres."""
    outward_x, outward_y = OUTWARD[arm]
    x = points[..., 0]
    y = points[..., 1]
    along = x * outward_x + y * outward_y
    to_left = y * outward_x - x * outward_y
    return along, to_left


def _compute_hump_profile(along: FloatArray, hump: Hump) -> tuple[FloatArray, FloatArray]:
    """Return a hump's heights (metres) and slopes at distances along its arm.

    The grade is constant up and down, with parabolas at the crest and at the feet.
    """
    half_length = hump.length / 2
    curve_length = half_length * _CURVED_SHARE
    signed_offset = along - hump.distance
    crest_distance = np.minimum(np.abs(signed_offset), half_length)
    foot_distance = half_length - crest_distance
    grade = hump.grade
    crest_height = hump.height - grade * crest_distance**2 / (2 * curve_length)
    foot_height = grade * foot_distance**2 / (2 * curve_length)
    straight_height = hump.height - grade * (crest_distance - curve_length / 2)
    height_off_crest = np.where(foot_distance < curve_length, foot_height, straight_height)
    height = np.where(crest_distance < curve_length, crest_height, height_off_crest)
    grade_fraction = np.minimum(crest_distance, foot_distance) / curve_length
    slope = grade * np.minimum(grade_fraction, 1.0)
    return height, -np.sign(signed_offset) * slope


def _compute_hump_fade(to_left: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the fraction of its height that a hump has away from the middle line, and its slope.

    Args:
        to_left: Distances to the left of the arm's middle line, metres.
    """
    begin, end = _SHOULDER_DISTANCES
    width = end - begin
    share = np.clip((np.abs(to_left) - begin) / width, 0.0, 1.0)
    fade = 1 - share**2 * (3 - 2 * share)
    slope = -np.sign(to_left) * 6 * share * (1 - share) / width
    return fade, slope


def _add_edges(positions: FloatArray) -> FloatArray:
    """Return the positions that are on the ground, and the two edges of the ground, metres."""
    on_ground = np.abs(positions) < EXTENT
    return np.concatenate([[-EXTENT], positions[on_ground], [EXTENT]])


@dataclass(frozen=True, slots=True, kw_only=True)
class RoadSpec:
    """A junction of straight roads at right angles.

    Values are checked on construction; a wrong one raises ConfigError.

    Attributes:
        kind: Kind of the junction; a three-way junction has no north arm.
        signalized: Whether it has traffic lights.
        lanes: Number of lanes in each direction, 1 or 2.
        hump: Rise on one arm, or None.
    """

    kind: RoadKind = "four-way"
    signalized: bool = True
    lanes: int = 1
    hump: Hump | None = None

    def __post_init__(self) -> None:
        """Check every field; raise ConfigError if one is not valid."""
        kind = choice("road.kind", self.kind, get_args(RoadKind), error=ConfigError)
        object.__setattr__(self, "kind", kind)
        if not 1 <= self.lanes <= MAX_LANES:
            raise ConfigError(
                f"road.lanes: expected 1 or {MAX_LANES} in each direction, found {self.lanes}"
            )
        if self.hump is not None:
            self._check_hump(self.hump)

    @property
    def arms(self) -> tuple[Arm, ...]:
        """The arms of the junction, counter-clockwise from the west."""
        if self.kind == "four-way":
            return ARMS
        return ARMS[:3]

    @property
    def yielding_arms(self) -> tuple[Arm, ...]:
        """The arms with a yield line: at a junction without lights, the south and north arms."""
        if self.signalized:
            return ()
        return tuple(arm for arm in self.arms if arm in ("south", "north"))

    @property
    def lanes_edge(self) -> float:
        """Distance from an arm's middle line to the outer edge of its lanes, metres."""
        return self.lanes * LANE_WIDTH

    @property
    def road_edge(self) -> float:
        """Distance from an arm's middle line to the kerb, metres."""
        return self.lanes_edge + PARKING_WIDTH

    @property
    def sidewalk_edge(self) -> float:
        """Distance from an arm's middle line to the outer edge of the sidewalk, metres."""
        return self.road_edge + SIDEWALK_WIDTH

    @property
    def mouth(self) -> float:
        """Distance from the junction's middle to the start of an arm and its crosswalk, metres."""
        return self.road_edge + KERB_RADIUS - _MOUTH_DISTANCE_M

    @property
    def crosswalk(self) -> tuple[float, float]:
        """Start and end of the crosswalk, metres along an arm."""
        mouth = self.mouth
        return mouth, mouth + CROSSWALK_WIDTH

    @property
    def stop_line(self) -> tuple[float, float]:
        """Start and end of the stop line, metres along an arm."""
        begin = self.crosswalk[1] + 0.7
        return begin, begin + _STOP_LINE_WIDTH_M

    def lane_center(self, lane: int) -> float:
        """Return the distance from the middle line to the middle of a lane, metres.

        Lane 0 is the rightmost.
        """
        lane_widths = self.lanes - lane - 0.5
        return lane_widths * LANE_WIDTH

    def _check_hump(self, hump: Hump) -> None:
        """Raise ConfigError unless a hump lies on an existing arm and outside the junction."""
        if hump.arm not in self.arms:
            raise ConfigError(
                f"road.hump.arm: a {self.kind} junction has no {hump.arm} arm; "
                f"choose one of {', '.join(self.arms)}"
            )
        min_distance = self.stop_line[1] + hump.length / 2
        if hump.distance < min_distance:
            raise ConfigError(
                f"road.hump.distance: {hump.distance:g} m puts the foot of the hump into the "
                f"junction; choose {min_distance:.1f} m or more, or a shorter hump"
            )


def slot_edges(spec: RoadSpec) -> FloatArray:
    """Return the edges of the parking slots, metres along an arm, shape (S + 1,)."""
    begin = spec.stop_line[1] + _SLOT_FREE_LENGTH_M
    num_slots = int((_SLOTS_END_M - begin) / SLOT_LENGTH)
    numbers = np.arange(num_slots + 1, dtype=np.float64)
    edges: FloatArray = begin + SLOT_LENGTH * numbers
    return edges


def parking_places(spec: RoadSpec) -> FloatArray:
    """Return the poses of all parking slots, facing in the direction of the traffic next to them.

    Returns:
        x, y (metres), yaw (radians) of the slots' middles, shape (N, 3).
    """
    edges = slot_edges(spec)
    along = (edges[:-1] + edges[1:]) / 2
    middle_distance = spec.road_edge - PARKING_WIDTH / 2
    slots = []
    for arm in spec.arms:
        outward_x, outward_y = OUTWARD[arm]
        outward = np.arctan2(outward_y, outward_x)
        for side, yaw in ((1, outward + np.pi), (-1, outward)):
            x, y = point_on_arm(arm, along, np.full(len(along), side * middle_distance))
            wrapped_yaw = np.arctan2(np.sin(yaw), np.cos(yaw))
            slots.append(np.column_stack([x, y, np.full(len(along), wrapped_yaw)]))
    return np.concatenate(slots)
