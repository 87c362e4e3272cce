"""Predictions of models: motion in maps of any framework, and explicit accidents."""

import pickle
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, EvaluationError, GeometryError
from deepaccident_devkit.evaluation import Accident, MotionOutput
from deepaccident_devkit.evaluation.predictions import (
    cells_within,
    checked_prediction,
    label_config,
    labels_at_present,
)
from deepaccident_devkit.geometry import BevGrid, Boxes
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS
from deepaccident_devkit.motion import MotionLabelConfig

GRID = BevGrid((-4.0, 4.0, 0.5), (-3.0, 3.0, 0.5))
HEAD_NAMES = ("segmentation", "centerness", "offset", "flow")


def make_heads(count: int = 3, shape: tuple[int, int] = GRID.shape) -> list[np.ndarray]:
    """Make random heads of `count` predictions with 5 frames."""
    generator = np.random.default_rng(0)
    heads = []
    for channels in (2, 1, 2, 2):
        values = generator.normal(size=(count, 5, channels, *shape))
        heads.append(values.astype(np.float32))

    return heads


def assert_same(output: MotionOutput, *arrays: np.ndarray, orientation: str = "devkit") -> None:
    """Assert that the output has heads of these arrays, (K, T, channels, H, W)."""
    heads = output.heads or ()
    for index, name in enumerate(HEAD_NAMES):
        values = [getattr(prediction_heads, name) for prediction_heads in heads]
        np.testing.assert_equal(values, list(arrays[index]))
    assert (output.grid, output.orientation) == (GRID.with_orientation(orientation), None)
    assert {prediction_heads.orientation for prediction_heads in heads} == {orientation}


class TestMotionOutput:
    def test_arrays_are_heads_in_several_ways(self) -> None:
        arrays = segmentation, centerness, offset, flow = make_heads()
        output = MotionOutput.from_arrays(*arrays, grid=GRID)
        assert len(output) == 3
        assert np.shares_memory(output.heads[0].flow, flow)
        for same_arrays in (
            arrays,
            (segmentation, centerness[:, :, 0], offset, flow),
            (segmentation.tolist(), centerness, offset.astype(float), flow),
        ):
            assert_same(MotionOutput.from_arrays(*same_arrays, grid=GRID), *arrays)

        heads = output.heads[1]
        heads_arrays = [array[1:2] for array in arrays]
        for single_output in (
            MotionOutput(grid=GRID, heads=heads),  # type: ignore[arg-type]  # a lone one is taken
            MotionOutput(grid=GRID, heads=[heads]),  # type: ignore[arg-type]  # any sequence is
            pickle.loads(pickle.dumps(MotionOutput(grid=GRID, heads=(heads,)))),
            MotionOutput.from_arrays(*(array[1] for array in arrays), grid=GRID),
            MotionOutput.from_arrays(
                segmentation[1], centerness[1, :, 0], offset[1], flow[1], grid=GRID
            ),
        ):
            assert_same(single_output, *heads_arrays)

    def test_the_orientation_is_the_grids_unless_another_is_given(self) -> None:
        arrays = make_heads(shape=GRID.shape[::-1])
        output = MotionOutput.from_arrays(*arrays, grid=GRID, orientation="fiery")
        assert_same(output, *arrays, orientation="fiery")

        output = MotionOutput(grid=GRID, heads=output.heads, orientation="fiery")
        assert_same(output, *arrays, orientation="fiery")

        maps = np.zeros((1, 5, *GRID.shape[::-1]), dtype=np.int32)
        maps_output = MotionOutput(grid=GRID, instances=maps, orientation="fiery")
        assert maps_output.grid.orientation == "fiery"

        assert_raises(
            (
                lambda: MotionOutput(grid=GRID, heads=output.heads),
                GeometryError,
                ("orientation devkit", "in fiery"),
            ),
            (
                partial(MotionOutput, grid=GRID, instances=maps, orientation="north"),
                ChoiceError,
                ("orientation: expected one of", "north"),
            ),
        )

    @pytest.mark.parametrize(
        "heads",
        [
            make_heads()[0],
            make_heads(),
            dict(zip(HEAD_NAMES, make_heads(), strict=True)),
            3,
            [None],
        ],
    )
    def test_arrays_instead_of_heads_are_refused(self, heads: Any) -> None:
        message = ("heads: expected MotionHeads, found", "MotionOutput.from_arrays(")
        assert_raises((lambda: MotionOutput(grid=GRID, heads=heads), GeometryError, message))

    def test_boxes_instead_of_accidents_are_refused_even_if_empty(self) -> None:
        boxes = Boxes.from_arrays(np.zeros((0, 3)), np.zeros((0, 3)), [])
        message = ("a MotionOutput or a list of Accidents", "Boxes", "instances_of")

        assert_raises(
            (lambda: checked_prediction(boxes), EvaluationError, message),
            (lambda: checked_prediction([boxes]), EvaluationError, message),
        )

    def test_arrays_that_are_no_output_are_refused(self) -> None:
        segmentation, centerness, offset, flow = make_heads()
        from_arrays = partial(MotionOutput.from_arrays, grid=GRID)
        output = partial(MotionOutput, grid=GRID)
        coarse_grid = BevGrid((-4.0, 4.0, 1.0), (-3.0, 3.0, 1.0))
        coarse = MotionOutput.from_arrays(*make_heads(1, (6, 8)), grid=coarse_grid)
        no_maps = np.zeros((0, 5, *GRID.shape), dtype=int)

        assert_raises(
            (
                partial(from_arrays, segmentation, centerness, offset[:2], flow),
                GeometryError,
                ("offset", "(K, T, channels, H, W)", "(2, 5"),
            ),
            (
                partial(from_arrays, segmentation[0, 0], centerness, offset, flow),
                GeometryError,
                ("segmentation", "(K, T, channels, H, W)"),
            ),
            (
                partial(from_arrays, segmentation, centerness, offset, flow[:, :4]),
                GeometryError,
                ("flow", "expected shape"),
            ),
            (
                partial(from_arrays, *make_heads(count=0)),
                GeometryError,
                ("at least one prediction",),
            ),
            (output, GeometryError, ("give either heads or instances",)),
            (
                partial(output, heads=coarse.heads),
                GeometryError,
                ("(12, 16) cells in orientation devkit", "(6, 8) in devkit"),
            ),
            (partial(output, heads=()), GeometryError, ("at least one prediction",)),
            (partial(output, instances=no_maps), GeometryError, ("at least one prediction",)),
            (
                partial(MotionOutput.from_arrays, *make_heads(), grid=None),
                GeometryError,
                ("grid", "BevGrid", "NoneType"),
            ),
        )


