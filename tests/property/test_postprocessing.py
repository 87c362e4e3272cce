"""Laws of reading instances from a model's maps: plain rules and orientations give the same."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.testing import assert_array_equal
from support import plain_postprocessing as plain

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
    num_frames, height, width = draw(st.integers(1, 4)), draw(SIDES), draw(SIDES)

    def maps(
        channels: int, values: st.SearchStrategy[float], fill: st.SearchStrategy[float]
    ) -> np.ndarray:
        shape = (num_frames, channels, height, width)
        return draw(hnp.arrays(np.float32, shape, elements=values, fill=fill))

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
    prediction = predict_instances(given_heads, rules)
    frame_ids = plain.frame_instances(given_heads, rules)
    assert_array_equal(prediction.frame_instance, frame_ids)
    ids = plain.link_instances(frame_ids, given_heads.flow, rules.link_distance)
    assert_array_equal(prediction.instance, ids)
    centers = {name: path.tolist() for name, path in prediction.centers.items()}
    assert centers == plain.centroid_paths(ids)
    for name, path in prediction.paths.items():
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
    turned = predict_instances(given_heads.in_orientation(orientation), name)
    assert turned.orientation == orientation
    for field in ("instance", "frame_instance", "redrawn"):
        ids, expected_ids = getattr(turned, field), getattr(expected, field)
        if expected_ids is not None:
            assert ids.flags.c_contiguous
            ids = to_orientation(ids, vectors=False, source=orientation, target="released")
            assert_array_equal(ids, expected_ids)

    height, width = given_heads.offset.shape[-2:]
    grid = BevGrid(x=(0.0, float(width), 1.0), y=(-3.0, height - 3.0, 1.0))
    for is_shifted in (False, True):
        paths = trajectories(turned, grid, half_cell_shift=is_shifted)
        expected_paths = trajectories(expected, grid, half_cell_shift=is_shifted)
        assert paths.keys() == expected_paths.keys()
        for key, path in paths.items():
            np.testing.assert_allclose(path, expected_paths[key], atol=1e-9)


@given(given_heads=heads(), orientation=st.sampled_from(ORIENTATIONS))
def test_turning_heads_there_and_back_changes_nothing(
    given_heads: MotionHeads, orientation
) -> None:
    turned_back = given_heads.in_orientation(orientation).in_orientation("released")
    for name in ("segmentation", "centerness", "offset", "flow"):
        assert_array_equal(getattr(turned_back, name), getattr(given_heads, name))


@given(given_heads=heads(), name=st.sampled_from(sorted(POST_PROCESSING)))
def test_ids_of_the_first_frame_keep_their_cells(given_heads: MotionHeads, name: str) -> None:
    prediction = predict_instances(given_heads, name)
    first_frame = prediction.instance[0]
    assert_array_equal(first_frame, prediction.frame_instance[0])
    first_ids = np.unique(first_frame[first_frame > 0]).tolist()  # in ascending order
    assert list(prediction.paths) == first_ids
    if prediction.redrawn is not None:
        assert set(np.unique(prediction.redrawn).tolist()) <= {0, *prediction.paths}


@given(
    seed=st.integers(0, 1000), count=st.integers(2, 150), reach=st.sampled_from([3.0, 40.0, 1e4])
)
def test_peaks_left_out_are_never_the_nearest(seed: int, count: int, reach: float) -> None:
    """Many points use the method that leaves out peaks; a slice of them uses the plain one."""
    random = np.random.default_rng(seed)
    peaks = random.integers(0, 60, (count, 2)).astype(np.float32)
    points = np.rint(random.normal(30, reach, (2, 300_000 // count)) * 4).astype(np.float32) / 4
    nearest = nearest_peaks(points, peaks)
    parts = [nearest_peaks(part, peaks) for part in np.array_split(points, 10, axis=1)]
    assert_array_equal(nearest, np.concatenate(parts))


@given(centerness=hnp.arrays(np.float32, st.tuples(SIDES, SIDES), elements=HEATS))
def test_fewer_centres_are_the_first_ones(centerness: np.ndarray) -> None:
    peaks = find_peaks(centerness, 0.1, 100)
    assert_array_equal(find_peaks(centerness, 0.1, 3), peaks[:3])
    cell_numbers = peaks @ [centerness.shape[1], 1]
    assert (np.diff(cell_numbers) > 0).all()
