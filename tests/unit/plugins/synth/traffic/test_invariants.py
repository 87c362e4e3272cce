"""What holds at every step of every scenario, whatever happens in it: physics, lanes, lights,
people, flow.
"""

from functools import lru_cache

import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.plan import SynthConfig, plan_scenarios
from deepaccident_devkit.plugins.synth.roads import ROAD_CODES, SIDEWALK, Junction
from deepaccident_devkit.plugins.synth.spec import DESIGN_NUMBERS
from deepaccident_devkit.plugins.synth.traffic.accidents import (
    Performance,
    perform_twin,
    set_stage,
    touching_pairs,
    try_accident,
)
from deepaccident_devkit.plugins.synth.traffic.driving import HARDEST_BRAKING, MAX_STEER, PERIOD
from deepaccident_devkit.plugins.synth.traffic.placement import WARM_UP, unplanned
from deepaccident_devkit.plugins.synth.traffic.rights import GREEN, RED
from deepaccident_devkit.plugins.synth.world import random_world

pytestmark = pytest.mark.slow

CORNERS = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) / 2
MAPPED = 143.0
"""Metres from the middle within which the ground is known under a whole truck."""
SCENES = [
    *((design, "designed") for design in DESIGN_NUMBERS),
    (1, "hidden"),
    (7, "hidden"),
    (3, "unplanned"),
    (7, "unplanned"),
    (12, "unplanned"),
]


class Run:
    """Part of a performance: all but the contact, and who took part."""

    def __init__(self, stage, performance, *, accident):
        simulation = performance.simulation
        steps = slice(0, len(simulation.time) - 1 if accident else None)
        self.stage, self.accident = stage, accident
        self.users = [stage.users[row] for row in performance.present]
        self.time, self.states = simulation.time[steps], simulation.states[steps]
        self.velocities = simulation.velocities[steps]
        self.size = np.array([user.body.size[:2] for user in self.users])
        self.driving = np.flatnonzero([not user.walks for user in self.users])

    @property
    def poses(self):
        return self.states[..., :3]

    def corners(self, every=10):
        """(S', A, 4, 2), metres."""
        poses = self.poses[::every]
        cos, sin = np.cos(poses[..., 2, None]), np.sin(poses[..., 2, None])
        along, across = self.size[:, :1] * CORNERS[:, 0], self.size[:, 1:] * CORNERS[:, 1]
        x = poses[..., 0, None] + cos * along - sin * across
        return np.stack([x, poses[..., 1, None] + sin * along + cos * across], axis=-1)


@lru_cache(maxsize=32)
def runs(design, kind):
    """An accident and its twin, as a release has them."""
    view = "hidden" if kind == "hidden" else None
    plan = plan_scenarios(
        SynthConfig(
            scenarios=1, designs=(design,), unplanned=0.0, seed=design, view=view, designed=True
        )
    )[0]
    rng = np.random.default_rng([design, 4])
    for _ in range(5):
        spec = plan.draw(rng)
        junction = Junction(spec.road)
        spec = unplanned(rng, spec, junction) if kind == "unplanned" else spec
        stage = set_stage(rng, spec, junction, 7.5)
        accident = try_accident(stage)
        if isinstance(accident, Performance):
            twin = perform_twin(stage, stage.cast.begin + WARM_UP + 10.0)
            return Run(stage, accident, accident=True), Run(stage, twin, accident=False)
    raise AssertionError("nobody met in five draws")


def over_scenes(test):
    return pytest.mark.parametrize(("design", "kind"), SCENES)(test)


@over_scenes
def test_nobody_touches_anybody(design, kind):
    for run in runs(design, kind):
        parked = np.array([vehicle.pose for vehicle in run.stage.parked]).reshape(-1, 3)
        size = np.array([vehicle.body.size[:2] for vehicle in run.stage.parked]).reshape(-1, 2)
        poses = np.concatenate(
            [run.poses, np.broadcast_to(parked, (len(run.time), *parked.shape))], axis=1
        )
        assert touching_pairs(poses, np.concatenate([run.size, size]), 0.0) == []


