"""The layout of a junction, in metres from its middle: arms, lanes, parking slots, and how high the ground lies."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.support.arrays import Float32Array, FloatArray
from deepaccident_devkit.support.text import choice

Arm = Literal["west", "south", "east", "north"]
# The four sides of a junction, counter-clockwise.
ARMS: tuple[Arm, ...] = get_args(Arm)
# Unit vectors from the middle of the junction along its arms, ground frame.
OUTWARD: dict[Arm, tuple[int, int]] = {
    "west": (-1, 0),
    "south": (0, -1),
    "east": (1, 0),
    "north": (0, 1),
}

# The ground covers −`EXTENT` to `EXTENT` in x and y, metres.
EXTENT = 150.0
MAX_GRADE = 0.21
# Share of each half of a hump that is curved at its crest, and as much at its foot; the grade between is constant.
_CURVED = 0.25
# Metres to the side of the arm's middle line where a hump begins to fall, and where it ends.
_SHOULDERS = (22.0, 45.0)
# Metres between the corners of triangles along a hump.
_STEP = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Hump:
    """A rise of the road, the same on both sides of its crest; checked when made, raises ConfigError.

    Attributes:
        arm: the junction's arm that it lies on.
        distance: distance from the junction's middle to the crest, metres.
        height: height of the crest, metres.
        length: length along the road, up and down, metres.
    """

    arm: Arm = "west"
    distance: float = 50.0
    height: float = 2.4
    length: float = 70.0

    def __post_init__(self) -> None:
        """Check that it fits between the junction and the edge of the ground, and that cars can climb it."""
        object.__setattr__(self, "arm", choice("hump.arm", self.arm, ARMS, error=ConfigError))
        if self.length <= 0 or self.height < 0:
            raise ConfigError(
                f"hump: expected a length above 0 and a height of 0 or more, found {self.length} and {self.height}"
            )
        if self.distance + self.length / 2 > EXTENT or self.distance - self.length / 2 < 0:
            raise ConfigError(
                f"hump: {self.length:g} m around {self.distance:g} m do not fit on an arm of {EXTENT:g} m; make it "
                "shorter, or change its distance"
            )
        if self.grade > MAX_GRADE:
            raise ConfigError(
                f"hump: {self.height:g} m over {self.length:g} m are a grade of {self.grade:.1%}; make it longer or "
                f"lower, {MAX_GRADE:.0%} is the most"
            )

    @property
    def grade(self) -> float:
        """The steepest slope, metres of height for each metre."""
        return self.height / (self.length / 2 * (1 - _CURVED))


@dataclass(frozen=True, slots=True)
class Terrain:
    """The height of the ground in the ground frame.

    Attributes:
        hump: the only rise; None if all ground is flat.
    """

    hump: Hump | None = None

    @property
    def is_flat(self) -> bool:
        """Whether the height is 0 everywhere."""
        return self.hump is None or self.hump.height == 0

    def height(self, xy: ArrayLike) -> FloatArray:
        """Heights (N,), metres, at points (N, 2)."""
        points = np.asarray(xy, dtype=np.float64)
        if self.hump is None or self.is_flat:
            return np.zeros(points.shape[:-1])
        along, beside = _along_and_beside(points, self.hump.arm)
        profile, _ = _profile(along, self.hump)
        fade, _ = _fade(beside)
        return profile * fade

    def normal(self, xy: ArrayLike) -> FloatArray:
        """Unit normals (N, 3), upwards, at points (N, 2)."""
        points = np.asarray(xy, dtype=np.float64)
        normals = np.zeros((*points.shape[:-1], 3))
        normals[..., 2] = 1.0
        if self.hump is None or self.is_flat:
            return normals
        along, beside = _along_and_beside(points, self.hump.arm)
        profile, profile_slope = _profile(along, self.hump)
        fade, fade_slope = _fade(beside)
        outward = np.array(OUTWARD[self.hump.arm])
        sideways = np.array([-outward[1], outward[0]])
        normals[..., :2] = (
            -(profile_slope * fade)[..., None] * outward
            - (profile * fade_slope)[..., None] * sideways
        )
        return np.asarray(normals / np.linalg.norm(normals, axis=-1, keepdims=True))

    def triangles(self) -> Float32Array:
        """The surface as triangles (M, 3, 3), metres, with their normals upwards; small triangles along a hump."""
        along, beside = np.array([-EXTENT, EXTENT]), np.array([-EXTENT, EXTENT])
        arm: Arm = "east"
        if self.hump is not None and not self.is_flat:
            arm = self.hump.arm
            low, high = (
                self.hump.distance - self.hump.length / 2,
                self.hump.distance + self.hump.length / 2,
            )
            along = _with_lines(np.linspace(low, high, int(np.ceil(self.hump.length / _STEP)) + 1))
            slope = np.linspace(*_SHOULDERS, 12)
            beside = _with_lines(np.concatenate([-slope[::-1], slope]))
        outward = np.array(OUTWARD[arm], dtype=np.float64)
        sideways = np.array([-outward[1], outward[0]])
        xy = along[:, None, None] * outward + beside[None, :, None] * sideways
        grid = np.concatenate([xy, self.height(xy)[..., None]], axis=2)
        near_right, far_right = grid[:-1, :-1], grid[1:, :-1]
        near_left, far_left = grid[:-1, 1:], grid[1:, 1:]
        halves = [
            np.stack([near_right, far_right, far_left], axis=2),
            np.stack([near_right, far_left, near_left], axis=2),
        ]
        return np.concatenate([half.reshape(-1, 3, 3) for half in halves]).astype(np.float32)


def _along_and_beside(points: FloatArray, arm: Arm) -> tuple[FloatArray, FloatArray]:
    """Metres from the middle along an arm, and to the left of its middle line."""
    x, y = OUTWARD[arm]
    return points[..., 0] * x + points[..., 1] * y, points[..., 1] * x - points[..., 0] * y


def _profile(along: FloatArray, hump: Hump) -> tuple[FloatArray, FloatArray]:
    """Height and slope along the arm: a constant grade up and down, with parabolas at the crest and at the feet."""
    half, curve = hump.length / 2, hump.length / 2 * _CURVED
    off = np.minimum(np.abs(along - hump.distance), half)
    grade = hump.grade
    to_foot = half - off
    height = np.where(
        off < curve,
        hump.height - grade * off**2 / (2 * curve),
        np.where(
            to_foot < curve,
            grade * to_foot**2 / (2 * curve),
            hump.height - grade * (off - curve / 2),
        ),
    )
    slope = grade * np.minimum(np.minimum(off, to_foot) / curve, 1.0)
    return height, -np.sign(along - hump.distance) * slope


def _fade(beside: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The share of its height that a hump has beside the road, and the slope of that share."""
    low, high = _SHOULDERS
    share = np.clip((np.abs(beside) - low) / (high - low), 0.0, 1.0)
    return 1 - share**2 * (3 - 2 * share), -np.sign(beside) * 6 * share * (1 - share) / (high - low)


