"""Who touches whom, when, with which sides and how hard; and if the two do not, how they missed each other."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from typing import Final, Literal, TypeAlias

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.synth.collision import gap, separation
from deepaccident_devkit.synth.roads import crossing
from deepaccident_devkit.synth.spec.model import Role
from deepaccident_devkit.synth.traffic.casting import WARM_UP
from deepaccident_devkit.synth.traffic.simulate import Simulation
from deepaccident_devkit.synth.traffic.users import RoadUser

_LOOK_STEP = 5
"""Which road users are near each other is computed once in so many steps."""
_NEAR = 2.0
"""How much nearer two can come between these steps, metres."""


def touching_pairs(poses: FloatArray, size: FloatArray, margin: float) -> list[tuple[int, int]]:
    """Pairs of rows, the lower one first, that come nearer to each other than `margin`, along any side's normal.

    Args:
        poses: (S, A, 3) x, y (metres), yaw (radians) of the boxes' centres.
        size: (A, 2) length and width, metres.
        margin: metres.
    """
    found = []
    for i, j in _near_pairs(poses, size, margin):
        if (separation(poses[:, i], size[i], poses[:, j], size[j]) < margin).any():
            found.append((i, j))
    return found


def least_gap(poses: FloatArray, size: FloatArray, rows: list[int], enough: float) -> float:
    """The least distance in metres between any two of `rows`; arguments as in `touching_pairs`.

    Pairs that never come nearer than `enough` do not count; if there are no other pairs, the result is `enough`.
    """
    pairs = _near_pairs(poses[:, rows], size[rows], enough)
    gaps = [float(gap(poses[:, rows[i]], size[rows[i]], poses[:, rows[j]], size[rows[j]]).min()) for i, j in pairs]
    return min([*gaps, enough])


def _near_pairs(poses: FloatArray, size: FloatArray, margin: float) -> list[tuple[int, int]]:
    """Pairs of rows that may come nearer than `margin`."""
    moments = np.concatenate([poses[::_LOOK_STEP], poses[-1:]])
    x, y = moments[..., 0], moments[..., 1]
    square = (x[:, :, None] - x[:, None, :]) ** 2 + (y[:, :, None] - y[:, None, :]) ** 2
    radius = np.hypot(size[:, 0], size[:, 1]) / 2
    near = (square < (radius[:, None] + radius + margin + _NEAR) ** 2).any(axis=0)
    rows, columns = np.nonzero(np.triu(near, 1))
    return list(zip(rows.tolist(), columns.tolist(), strict=True))


ContactSide = Literal["front", "back", "left", "right"]
_AREA_MASS = 60.0
"""Impact for each m² of the first box and m/s; so the numbers are about as large as in the real release."""
_HALVINGS = 40


@dataclass(frozen=True, slots=True)
class Impact:
    """The end of an accident.

    Attributes:
        time: seconds, when the boxes first touch.
        side: the side of the first one's box that is hit.
        strength: the impact in the meta file.
        angle: angle between their headings, from 0 to π.
    """

    time: float
    side: ContactSide
    strength: float
    angle: float


def impact_of(simulation: Simulation, pair: tuple[int, int], size: FloatArray) -> Impact:
    """The impact that ends a simulation.

    Args:
        simulation: one with a contact.
        pair: rows of the two who touch.
        size: (2, 2) length and width of the two, metres.
    """
    rows = list(pair)
    last = simulation.poses[-1][rows]
    before = simulation.poses[-2][rows] if len(simulation.time) > 1 else last
    share = _touching_share(before, last, size)
    poses = before + share * (last - before)
    period = float(simulation.time[-1] - simulation.time[-2]) if len(simulation.time) > 1 else 0.0
    velocity = simulation.velocities[-1][rows]
    turn = poses[1, 2] - poses[0, 2]
    return Impact(
        time=float(simulation.time[-1]) - (1.0 - share) * period,
        side=contact_side(poses, size),
        strength=float(_AREA_MASS * size[0].prod() * np.hypot(*(velocity[0] - velocity[1]))),
        angle=float(abs(np.arctan2(np.sin(turn), np.cos(turn)))),
    )


def _touching_share(before: FloatArray, after: FloatArray, size: FloatArray) -> float:
    """The share of a step (2, 3) → (2, 3) that is over when the boxes touch, by halving; at the result they touch."""
    apart, touching = 0.0, 1.0
    for _ in range(_HALVINGS):
        middle = (apart + touching) / 2
        first, second = before + middle * (after - before)
        if separation(first, size[0], second, size[1]) > 0:
            apart = middle
        else:
            touching = middle
    return touching


def contact_side(poses: FloatArray, size: FloatArray) -> ContactSide:
    """The side of the first of two boxes that faces the second across the widest gap along any side's normal.

    Args:
        poses: (2, 3) x, y (metres), yaw (radians) of the boxes' centres.
        size: (2, 2) length and width of the two, metres.
    """
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    axes = np.stack([np.stack([cos, sin], axis=1), np.stack([-sin, cos], axis=1)], axis=1)  # box, axis, xy
    normals = axes.reshape(4, 2)
    reach = np.abs(np.einsum("na,bka->nbk", normals, axes) * size / 2).sum(axis=(1, 2))
    apart = normals @ (poses[1, :2] - poses[0, :2])
    best = int(np.argmax(np.abs(apart) - reach))
    along, across = axes[0] @ (normals[best] * np.sign(apart[best]))
    if abs(along) >= abs(across):
        return "front" if along > 0 else "back"
    return "left" if across > 0 else "right"


_Roles: TypeAlias = tuple[Role, Role]
FAR: Final = 8.0
"""Metres: two whose least distance is larger miss each other by far."""
_LATE: Final = 0.5
"""Seconds after the planned time from which one counts as late."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Arrival:
    """When one of the two comes to the crossing of their paths.

    Attributes:
        role: who it is.
        time: seconds since the beginning of the recording; if it does not come, the end of the simulation.
        came: whether it comes there.
        late: seconds after the planned time.
    """

    role: Role
    time: float
    came: bool
    late: float

    def __str__(self) -> str:
        """Such as `ego at 6.2 s`."""
        return f"{self.role} {'at' if self.came else 'not before'} {self.time:.1f} s"