class TestAccident:
    def test_accidents_have_defaults(self) -> None:
        accident = Accident(positions=np.zeros((2, 2)), time=0.0)
        assert (accident.time, accident.score, accident.ids) == (0.0, 1.0, None)

    def test_numbers_of_numpy_become_pythons(self) -> None:
        accident = Accident(
            positions=[[0, 1], [2, 3]],  # type: ignore[arg-type]  # lists are taken
            time=np.float32(0.5),  # type: ignore[arg-type]
            score=np.array(1),  # type: ignore[arg-type]
            ids=np.array([4, -100]),  # type: ignore[arg-type]
        )
        assert repr((accident.time, accident.score, accident.ids)) == "(0.5, 1.0, (4, -100))"

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"time": -0.1}, "expected seconds after the present, found -0.1"),
            ({"time": None}, "accident time: expected seconds after the present, found None"),
            ({"score": float("nan")}, "must be finite"),
            ({"score": "high"}, "accident score: expected a number"),
            ({"ids": (1, 2.5)}, "accident ids: expected two whole numbers"),
            ({"ids": (1, 2, 3)}, "accident ids: expected two actor ids"),
            ({"ids": 7}, "accident ids: expected two actor ids"),
            ({"ids": "ab"}, "accident ids: expected two actor ids"),
            ({"positions": np.full((2, 2), np.nan)}, "not all numbers are finite"),
            ({"positions": np.zeros(2)}, "accident positions: expected shape"),
            ({"time": float("inf")}, "accident: time inf and score 1.0 must be finite"),
        ],
    )
    def test_values_that_are_no_accident_are_refused(
        self, changes: dict[str, Any], message: str
    ) -> None:
        fields = {"positions": np.zeros((2, 2)), "time": 1.0} | changes
        assert_raises((lambda: Accident(**fields), GeometryError, message))


@pytest.mark.parametrize("orientation", ORIENTATIONS)
@pytest.mark.parametrize("extent", [30.0, 30.5, 41.0, 1.0, 300.0])
def test_cells_within_a_range_are_judged_by_their_centres(orientation, extent: float) -> None:
    """A centre on the edge is inside on one side only."""
    for grid in (
        BevGrid((-20.0, 60.0, 0.5), (-30.0, 10.0, 0.25), orientation),
        BevGrid((20.0, 60.0, 0.5), (-30.0, 10.0, 0.25), orientation),
    ):
        centers = grid.centers()
        expected = (centers >= -extent / 2) & (centers < extent / 2)
        is_within = np.zeros(grid.shape, dtype=bool)
        is_within[cells_within(grid, extent)] = True
        np.testing.assert_array_equal(is_within, expected.all(axis=-1))


def test_labels_are_compared_at_the_present_with_bilinear_centres(da_motion: DeepAccident) -> None:
    label = da_motion.motion_labels(f"{da_motion.scenario[0]['token']}/ego_vehicle/010")
    at_present = label.to_present(centerness="bilinear")

    assert (labels_at_present(label).centerness == at_present.centerness).all()
    assert labels_at_present(at_present) is at_present


@pytest.mark.parametrize(
    ("rules", "form", "horizon", "expected"),
    [
        ({"labels": "released"}, None, 2.0, ("released", 5, 4)),
        ({"labels": None}, None, 3.0, ("released", 5, 6)),
        ({}, None, 2.0, None),  # explicit accidents by rules without labels
        ({}, {"step": 0.2, "labels": None}, 1.0, ("clean", 2, 5)),
        ({}, {"step": 0.5, "labels": "released"}, 2.0, ("released", 5, 4)),
        ({"labels": "clean"}, {"step": 0.5, "labels": "released"}, 2.0, ("clean", 5, 4)),
    ],
)
def test_labels_are_chosen_by_the_rules_or_otherwise_by_the_form(
    rules, form, horizon, expected
) -> None:
    motion_form = None if form is None else SimpleNamespace(grid=GRID, **form)
    config = label_config(SimpleNamespace(**rules), motion_form, horizon)
    if expected is None:
        assert config is None
    else:
        protocol, step, future_frames = expected
        grid = BevGrid() if form is None else GRID
        assert config == MotionLabelConfig(
            grid=grid, protocol=protocol, step=step, future_frames=future_frames
        )
