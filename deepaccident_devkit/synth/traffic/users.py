"""One road user before the simulation: what it is, where it starts, how it drives and what it does not mind."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.synth.bodies import Body
from deepaccident_devkit.synth.roads.junction import Route
from deepaccident_devkit.synth.roads.paths import Path
from deepaccident_devkit.synth.spec.model import Role, Rule
from deepaccident_devkit.synth.traffic.following import Temper
from deepaccident_devkit.synth.traffic.kinematics import WHEELBASE

WALKER = "pedestrian"


@dataclass(frozen=True, slots=True)
class Manner:
    """How the drivers of a category drive.

    Attributes:
        acceleration: from standstill, m/s².
        braking: that they find comfortable, m/s².
        time_gap: seconds to the one ahead.
        min_gap: metres, bumper to bumper, when standing.
        lateral: across themselves in a bend, m/s².
        max_speed: from, to: m/s on a free straight road.
    """

    acceleration: float
    braking: float
    time_gap: float
    min_gap: float
    lateral: float
    max_speed: tuple[float, float]


MANNERS = {
    "car": Manner(2.2, 2.5, 0.9, 2.0, 2.8, (8.0, 12.5)),
    "van": Manner(2.0, 2.4, 0.9, 2.0, 2.5, (7.5, 11.5)),
    "truck": Manner(1.6, 2.0, 1.2, 2.5, 1.8, (7.0, 10.0)),
    "motorcycle": Manner(2.8, 2.8, 1.0, 1.8, 3.0, (8.0, 12.5)),
    "cyclist": Manner(1.0, 1.8, 1.0, 1.2, 2.0, (3.5, 6.0)),
    "pedestrian": Manner(1.5, 2.0, 0.4, 0.5, 9.0, (0.9, 1.7)),
}
"""By category."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RoadUser:
    """One who moves.

    Attributes:
        role: who it is in the scenario.
        body: its size and shape.
        path: of its middle axis.
        start: how far along its path its box's centre starts, metres.
        start_speed: m/s.
        max_speed: that it reaches on a free straight road, m/s.
        delay: seconds that it stands before it sets off.
        route: its way over the junction; None for one that walks.
        span: from, to: the stretch of its path on which its way may cross others', metres; empty for one that stays
            on the sidewalk.
        ignores: the rules that it breaks.
        alert: seconds before a contact at which it notices the one whom it is timed to meet; 0 for never.
    """

    role: Role
    body: Body
    path: Path
    start: float
    start_speed: float
    max_speed: float
    delay: float = 0.0
    route: Route | None = None
    span: tuple[float, float] = (0.0, 0.0)
    ignores: tuple[Rule, ...] = ()
    alert: float = 0.0

    @property
    def walks(self) -> bool:
        """Whether it has no wheels."""
        return self.body.category == WALKER

    @property
    def manner(self) -> Manner:
        """How it drives."""
        return MANNERS[self.body.category]

    @property
    def wheelbase(self) -> float:
        """Metres; 0 without wheels."""
        return 0.0 if self.walks else WHEELBASE * self.body.size[0]

    def obeying(self) -> "RoadUser":
        """The same one, that breaks no rule."""
        return replace(self, ignores=())


def temper_of(users: Sequence[RoadUser]) -> Temper:
    """How they drive, as arrays."""
    return Temper(
        max_speed=_gather(users, lambda user: user.max_speed),
        acceleration=_gather(users, lambda user: user.manner.acceleration),
        braking=_gather(users, lambda user: user.manner.braking),
        time_gap=_gather(users, lambda user: user.manner.time_gap),
        min_gap=_gather(users, lambda user: user.manner.min_gap),
    )


def _gather(users: Sequence[RoadUser], value: Callable[[RoadUser], float]) -> FloatArray:
    return np.array([value(user) for user in users], dtype=np.float64)
