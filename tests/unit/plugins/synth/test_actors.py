import numpy as np

from deepaccident_devkit.plugins.synth.actors import Actor, Actors, SampledMotion
from deepaccident_devkit.plugins.synth.shapes import shape_of

SAMPLES = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.2], [3.0, 1.0, 0.4]])
VELOCITIES = np.array([[5.0, 0.0], [10.0, 2.0], [12.0, 4.0]])


MOTION = SampledMotion(start=-0.1, period=0.1, samples=SAMPLES, sample_velocities=VELOCITIES)


def test_samples_are_exact_and_straight_between():
    np.testing.assert_allclose(MOTION.poses([-0.1, 0.0, 0.1]), SAMPLES, atol=1e-12)
    np.testing.assert_allclose(MOTION.poses([0.05]), [[2.0, 0.5, 0.3]])
    np.testing.assert_allclose(MOTION.velocities([-0.1, 0.05, 0.1]), [[5, 0], [11, 3], [12, 4]])


def test_before_and_after_it_stands():
    np.testing.assert_allclose(MOTION.poses([-9.0, 9.0]), SAMPLES[[0, -1]])
    np.testing.assert_array_equal(MOTION.velocities([-9.0, 9.0]), 0.0)


def test_actors_are_where_each_of_them_is():
    """Those sampled at the same times are looked up together."""
    later = SampledMotion(start=0.0, period=0.1, samples=SAMPLES + 9, sample_velocities=VELOCITIES)
    other = SampledMotion(start=-0.1, period=0.1, samples=SAMPLES - 5, sample_velocities=-VELOCITIES)
    parked = SampledMotion(start=0.0, period=0.1, samples=SAMPLES[:1] + 3, sample_velocities=np.zeros((1, 2)))
    size = (4.6, 1.9, 1.5)
    car = {"category": "car", "size": size, "shape": shape_of("car", size, (200, 30, 30), (30, 60, 200))}
    motions = enumerate((MOTION, later, parked, other))
    actors = Actors.of([Actor(actor_id=1000 + k, object_id=k + 1, motion=each, **car) for k, each in motions])
    assert len(actors.motions) == 3
    for time in (-1.0, 0.03, 0.1, 2.0):
        snapshot, alone = actors.at(time), [actor.motion for actor in actors.all]
        np.testing.assert_array_equal(snapshot.poses, [each.poses([time])[0] for each in alone])
        np.testing.assert_array_equal(snapshot.velocities, [each.velocities([time])[0] for each in alone])
