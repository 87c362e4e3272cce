"""The twelve designs as they are played; docs/synth.md has the numbers over more seeds."""

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
def played(design, seed):
    """A stage, and its accident; None if the two do not touch."""
    rng = np.random.default_rng([seed, design])
    spec = draw(read_design(design), rng)
    stage = set_stage(rng, spec, Junction(spec.road), float(rng.uniform(5.5, 9.5)))
    tried = try_accident(stage)
    return stage, tried if isinstance(tried, Performance) else None


def sizes(stage, performance):
    return np.array([stage.users[row].body.size[:2] for row in performance.present])


@pytest.mark.parametrize("design", DESIGN_NUMBERS)
def test_the_pair_alone_meets_at_the_design_s_angle_and_only_at_the_end(design):
    met = [
        (stage, accident)
        for stage, accident in (played(design, seed) for seed in SEEDS)
        if accident
    ]
    low, high = ANGLES[design]
    assert len(met) >= 3
    for stage, accident in met:
        poses, size = accident.simulation.poses, sizes(stage, accident)
        one, other = poses[-1, list(stage.cast.pair), 2]
        assert low < abs(np.degrees(np.angle(np.exp(1j * (one - other))))) < high
        assert touching_pairs(poses, size, 0.0) == [tuple(sorted(stage.cast.pair))]
        assert touching_pairs(poses[:-1], size, 0.0) == []


def test_the_background_is_moved_by_the_same_numbers_in_both():
    stage, accident = played(3, 0)
    twin = perform_twin(stage, stage.cast.begin + WARM_UP + 10.0)
    common = set(accident.present) & set(twin.present)
    assert len(common) > 10
    for row in common - set(range(len(stage.cast.users))):
        columns = accident.present.index(row), twin.present.index(row)
        np.testing.assert_array_equal(
            accident.simulation.poses[0, columns[0]], twin.simulation.poses[0, columns[1]]
        )
