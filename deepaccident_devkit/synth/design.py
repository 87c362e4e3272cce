"""The designed accident: two cars on crossing paths, each followed by another, and the normal twin where they pass."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.synth.actors import SetOff
from deepaccident_devkit.synth.bodies import Body, random_body
from deepaccident_devkit.synth.collision import gap, separation
from deepaccident_devkit.synth.roads import LANE_CENTER
from deepaccident_devkit.taxonomy import VEHICLE_AGENTS, AgentName

Motions = Mapping[AgentName, SetOff]

SPEEDS = (7.0, 11.0)
"""m/s, between which the two drive where they see each other early."""
_EGO, _EGO_BEHIND, _OTHER, _OTHER_BEHIND = VEHICLE_AGENTS
_OFF_CENTER = 2.75
"""Metres that one may be late at most where the paths cross, so that the two still meet."""
_PASSING_GAP = 2.2
"""Metres that the twin's cars keep at least."""
_TOUCH = 1e-9
"""Seconds before the exact contact at which the recording ends: the boxes touch and do not overlap."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Encounter:
    """Who meets whom, and how.

    Attributes:
        bodies: of the four vehicle agents.
        accident: their motions where ego and other touch at `end_time`.
        normal: their motions where nobody touches anybody.
        end_time: of the last recorded frame, seconds.
        spawn_side: where the other vehicle comes from, seen from ego: `left` or `right`.
        impact: of the contact; the mass that meets times its speed, 10 kg·m/s.
    """

    bodies: Mapping[AgentName, Body]
    accident: Motions
    normal: Motions
    end_time: float
    spawn_side: str
    impact: float


def random_encounter(rng: np.random.Generator, end_time: float, speeds: tuple[float, float] = SPEEDS) -> Encounter:
    """Design an accident of crossing paths, both straight on, whose contact is at `end_time`, seconds.

    Args:
        rng: random numbers.
        end_time: of the contact.
        speeds: m/s, between which both drive when they meet.
    """
    bodies = {agent: random_body(rng, "car") for agent in VEHICLE_AGENTS}
    side = str(rng.choice(["left", "right"]))
    from_side = -np.pi / 2 if side == "left" else np.pi / 2
    paths = {_EGO: _approach(rng, 0.0, speeds), _OTHER: _approach(rng, from_side, speeds)}
    delay = _OFF_CENTER / speeds[1]
    paths[_OTHER] = paths[_OTHER].delayed(rng.uniform(-delay, delay))
    until_end = end_time - _contact_time(paths[_EGO], bodies[_EGO], paths[_OTHER], bodies[_OTHER])
    leaders = {agent: path.delayed(until_end) for agent, path in paths.items()}
    accident = {
        _EGO: leaders[_EGO],
        _EGO_BEHIND: _follower(rng, leaders[_EGO], bodies[_EGO], bodies[_EGO_BEHIND]),
        _OTHER: leaders[_OTHER],
        _OTHER_BEHIND: _follower(rng, leaders[_OTHER], bodies[_OTHER], bodies[_OTHER_BEHIND]),
    }
    normal = _passing(accident, bodies, end_time, earlier=bool(rng.random() < 0.5))
    speed = float(np.hypot(paths[_EGO].speed, paths[_OTHER].speed))
    return Encounter(
        bodies=bodies,
        accident=accident,
        normal=normal,
        end_time=end_time,
        spawn_side=side,
        impact=60.0 * bodies[_EGO].size[0] * bodies[_EGO].size[1] * speed,
    )


def footprint(body: Body) -> FloatArray:
    """Length and width of a body's box, (2,) metres."""
    return np.array(body.size[:2])


def _approach(rng: np.random.Generator, yaw: float, speeds: tuple[float, float]) -> SetOff:
    """Towards the junction in the right lane, passing its middle at time 0."""
    distance, speed, acceleration = rng.uniform(60, 80), rng.uniform(*speeds), rng.uniform(2, 3)
    x = -np.cos(yaw) * distance + np.sin(yaw) * LANE_CENTER
    y = -np.sin(yaw) * distance - np.cos(yaw) * LANE_CENTER
    path = SetOff(float(x), float(y), float(yaw), float(speed), float(acceleration), 0.0)
    return path.delayed(-path.time_to(distance))


def _contact_time(path_a: SetOff, body_a: Body, path_b: SetOff, body_b: Body) -> float:
    """When two boxes on crossing paths first touch, by scanning and halving, seconds."""

    def separated(times: FloatArray) -> FloatArray:
        return separation(path_a.poses(times), footprint(body_a), path_b.poses(times), footprint(body_b))

    times = np.arange(-3.0, 3.0, 0.005)
    first = int(np.argmax(separated(times) <= 0))
    apart, touching = float(times[first - 1]), float(times[first])
    for _ in range(60):
        middle = (apart + touching) / 2
        if separated(np.array([middle]))[0] > 0:
            apart = middle
        else:
            touching = middle
    return apart - _TOUCH


def _follower(rng: np.random.Generator, leader: SetOff, body: Body, follower: Body) -> SetOff:
    """The same motion, some metres behind."""
    behind = (body.size[0] + follower.size[0]) / 2 + rng.uniform(5, 10)
    x, y = leader.x - behind * np.cos(leader.yaw), leader.y - behind * np.sin(leader.yaw)
    return SetOff(float(x), float(y), leader.yaw, leader.speed, leader.acceleration, leader.start_time)


def _passing(accident: Motions, bodies: Mapping[AgentName, Body], end_time: float, *, earlier: bool) -> Motions:
    """The accident's motions with the other two cars so much earlier or later that all keep clear."""
    times = np.arange(0.0, end_time + 4.0, 0.05)
    for shift in np.arange(0.5, 30.0, 0.1) * (-1 if earlier else 1):
        others = {agent: accident[agent].delayed(float(shift)) for agent in (_OTHER, _OTHER_BEHIND)}
        motions = {**accident, **others}
        if _least_gap(motions, bodies, times) > _PASSING_GAP:
            return motions
    raise AssertionError("two straight paths that never get clear of each other")  # 30 s are 200 m


def _least_gap(motions: Motions, bodies: Mapping[AgentName, Body], times: FloatArray) -> float:
    return min(
        float(gap(motions[a].poses(times), footprint(bodies[a]), motions[b].poses(times), footprint(bodies[b])).min())
        for a in (_EGO, _EGO_BEHIND)
        for b in (_OTHER, _OTHER_BEHIND)
    )
