"""Draws in which the two who are timed to meet do not collide: how near they came, and what to change."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from typing import Final, TypeAlias

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.synth.collision import gap
from deepaccident_devkit.synth.roads import crossing
from deepaccident_devkit.synth.spec.model import Role
from deepaccident_devkit.synth.traffic.casting import WARM_UP
from deepaccident_devkit.synth.traffic.simulate import Simulation
from deepaccident_devkit.synth.traffic.users import RoadUser

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
