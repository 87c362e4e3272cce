import numpy as np
import pytest

from deepaccident_devkit.synth.actors import Actor, Actors, Motion
from deepaccident_devkit.synth.shapes import shape_of

SAMPLES = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.2], [3.0, 1.0, 0.4]])
VELOCITIES = np.array([[5.0, 0.0], [10.0, 2.0], [12.0, 4.0]])


@pytest.fixture
def motion():
    return Motion(start=-0.1, period=0.1, samples=SAMPLES, sample_velocities=VELOCITIES)


@pytest.fixture
def make_actor():
    def make(number, motion):
        size = (4.6, 1.9, 1.5)
        shape = shape_of("car", size, (200, 30, 30), (30, 60, 200))
        return Actor(
            actor_id=1000 + number, object_id=number + 1, category="car", size=size, shape=shape, motion=motion
        )

    return make


def test_samples_are_exact_and_straight_between(motion):
    np.testing.assert_allclose(motion.poses([-0.1, 0.0, 0.1]), SAMPLES, atol=1e-12)
    np.testing.assert_allclose(motion.poses([0.05]), [[2.0, 0.5, 0.3]])
    np.testing.assert_allclose(motion.velocities([-0.1, 0.05, 0.1]), [[5, 0], [11, 3], [12, 4]])


def test_before_and_after_it_stands(motion):
    np.testing.assert_allclose(motion.poses([-9.0, 9.0]), SAMPLES[[0, -1]])
    np.testing.assert_array_equal(motion.velocities([-9.0, 9.0]), 0.0)


def test_actors_are_where_each_of_them_is(motion, make_actor):
    """Those sampled at the same times are looked up together."""
    later = Motion(start=0.0, period=0.1, samples=SAMPLES + 9, sample_velocities=VELOCITIES)
    other = Motion(start=-0.1, period=0.1, samples=SAMPLES - 5, sample_velocities=-VELOCITIES)
    parked = Motion(start=0.0, period=0.1, samples=SAMPLES[:1] + 3, sample_velocities=np.zeros((1, 2)))
    actors = Actors.of([make_actor(k, each) for k, each in enumerate((motion, later, parked, other))])
    assert len(actors.motions) == 3
    for time in (-1.0, 0.03, 0.1, 2.0):
        snapshot = actors.at(time)
        for row, actor in enumerate(actors.all):
            np.testing.assert_array_equal(snapshot.poses[row], actor.motion.poses([time])[0])
            np.testing.assert_array_equal(snapshot.velocities[row], actor.motion.velocities([time])[0])
