import numpy as np

from deepaccident_devkit.plugins.synth.actors import SampledMotion

SAMPLES = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.2], [3.0, 1.0, 0.4]])
VELOCITIES = np.array([[5.0, 0.0], [10.0, 2.0], [12.0, 4.0]])


MOTION = SampledMotion(
    start=-0.1,
    period=0.1,
    samples=SAMPLES,
    sample_velocities=VELOCITIES,
)


def test_samples_are_exact_and_straight_between_and_stand_before_and_after():
    sample_times, outer_times = [-0.1, 0.0, 0.1], [-9.0, 9.0]
    np.testing.assert_allclose(MOTION.poses(sample_times), SAMPLES, atol=1e-12)

    np.testing.assert_allclose(MOTION.poses([0.05]), [[2.0, 0.5, 0.3]])
    np.testing.assert_allclose(
        MOTION.velocities([-0.1, 0.05, 0.1]),
        [[5, 0], [11, 3], [12, 4]],
    )

    np.testing.assert_allclose(MOTION.poses(outer_times), SAMPLES[[0, -1]])
    np.testing.assert_array_equal(MOTION.velocities(outer_times), 0.0)
