"""Rules that hold at every step of every scenario: physics, lanes, lights, people, flow."""

from functools import lru_cache

import numpy as np
import pytest

from deepaccident_devkit.geometry import Boxes
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
from deepaccident_devkit.plugins.synth.traffic.placement import WARM_UP, replan_accident
from deepaccident_devkit.plugins.synth.traffic.rights import GREEN, RED
from deepaccident_devkit.plugins.synth.world import random_world

pytestmark = pytest.mark.slow

MAPPED_DISTANCE_M = 143.0
"""Distance from the middle within which the ground is known under a whole truck."""
SCENES = [
    *((design, "designed") for design in DESIGN_NUMBERS),
    (1, "hidden"),
    (7, "hidden"),
    (3, "unplanned"),
    (7, "unplanned"),
    (12, "unplanned"),
]


class Run:
    """Part of a performance: all steps except the contact, and the users who took part."""

    def __init__(self, stage, performance, *, accident):
        simulation = performance.simulation
        steps = slice(0, len(simulation.time) - 1 if accident else None)
        self.stage = stage
        self.accident = accident
        self.users = [stage.users[row] for row in performance.present]
        self.time = simulation.time[steps]
        self.states = simulation.states[steps]
        self.poses = self.states[..., :3]
        self.velocities = simulation.velocities[steps]
        self.size = np.array([user.body.size[:2] for user in self.users])
        self.driving = np.flatnonzero([not user.walks for user in self.users])


@lru_cache(maxsize=32)
def make_runs(design, kind):
    """Make an accident and its twin, as a release has them."""
    config = SynthConfig(
        scenarios=1,
        designs=(design,),
        unplanned=0.0,
        seed=design,
        view="hidden" if kind == "hidden" else None,
        designed=True,
    )
    plan = plan_scenarios(config)[0]
    rng = np.random.default_rng([design, 4])
    for _ in range(5):
        spec = plan.draw(rng)
        junction = Junction(spec.road)
        if kind == "unplanned":
            spec = replan_accident(rng, spec, junction)
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
    for run in make_runs(design, kind):
        parked = run.stage.parked
        parked_poses = np.array([vehicle.pose for vehicle in parked]).reshape(-1, 3)
        parked_sizes = np.array([vehicle.body.size[:2] for vehicle in parked]).reshape(-1, 2)
        standing = np.broadcast_to(parked_poses, (len(run.time), *parked_poses.shape))

        poses = np.concatenate([run.poses, standing], axis=1)
        sizes = np.concatenate([run.size, parked_sizes])
        assert touching_pairs(poses, sizes, 0.0) == []


@over_scenes
def test_wheels_roll_and_do_not_slide(design, kind):
    for run in make_runs(design, kind):
        half_wheelbase = np.array([run.users[row].wheelbase / 2 for row in run.driving])
        yaw = run.poses[:, run.driving, 2]
        to_rear = np.stack([half_wheelbase * np.cos(yaw), half_wheelbase * np.sin(yaw)], axis=-1)
        rear_axle = run.poses[:, run.driving, :2] - to_rear

        rear_velocity = np.diff(rear_axle, axis=0) / PERIOD
        middle_yaw = (yaw[1:] + yaw[:-1]) / 2
        cos, sin = np.cos(middle_yaw), np.sin(middle_yaw)
        sideways = cos * rear_velocity[..., 1] - sin * rear_velocity[..., 0]
        forwards = cos * rear_velocity[..., 0] + sin * rear_velocity[..., 1]
        assert np.abs(sideways).max() < 1e-3
        assert forwards.min() > -1e-9

        speeds = run.states[:, run.driving, 3]
        speed = np.maximum(speeds[1:], speeds[:-1])
        yaw_rate = np.abs(np.diff(yaw, axis=0)) / PERIOD
        max_yaw_rate = speed * np.tan(MAX_STEER) / (2 * half_wheelbase)
        assert (yaw_rate <= max_yaw_rate + 1e-6).all()
        assert (yaw_rate * speed).max() < 5.0  # m/s² to the side


