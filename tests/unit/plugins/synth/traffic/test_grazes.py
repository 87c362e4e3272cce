"""Contacts beside the accident: who touches whom, when, and how."""

import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.plan import SynthConfig, plan_scenarios
from deepaccident_devkit.plugins.synth.scenario import build_scenario
from deepaccident_devkit.plugins.synth.traffic.driving import PERIOD, WHEELBASE
from deepaccident_devkit.plugins.synth.traffic.grazes import swerves
from deepaccident_devkit.plugins.synth.traffic.simulate import Simulation, separation

SIZE = np.array([[4.5, 1.8], [4.5, 1.8]])


def oncoming(*, apart, speeds=(8.0, 8.0), seconds=8.0):
    """Two who drive towards each other on straight lanes and pass at half the time."""
    time = PERIOD * np.arange(round(seconds / PERIOD))
    states = np.zeros((len(time), 2, 5))
    for row, (speed, yaw, left) in enumerate(zip(speeds, (0.0, np.pi), (0.0, 1.8 + apart), strict=True)):
        way = speed * (time - seconds / 2)
        states[:, row] = np.stack([np.cos(yaw) * way, 0 * way + left, 0 * way + yaw, 0 * way + speed, 0 * way], axis=-1)
    velocities = np.gradient(states[..., :2], PERIOD, axis=0)
    return Simulation(time=time, states=states, velocities=velocities, contact=None)


@pytest.mark.parametrize("apart", [0.2, 0.6, 1.2])
def test_a_swerve_closes_the_gap_once_and_ends_where_it_began(apart):
    simulation = oncoming(apart=apart)
    ((rows, swerved),) = swerves(simulation, SIZE, [0, 1], (1.0, 7.0))
    gap = separation(swerved.poses[:, 0], SIZE[0], swerved.poses[:, 1], SIZE[1])
    touching = np.flatnonzero(gap < 0)
    assert rows == (0, 1)
    assert -0.35 < gap.min() < 0
    assert 0.1 < len(touching) * PERIOD < 1.0
    assert (np.diff(touching) == 1).all()
    assert np.array_equal(swerved.states[:, 1], simulation.states[:, 1])
    assert swerved.states[[0, -1], 0] == pytest.approx(simulation.states[[0, -1], 0], abs=0.01)


def test_wheels_do_not_slide_in_a_swerve():
    ((_, swerved),) = swerves(oncoming(apart=1.0), SIZE, [0, 1], (1.0, 7.0))
    yaw, half = swerved.poses[:, 0, 2], WHEELBASE * SIZE[0, 0] / 2
    rear = swerved.poses[:, 0, :2] - half * np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
    moved, middle = np.diff(rear, axis=0) / PERIOD, (yaw[1:] + yaw[:-1]) / 2
    assert np.abs(np.cos(middle) * moved[:, 1] - np.sin(middle) * moved[:, 0]).max() < 0.01
    turning = np.abs(np.diff(yaw)) / PERIOD
    assert (8.0 * turning).max() < 6.0  # m/s² to the side


def test_nobody_swerves_who_is_far_stands_or_passes_outside_of_the_window():
    assert not list(swerves(oncoming(apart=2.5), SIZE, [0, 1], (1.0, 7.0)))
    assert not list(swerves(oncoming(apart=1.0, speeds=(8.0, 0.0)), SIZE, [0, 1], (1.0, 7.0)))
    assert not list(swerves(oncoming(apart=1.0), SIZE, [0, 1], (5.0, 7.0)))
    assert not list(swerves(oncoming(apart=1.0), SIZE, [0], (1.0, 7.0)))


@pytest.mark.slow
def test_scenarios_with_a_graze_have_one_contact_more_and_not_of_the_accident():
    plans = [plan for plan in plan_scenarios(SynthConfig(scenarios=24, frames=None, seed=11)) if plan.grazes]
    touched = 0
    for plan in plans:
        scenario = build_scenario(plan=plan, config=SynthConfig(scenarios=24, frames=None, seed=11))
        actors, pair = scenario.actors, scenario.meta.collision.ids if scenario.meta.collision else ()
        rows = np.flatnonzero(actors.actor_id < 20000)
        poses = np.stack([actors.all[row].motion.poses(np.arange(scenario.frames) / 10) for row in rows])
        size = actors.size[rows, :2]
        gaps = separation(poses[:, None], size[:, None, None], poses, size[:, None]).min(axis=-1)
        contacts = {(actors.actor_id[rows[i]], actors.actor_id[rows[j]]) for i, j in np.argwhere(np.triu(gaps < 0, 1))}
        others = [two for two in contacts if set(two) != set(pair)]
        assert len(others) <= 1
        assert not any(set(two) & set(pair) for two in others)
        touched += len(others)
    assert touched >= len(plans) / 3
