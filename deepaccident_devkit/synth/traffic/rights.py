"""The rules of the road between all pairs of road users."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.arrays import BoolArray
from deepaccident_devkit.synth.roads.terrain import OUTWARD, Arm
from deepaccident_devkit.synth.traffic.conflicts import Zones, find_zones
from deepaccident_devkit.synth.traffic.users import RoadUser


@dataclass(frozen=True, slots=True, eq=False)
class Rights:
    """What holds between all ordered pairs of road users during a whole simulation.

    Attributes:
        zones: where their ways meet.
        waits: (A, A) bool, whether the row's has to let the column's go first.
        sees: (A, A) bool, whether the row's brakes for the column's where that is in its way.
    """

    zones: Zones
    waits: BoolArray
    sees: BoolArray


def find_rights(
    users: Sequence[RoadUser],
    *,
    minor: Sequence[Arm] = (),
    blind: tuple[int, int] | None = None,
) -> Rights:
    """The rights of all pairs.

    Args:
        users: the road users.
        minor: arms that give way to the others; none where lights keep them apart.
        blind: rows of a pair that see nobody but the others on their own arm; everyone else lets them go first, so
            that they meet.
    """
    count = len(users)
    together, waits = np.zeros((count, count), dtype=bool), np.zeros((count, count), dtype=bool)
    sees = ~np.eye(count, dtype=bool)
    for i, one in enumerate(users):
        for j, other in enumerate(users):
            together[i, j] = _go_together(one, other)
            waits[i, j] = _waits(one, other, minor)
            if other.walks and "crosswalk" in one.ignores:
                sees[i, j] = False
    if blind is not None:
        waits[:, list(blind)] = True
        for row in blind:
            waits[row], sees[row] = False, [_same_arm(users[row], other) for other in users]
            sees[row, list(blind)] = False
    widths = np.array([user.body.size[1] for user in users])
    zones = find_zones([user.path for user in users], [user.span for user in users], widths, together)
    return Rights(zones, waits, sees)


def _go_together(one: RoadUser, other: RoadUser) -> bool:
    """Whether they come from the same arm, where one follows the other, or both walk."""
    return _same_arm(one, other) or (one.walks and other.walks)


def _same_arm(one: RoadUser, other: RoadUser) -> bool:
    return one.route is not None and other.route is not None and one.route.from_arm == other.route.from_arm


def _waits(one: RoadUser, other: RoadUser, minor: Sequence[Arm]) -> bool:
    if one.route is None:
        return False
    if other.route is None:
        return "crosswalk" not in one.ignores
    if "priority" in one.ignores:
        return False
    if (one.route.from_arm in minor) != (other.route.from_arm in minor):
        return one.route.from_arm in minor
    opposite = OUTWARD[one.route.from_arm] == tuple(-value for value in OUTWARD[other.route.from_arm])
    return opposite and one.route.turn == "left" and other.route.turn != "left"