@dataclass(frozen=True, slots=True, kw_only=True)
class Miss:
    """A draw without a collision of the two.

    Attributes:
        gap: the least distance between the two, metres; infinite if their paths do not cross; 0 if others touched.
        arrivals: of the two; empty if their paths do not cross, or if others touched.
        touched: the roles of two others who touched each other before; None if nobody did.
    """

    gap: float = inf
    arrivals: tuple[Arrival, ...] = ()
    touched: _Roles | None = None


def measured_miss(
    simulation: Simulation, pair: tuple[int, int], users: Sequence[RoadUser], *, planned: tuple[float, float]
) -> Miss:
    """How the two missed each other.

    Args:
        simulation: what happened.
        pair: the rows of the two, in the simulation and in `users`.
        users: the road users at the start.
        planned: the times at which the two were to come to the crossing of their paths, seconds.
    """
    poses: list[FloatArray] = [simulation.poses[:, row] for row in pair]
    sizes = [np.array(users[row].body.size[:2]) for row in pair]
    meeting = crossing(users[pair[0]].path, users[pair[1]].path)
    if meeting is None:
        return Miss()
    arrivals = []
    for row, track, place, due in zip(pair, poses, meeting, planned, strict=True):
        there = users[row].path.project(track[:, :2])[0] >= place
        time = float(simulation.time[there.argmax() if there.any() else -1])
        arrivals.append(
            Arrival(
                role=users[row].role,
                time=time - float(simulation.time[0]) - WARM_UP,
                came=bool(there.any()),
                late=max(time - due, 0.0),
            )
        )
    least = float(gap(poses[0], sizes[0], poses[1], sizes[1]).min())
    return Miss(gap=least, arrivals=tuple(arrivals))


def by_far(misses: Sequence[Miss]) -> bool:
    """Whether the two missed each other by far in all of these draws."""
    return all(miss.gap > FAR for miss in misses)


def misses_text(misses: Sequence[Miss], roles: _Roles) -> str:
    """What happened in draws without a collision, and the remedy; one draw or more.

    Args:
        misses: of all draws.
        roles: the two who were to collide.
    """
    first, second = roles
    draws = f"{len(misses)} draw{'s' if len(misses) > 1 else ''}"
    parts = [f"{first} and {second} did not collide in {draws}"]
    measured = [miss for miss in misses if miss.arrivals]
    if measured:
        nearest = min(measured, key=lambda miss: miss.gap)
        came = " and ".join(map(str, nearest.arrivals))
        parts.append(
            f"the least distance was {nearest.gap:.1f} m, where they came to the crossing of their paths: {came}"
        )
    late = _late_counts(misses)
    parts += [
        f"{role} came {_LATE:g} s or more later than planned in {count} of the draws" for role, count in late.items()
    ]
    if touching := Counter(miss.touched for miss in misses if miss.touched is not None):
        others, _ = touching.most_common(1)[0]
        parts.append(f"in {touching.total()} of the draws others touched before, such as {' and '.join(others)}")
    return f"{'; '.join(parts)}; {_remedy(misses)}"


def _late_counts(misses: Sequence[Miss]) -> dict[Role, int]:
    """Role → in how many draws it was late; only those who were."""
    return dict(Counter(arrival.role for miss in misses for arrival in miss.arrivals if arrival.late > _LATE))


def _remedy(misses: Sequence[Miss]) -> str:
    """What to change: the cause of more than half of the misses decides."""
    most = len(misses) / 2
    if sum(miss.gap == inf for miss in misses) > most:
        return "their paths do not cross: change from, turn or side of one of them"
    if sum(miss.touched is not None for miss in misses) > most:
        return "let those who touched start farther apart (gap, from, lane), or give them another max_speed"
    for role, count in _late_counts(misses).items():
        if count > most:
            return f"others are in the way of {role}: choose fewer background.vehicles, or another lane"
    return "choose a meet.offset nearer to 0, or another max_speed for one of the two"
