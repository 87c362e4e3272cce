"""Accidents that are in no design: with a pedestrian, a third vehicle, or a vehicle that changes lanes."""

from dataclasses import replace

import numpy as np

from deepaccident_devkit.synth.roads import Arm, Junction, Turn
from deepaccident_devkit.synth.spec import ActorSpec, MeetSpec, ScenarioSpec
from deepaccident_devkit.synth.spec.model import Role, Side

_PEDESTRIANS = 0.6
"""Share of accidents with a pedestrian; the others are with a third vehicle."""
_STEP_OUT_SPEEDS = (1.2, 2.2)
_STEP_OUT = (24.0, 45.0)
"""Least and most metres from the junction's middle to where a pedestrian steps onto the road."""
_BEHIND_CREST = (15.0, 22.0)
"""Metres from a hump's crest to a pedestrian behind it; the hump hides it until the victim is about 40 m away."""
_CUTTING_IN = 0.5
"""Share of third vehicles that come by the victim's arm and change into its lane, if the arm has two lanes."""
_CUT_IN = (45.0, 75.0)
"""Least and most metres from the junction's middle to where that change of lanes begins."""
_THIRD_SPEEDS = (8.0, 12.0)
_OFFSETS = (-0.2, 0.2)


def unplanned(rng: np.random.Generator, spec: ScenarioSpec, junction: Junction) -> ScenarioSpec:
    """The scenario with another accident: ego and other obey, and one of them meets a pedestrian or a third vehicle.

    Args:
        rng: random numbers.
        spec: a designed scenario.
        junction: its roads.
    """
    victims: tuple[Role, ...] = ("ego", "other")
    victim = spec.actor(victims[int(rng.integers(2))])
    used = {spec.actor(role).from_arm for role in victims}
    free = [arm for arm in junction.arms if arm not in used]
    on_foot = rng.random() < _PEDESTRIANS or not free
    goes_on = "straight" in junction.turns(victim.from_arm or "west")
    cuts_in = junction.spec.lanes == 2 and goes_on and rng.random() < _CUTTING_IN
    if on_foot:
        stranger = _pedestrian(rng, victim, spec)
    elif cuts_in:
        stranger = _cutting_in(rng, victim)
    else:
        stranger = _third_vehicle(rng, junction, free)
    actors = tuple(replace(actor, ignores=()) for actor in spec.actors)
    return replace(
        spec,
        design=None,
        actors=(*actors, stranger),
        meet=MeetSpec(actors=(victim.role, stranger.role), offset=float(rng.uniform(*_OFFSETS))),
    )


def _pedestrian(rng: np.random.Generator, victim: ActorSpec, spec: ScenarioSpec) -> ActorSpec:
    """A pedestrian who steps onto the road in front of the victim, behind the hump if there is one on its arm."""
    arm, hump = victim.from_arm or "west", spec.road.hump
    distance = float(rng.uniform(*_STEP_OUT))
    if hump is not None and hump.arm == arm:
        distance = hump.distance - float(rng.uniform(*_BEHIND_CREST))
    side: Side = "right" if rng.random() < 0.7 else "left"
    return ActorSpec(
        role="pedestrian",
        category="pedestrian",
        from_arm=arm,
        side=side,
        start_distance=distance,
        max_speed=float(rng.uniform(*_STEP_OUT_SPEEDS)),
    )


def _third_vehicle(rng: np.random.Generator, junction: Junction, free: list[Arm]) -> ActorSpec:
    """A vehicle that comes by an arm by which neither ego nor other comes, and reacts to nobody."""
    arm = free[int(rng.integers(len(free)))]
    turns = junction.turns(arm)
    turn: Turn = "straight" if "straight" in turns else "left"
    return ActorSpec(
        role="background",
        category=rng.choice(["car", "car", "van", "motorcycle"]).item(),
        from_arm=arm,
        turn=turn,
        lane=junction.spec.lanes - 1,
        max_speed=float(rng.uniform(*_THIRD_SPEEDS)),
        ignores=("signal", "priority"),
    )


def _cutting_in(rng: np.random.Generator, victim: ActorSpec) -> ActorSpec:
    """A vehicle in the lane beside the victim's that changes into the victim's lane without looking."""
    return ActorSpec(
        role="background",
        category=rng.choice(["car", "car", "van"]).item(),
        from_arm=victim.from_arm,
        lane=1 - victim.lane,
        max_speed=float(rng.uniform(*_THIRD_SPEEDS)),
        lane_change=float(rng.uniform(*_CUT_IN)),
        ignores=("signal", "priority"),
    )