@over_scenes
def test_wheels_roll_and_do_not_slide(design, kind):
    for run in runs(design, kind):
        yaw, half = (
            run.poses[:, run.driving, 2],
            [run.users[row].wheelbase / 2 for row in run.driving],
        )
        rear = run.poses[:, run.driving, :2] - np.stack(
            [half * np.cos(yaw), half * np.sin(yaw)], axis=-1
        )
        moved, middle = np.diff(rear, axis=0) / PERIOD, (yaw[1:] + yaw[:-1]) / 2
        assert np.abs(np.cos(middle) * moved[..., 1] - np.sin(middle) * moved[..., 0]).max() < 1e-3
        assert (np.cos(middle) * moved[..., 0] + np.sin(middle) * moved[..., 1]).min() > -1e-9
        speed = np.maximum(run.states[1:, run.driving, 3], run.states[:-1, run.driving, 3])
        turning = np.abs(np.diff(yaw, axis=0)) / PERIOD
        assert (turning <= speed * np.tan(MAX_STEER) / (2 * np.array(half)) + 1e-6).all()
        assert (turning * speed).max() < 5.0  # m/s² to the side


@over_scenes
def test_nobody_jumps(design, kind):
    for run in runs(design, kind):
        change = np.diff(run.states[..., 3], axis=0) / PERIOD
        assert -HARDEST_BRAKING - 1e-6 <= change.min() <= change.max() < 3.5
        between = (run.velocities[1:] + run.velocities[:-1]) / 2
        assert (
            np.abs(
                np.diff(run.poses[:, run.driving, :2], axis=0) / PERIOD - between[:, run.driving]
            ).max()
            < 0.05
        )


@over_scenes
def test_everyone_stays_where_it_belongs(design, kind):
    for run in runs(design, kind):
        spec = run.stage.spec
        arms = tuple(spec.actor(role).from_arm or "west" for role in ("ego", "other"))
        world = random_world(
            np.random.default_rng(design), run.stage.junction, spec.view, between=arms
        )
        codes = world.top.at(run.corners().reshape(-1, 2)).reshape(-1, len(run.users), 4)
        mapped = (np.abs(run.poses[::10, :, :2]).max(axis=-1) < MAPPED)[..., None]
        for row, user in enumerate(run.users):
            allowed = (*ROAD_CODES, SIDEWALK) if user.walks else ROAD_CODES
            assert (np.isin(codes[:, row], allowed) | ~mapped[:, row]).all(), user.role


@over_scenes
def test_at_red_drives_only_who_breaks_that_rule_and_its_follower(design, kind):
    for run in (each for each in runs(design, kind) if each.stage.signals):
        free = run.stage.cast.pair if run.accident else ()
        for row, user in ((row, user) for row, user in enumerate(run.users) if user.route):
            front = user.path.project(run.poses[::5, row, :2])[0] + user.body.size[0] / 2
            passing = np.flatnonzero(
                (front[:-1] < user.route.stop_s + 0.6) & (front[1:] >= user.route.stop_s + 0.6)
            )
            red = [
                run.stage.signals.state(user.route.from_arm, run.time[::5][step]) == RED
                for step in passing
            ]
            assert not any(red) or row in free or (run.accident and "signal" in user.ignores)


@over_scenes
def test_traffic_flows_on(design, kind):
    """Of those who have no red light, few stand during the last five seconds."""
    for run in runs(design, kind):
        since, lights = max(len(run.time) - round(5.0 / PERIOD), 0), run.stage.signals
        arms = {row: run.users[row].route.from_arm for row in run.driving}
        free = [
            row
            for row in arms
            if not lights or (lights.state(arms[row], run.time[since::25]) == GREEN).all()
        ]
        assert (run.states[since:, free, 3] < 0.3).all(axis=0).sum() <= 2 + len(free) / 4


@over_scenes
def test_those_who_follow_are_behind_at_a_sensible_gap(design, kind):
    for run in runs(design, kind):
        cast = run.stage.cast
        for leader, follower in (("ego", "ego_behind"), ("other", "other_behind")):
            first, second = (cast.row_of(role) for role in (leader, follower))
            path = cast.users[first].path
            ahead, behind = (path.project(run.poses[::10, row, :2])[0] for row in (first, second))
            gap = ahead - behind - (run.size[first, 0] + run.size[second, 0]) / 2
            assert (gap.min() > 1.0, gap[0]) == (True, pytest.approx(12.0, abs=4.5))
