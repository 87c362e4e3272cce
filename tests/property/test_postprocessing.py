"""Laws of reading instances off a model's maps: the devkit's arrays do what the plain rules say, in
any orientation.
"""

import numpy as np
import plain_postprocessing as plain
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.testing import assert_array_equal

from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS, to_orientation
from deepaccident_devkit.motion.grouping import MotionHeads
from deepaccident_devkit.motion.instances import (
    POST_PROCESSING,
    PostProcessing,
    predict_instances,
    trajectories,
)
from deepaccident_devkit.motion.reference_arithmetic.peaks import find_peaks, nearest_peaks

QUARTERS = st.integers(-24, 24).map(lambda quarters: quarters / 4)
"""Cells; a quarter is what leaves sums and squares exact, so that ties are ties."""
HEATS = st.sampled_from([0.0, float(np.float32(0.1)), 0.25, 0.5, 1.0])
"""Centerness; the second is the threshold, which none exceeds."""
SIDES = st.integers(2, 9)


@st.composite
def heads(draw: st.DrawFn) -> MotionHeads:
    """Small predictions with plateaus, ties, empty frames and frames without background."""
    frames, height, width = draw(st.integers(1, 4)), draw(SIDES), draw(SIDES)

    def maps(
        channels: int, values: st.SearchStrategy[float], fill: st.SearchStrategy[float]
    ) -> np.ndarray:
        return draw(
            hnp.arrays(np.float32, (frames, channels, height, width), elements=values, fill=fill)
        )

    return MotionHeads(
        segmentation=maps(
            2, st.sampled_from([-3.0, -0.5, 0.0, 2.0, 10.0]), st.sampled_from([-1.0, 0.0])
        ),
        centerness=maps(1, HEATS, st.sampled_from([0.0, 0.0625])),
        offset=maps(2, QUARTERS, st.just(0.0)),
        flow=maps(2, QUARTERS, st.just(0.0)),
        orientation="released",
    )


RULES = st.builds(
    PostProcessing,
    foreground=st.sampled_from(["argmax", "sigmoid"]),
    max_centers=st.sampled_from([1, 4, 100]),
    link_distance=st.sampled_from([1.0, 3.0, 10.0]),
)


@settings(max_examples=150)
@given(given_heads=heads(), rules=RULES)
def test_instances_are_what_the_plain_rules_say(
    given_heads: MotionHeads, rules: PostProcessing
) -> None:
    found = predict_instances(given_heads, rules)
    raw = plain.frame_instances(given_heads, rules)
    assert_array_equal(found.frame_instance, raw)
    ids = plain.linked(raw, given_heads.flow, rules.link_distance)
    assert_array_equal(found.instance, ids)
    assert {name: centers.tolist() for name, centers in found.centers.items()} == plain.paths(ids)
    for name, path in found.paths.items():
        assert_array_equal(path.cell_counts, (ids == name).sum(axis=(1, 2)))
        assert_array_equal(path.frames, np.flatnonzero(path.cell_counts))


@given(
    given_heads=heads(),
    name=st.sampled_from(sorted(POST_PROCESSING)),
    orientation=st.sampled_from(ORIENTATIONS),
)
def test_the_orientation_makes_no_difference(
    given_heads: MotionHeads, name: str, orientation
) -> None:
    expected = predict_instances(given_heads, name)
    found = predict_instances(given_heads.in_orientation(orientation), name)
    assert found.orientation == orientation
    for field in ("instance", "frame_instance", "redrawn"):
        mine, theirs = getattr(found, field), getattr(expected, field)
        if theirs is not None:
            assert mine.flags.c_contiguous
            assert_array_equal(
                to_orientation(mine, vectors=False, source=orientation, target="released"), theirs
            )
    height, width = given_heads.offset.shape[-2:]
    grid = BevGrid(x=(0.0, float(width), 1.0), y=(-3.0, height - 3.0, 1.0))
    for shifted in (False, True):
        here, there = (
            trajectories(linked, grid, half_cell_shift=shifted) for linked in (found, expected)
        )
        assert here.keys() == there.keys()
        for key, path in here.items():
            np.testing.assert_allclose(path, there[key], atol=1e-9)


@given(given_heads=heads(), orientation=st.sampled_from(ORIENTATIONS))
def test_turning_heads_there_and_back_changes_nothing(
    given_heads: MotionHeads, orientation
) -> None:
    back = given_heads.in_orientation(orientation).in_orientation("released")
    for name in ("segmentation", "centerness", "offset", "flow"):
        assert_array_equal(getattr(back, name), getattr(given_heads, name))


@given(given_heads=heads(), name=st.sampled_from(sorted(POST_PROCESSING)))
def test_ids_of_the_first_frame_keep_their_cells(given_heads: MotionHeads, name: str) -> None:
    found = predict_instances(given_heads, name)
    assert_array_equal(found.instance[0], found.frame_instance[0])
    assert (
        sorted(found.paths)
        == list(found.paths)
        == np.unique(found.instance[0][found.instance[0] > 0]).tolist()
    )
    if found.redrawn is not None:
        assert set(np.unique(found.redrawn).tolist()) <= {0, *found.paths}


@given(
    seed=st.integers(0, 1000), count=st.integers(2, 150), reach=st.sampled_from([3.0, 40.0, 1e4])
)
def test_peaks_left_out_are_never_the_nearest(seed: int, count: int, reach: float) -> None:
    """Many points take the way that leaves out peaks; few, a slice of them, the plain one."""
    source = np.random.default_rng(seed)
    peaks = source.integers(0, 60, (count, 2)).astype(np.float32)
    points = np.rint(source.normal(30, reach, (2, 300_000 // count)) * 4).astype(np.float32) / 4
    nearest = nearest_peaks(points, peaks)
    parts = [nearest_peaks(part, peaks) for part in np.array_split(points, 10, axis=1)]
    assert_array_equal(nearest, np.concatenate(parts))


@given(centerness=hnp.arrays(np.float32, st.tuples(SIDES, SIDES), elements=HEATS))
def test_fewer_centres_are_the_first_ones(centerness: np.ndarray) -> None:
    every = find_peaks(centerness, 0.1, 100)
    assert_array_equal(find_peaks(centerness, 0.1, 3), every[:3])
    assert (np.diff(every @ [centerness.shape[1], 1]) > 0).all()