def _with_lines(inner: FloatArray) -> FloatArray:
    return np.concatenate([[-EXTENT], inner[np.abs(inner) < EXTENT], [EXTENT]])


RoadKind = Literal["four-way", "three-way"]

LANE_WIDTH = 3.5
PARKING_WIDTH = 2.4
SIDEWALK_WIDTH = 3.0
CROSSWALK_WIDTH = 3.0
# Radius of the rounded corners, metres.
KERB_RADIUS = 5.0
MAX_LANES = 2
# How many metres the mouth of an arm lies before the end of the rounded kerb.
_MOUTH = 2.0
_STOP_LINE = 0.4


@dataclass(frozen=True, slots=True, kw_only=True)
class RoadSpec:
    """A junction of straight roads at right angles; checked when made, raises ConfigError.

    Attributes:
        kind: a three-way junction has no north arm.
        signalized: whether it has traffic lights.
        lanes: number of lanes in each direction, 1 or 2.
        hump: a rise on one arm, or None.
    """

    kind: RoadKind = "four-way"
    signalized: bool = True
    lanes: int = 1
    hump: Hump | None = None

    def __post_init__(self) -> None:
        """Check every field."""
        object.__setattr__(
            self, "kind", choice("road.kind", self.kind, get_args(RoadKind), error=ConfigError)
        )
        if not 1 <= self.lanes <= MAX_LANES:
            raise ConfigError(
                f"road.lanes: expected 1 or {MAX_LANES} in each direction, found {self.lanes}"
            )
        if self.hump is not None:
            self._check_hump(self.hump)

    @property
    def arms(self) -> tuple[Arm, ...]:
        """The arms that the junction has, counter-clockwise from the west."""
        return ARMS if self.kind == "four-way" else ARMS[:3]

    @property
    def yielding_arms(self) -> tuple[Arm, ...]:
        """The arms that have a yield line: at a junction without lights, those of the road from south to north."""
        return (
            () if self.signalized else tuple(arm for arm in self.arms if arm in ("south", "north"))
        )

    @property
    def lanes_edge(self) -> float:
        """Metres from an arm's middle line to the outer edge of its lanes."""
        return self.lanes * LANE_WIDTH

    @property
    def road_edge(self) -> float:
        """Metres from an arm's middle line to the kerb."""
        return self.lanes_edge + PARKING_WIDTH

    @property
    def sidewalk_edge(self) -> float:
        """Metres from an arm's middle line to where the sidewalk ends."""
        return self.road_edge + SIDEWALK_WIDTH

    @property
    def mouth(self) -> float:
        """Metres from the junction's middle along an arm to where the arm and its crosswalk begin."""
        return self.road_edge + KERB_RADIUS - _MOUTH

    @property
    def crosswalk(self) -> tuple[float, float]:
        """Where the crosswalk begins and ends, metres along an arm."""
        return self.mouth, self.mouth + CROSSWALK_WIDTH

    @property
    def stop_line(self) -> tuple[float, float]:
        """Where the stop line begins and ends, metres along an arm."""
        near = self.crosswalk[1] + 0.7
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


# Length of a parking slot, metres: the gaps between parked cars are about one metre.
SLOT_LENGTH = 5.8
# Metres before the stop line that have no parking slots.
_KEPT_FREE = 6.0
_LAST = 110.0


def slot_edges(spec: RoadSpec) -> FloatArray:
    """The edges of the parking slots, metres along an arm, (S + 1,)."""
    first = spec.stop_line[1] + _KEPT_FREE
    return np.asarray(
        first + SLOT_LENGTH * np.arange(int((_LAST - first) / SLOT_LENGTH) + 1, dtype=np.float64)
    )


def parking_places(spec: RoadSpec) -> FloatArray:
    """x, y (metres), yaw (radians) of the middles of all slots (N, 3), in the direction of the traffic beside them."""
    edges = slot_edges(spec)
    along = (edges[:-1] + edges[1:]) / 2
    beside = spec.road_edge - PARKING_WIDTH / 2
    places = []
    for arm in spec.arms:
        x, y = OUTWARD[arm]
        outward = np.arctan2(y, x)
        for side, yaw in ((1, outward + np.pi), (-1, outward)):
            places.append(
                np.column_stack(
                    [
                        along * x - side * beside * y,
                        along * y + side * beside * x,
                        np.full(len(along), np.arctan2(np.sin(yaw), np.cos(yaw))),
                    ]
                )
            )
    return np.concatenate(places)