@over_scenes
def test_nobody_jumps(design, kind):
    for run in make_runs(design, kind):
        acceleration = np.diff(run.states[..., 3], axis=0) / PERIOD
        assert -HARDEST_BRAKING - 1e-6 <= acceleration.min() <= acceleration.max() < 3.5

        mean_velocity = (run.velocities[1:] + run.velocities[:-1]) / 2
        moved = np.diff(run.poses[:, run.driving, :2], axis=0) / PERIOD
        assert np.abs(moved - mean_velocity[:, run.driving]).max() < 0.05


@over_scenes
def test_everyone_stays_where_it_belongs(design, kind):
    for run in make_runs(design, kind):
        spec = run.stage.spec
        arms = tuple(spec.actor(role).from_arm or "west" for role in ("ego", "other"))
        rng = np.random.default_rng(design)
        world = random_world(rng, run.stage.junction, spec.view, between=arms)

        poses = run.poses[::10]
        flat_poses = poses.reshape(-1, 3)
        boxes = Boxes.from_arrays(
            flat_poses * (1, 1, 0),
            np.tile([user.body.size for user in run.users], (len(poses), 1)),
            flat_poses[:, 2],
        )
        corners = boxes.corners()[..., :2]
        codes = world.top.at(corners.reshape(-1, 2)).reshape(*poses.shape[:2], 8)

        mapped = np.abs(poses[..., :2]).max(axis=-1) < MAPPED_DISTANCE_M
        for row, user in enumerate(run.users):
            allowed = (*ROAD_CODES, SIDEWALK) if user.walks else ROAD_CODES
            mapped_codes = codes[mapped[:, row], row]
            assert np.isin(mapped_codes, allowed).all(), user.role


@over_scenes
def test_only_a_rule_breaker_and_its_follower_drive_at_red(design, kind):
    for run in make_runs(design, kind):
        signals = run.stage.signals
        exempt_rows = run.stage.cast.pair if run.accident else ()

        for row, user in enumerate(run.users):
            if not signals or not user.route or row in exempt_rows:
                continue
            if run.accident and "signal" in user.ignores:
                continue
            line = user.route.stop_s + 0.6
            front = user.path.project(run.poses[::5, row, :2])[0] + user.body.size[0] / 2
            crossing = np.flatnonzero((front[:-1] < line) & (front[1:] >= line))
            for time in run.time[::5][crossing]:
                assert signals.state(user.route.from_arm, time) != RED


@over_scenes
def test_traffic_flows_on(design, kind):
    """Few of the vehicles that have no red light stand during the last five seconds."""
    for run in make_runs(design, kind):
        start = max(len(run.time) - round(5.0 / PERIOD), 0)
        signals = run.stage.signals
        free = []
        for row in run.driving:
            arm = run.users[row].route.from_arm
            if not signals or (signals.state(arm, run.time[start::25]) == GREEN).all():
                free.append(row)

        standing = (run.states[start:, free, 3] < 0.3).all(axis=0)
        assert standing.sum() <= 2 + len(free) / 4


@over_scenes
def test_followers_keep_a_sensible_gap(design, kind):
    for run in make_runs(design, kind):
        cast = run.stage.cast
        for leader_role, follower_role in (("ego", "ego_behind"), ("other", "other_behind")):
            leader = cast.row_of(leader_role)
            follower = cast.row_of(follower_role)
            path = cast.users[leader].path
            leader_s, _ = path.project(run.poses[::10, leader, :2])
            follower_s, _ = path.project(run.poses[::10, follower, :2])

            lengths = run.size[[leader, follower], 0]
            gap = leader_s - follower_s - lengths.sum() / 2
            assert gap.min() > 1.0
            assert gap[0] == pytest.approx(12.0, abs=4.5)
