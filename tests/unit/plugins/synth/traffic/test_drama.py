"""Simulations of the twelve designs; benchmarks/pages/synth.json has numbers of more seeds."""

from functools import lru_cache

import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.roads import Junction
from deepaccident_devkit.plugins.synth.spec import DESIGN_NUMBERS, draw, read_design
from deepaccident_devkit.plugins.synth.traffic.accidents import (
    Performance,
    perform_twin,
    set_stage,
    touching_pairs,
    try_accident,
)
from deepaccident_devkit.plugins.synth.traffic.placement import WARM_UP

pytestmark = pytest.mark.slow

SEEDS = range(4)
ANGLES = {
    1: (80, 100), 2: (25, 130), 3: (95, 165), 4: (55, 110), 5: (55, 110), 6: (20, 70),
    7: (80, 100), 8: (25, 130), 9: (95, 165), 10: (55, 110), 11: (55, 110), 12: (20, 70),
}  # fmt: skip
"""Degrees between the headings of the two when they touch, by design."""


@lru_cache(maxsize=64)
def play_design(design, seed):
    """Return a stage, and its accident or None if the two do not touch."""
    rng = np.random.default_rng([seed, design])
    spec = draw(read_design(design), rng)
    stage = set_stage(rng, spec, Junction(spec.road), float(rng.uniform(5.5, 9.5)))
    accident = try_accident(stage)

    return stage, accident if isinstance(accident, Performance) else None


@pytest.mark.parametrize("design", DESIGN_NUMBERS)
def test_only_the_pair_meets_at_the_design_s_angle_and_only_at_the_end(design):
    low, high = ANGLES[design]
    accidents = 0
    for seed in SEEDS:
        stage, accident = play_design(design, seed)
        if accident is None:
            continue
        accidents += 1
        first, second = stage.cast.pair
        poses = accident.simulation.poses
        turn = poses[-1, first, 2] - poses[-1, second, 2]
        assert low < abs(np.degrees(np.angle(np.exp(1j * turn)))) < high

        users = [stage.users[row] for row in accident.present]
        sizes = np.array([user.body.size[:2] for user in users])
        assert touching_pairs(poses, sizes, 0.0) == [tuple(sorted(stage.cast.pair))]
        assert touching_pairs(poses[:-1], sizes, 0.0) == []
    assert accidents >= 3


def test_the_background_is_moved_by_the_same_numbers_in_both():
    stage, accident = play_design(3, 0)
    twin = perform_twin(stage, stage.cast.begin + WARM_UP + 10.0)
    common = set(accident.present) & set(twin.present)
    assert len(common) > 10

    for row in common - set(range(len(stage.cast.users))):
        np.testing.assert_array_equal(
            accident.simulation.poses[0, accident.present.index(row)],
            twin.simulation.poses[0, twin.present.index(row)],
        )
