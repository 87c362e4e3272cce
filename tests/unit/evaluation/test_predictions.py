"""What models say: motion in maps of any framework, and explicit accidents."""

import pickle
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from refusals import assert_refused

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
NAMES = ("segmentation", "centerness", "offset", "flow")


def stacked(count: int = 3, shape: tuple[int, int] = GRID.shape) -> list[np.ndarray]:
    """Heads of so many predictions of 5 frames, no two values alike."""
    source = np.random.default_rng(0)
    return [
        source.normal(size=(count, 5, channels, *shape)).astype(np.float32)
        for channels in (2, 1, 2, 2)
    ]


def assert_same(output: MotionOutput, *arrays: np.ndarray, orientation: str = "devkit") -> None:
    """Heads of these maps, one a prediction."""
    found = [{name: getattr(each, name) for name in NAMES} for each in output.heads or ()]
    np.testing.assert_equal(
        found, [dict(zip(NAMES, each, strict=True)) for each in zip(*arrays, strict=True)]
    )
    assert (output.grid, output.orientation) == (GRID.with_orientation(orientation), None)
    assert {each.orientation for each in output.heads or ()} == {orientation}


class TestMotionOutput:
    def test_arrays_are_heads_in_several_ways(self) -> None:
        arrays = segmentation, centerness, offset, flow = stacked()
        output = MotionOutput.from_arrays(*arrays, grid=GRID)
        assert (len(output), np.shares_memory(output.heads[0].flow, flow)) == (3, True)
        for given in (
            arrays,
            (segmentation, centerness[:, :, 0], offset, flow),
            (segmentation.tolist(), centerness, offset.astype(float), flow),
        ):
            assert_same(MotionOutput.from_arrays(*given, grid=GRID), *arrays)
        one, of_one = output.heads[1], [each[1:2] for each in arrays]
        for some in (
            MotionOutput(grid=GRID, heads=one),  # type: ignore[arg-type]  # a lone one is taken
            MotionOutput(grid=GRID, heads=[one]),  # type: ignore[arg-type]  # any sequence is
            pickle.loads(pickle.dumps(MotionOutput(grid=GRID, heads=(one,)))),
            MotionOutput.from_arrays(*(each[1] for each in arrays), grid=GRID),
            MotionOutput.from_arrays(
                segmentation[1], centerness[1, :, 0], offset[1], flow[1], grid=GRID
            ),
        ):
            assert_same(some, *of_one)

    def test_the_orientation_is_the_grids_unless_it_is_given(self) -> None:
        arrays, maps = (
            stacked(shape=GRID.shape[::-1]),
            np.zeros((1, 5, *GRID.shape[::-1]), dtype=np.int32),
        )
        output = MotionOutput.from_arrays(*arrays, grid=GRID, orientation="fiery")
        for some in (output, MotionOutput(grid=GRID, heads=output.heads, orientation="fiery")):
            assert_same(some, *arrays, orientation="fiery")
        assert (
            MotionOutput(grid=GRID, instances=maps, orientation="fiery").grid.orientation == "fiery"
        )
        north = partial(MotionOutput, grid=GRID, instances=maps, orientation="north")
        assert_refused(
            (
                lambda: MotionOutput(grid=GRID, heads=output.heads),
                GeometryError,
                ("orientation devkit", "in fiery"),
            ),
            (north, ChoiceError, ("orientation: expected one of", "north")),
        )

    @pytest.mark.parametrize(
        "heads", [stacked()[0], stacked(), dict(zip(NAMES, stacked(), strict=True)), 3, [None]]
    )
    def test_arrays_are_no_heads(self, heads: Any) -> None:
        words = ("heads: expected MotionHeads, found", "MotionOutput.from_arrays(")
        assert_refused((lambda: MotionOutput(grid=GRID, heads=heads), GeometryError, words))

    def test_boxes_are_no_prediction_and_none_of_them_no_quiet_one(self) -> None:
        none = Boxes.from_arrays(np.zeros((0, 3)), np.zeros((0, 3)), [])
        words = ("a MotionOutput or a list of Accidents", "Boxes", "instances_of")
        assert_refused(
            *(
                (lambda given=given: checked_prediction(given), EvaluationError, words)
                for given in (none, [none])
            )
        )

    def test_what_is_no_output(self) -> None:
        segmentation, centerness, offset, flow = stacked()
        coarse = MotionOutput.from_arrays(
            *stacked(1, (6, 8)), grid=BevGrid((-4.0, 4.0, 1.0), (-3.0, 3.0, 1.0))
        )
        none = np.zeros((0, 5, *GRID.shape), dtype=int)
        assert_refused(
            *(
                (partial(MotionOutput.from_arrays, *arrays, grid=GRID), GeometryError, words)
                for arrays, words in (
                    (
                        (segmentation, centerness, offset[:2], flow),
                        ("offset", "(K, T, channels, H, W)", "(2, 5"),
                    ),
                    (
                        (segmentation[0, 0], centerness, offset, flow),
                        ("segmentation", "(K, T, channels, H, W)"),
                    ),
                    ((segmentation, centerness, offset, flow[:, :4]), ("flow", "expected shape")),
                    ([each[:0] for each in stacked()], ("at least one prediction",)),
                )
            ),
            *(
                (partial(MotionOutput, grid=GRID, **given), GeometryError, words)
                for given, words in (
                    ({}, ("heads, or instances", "not both")),
                    (
                        {"heads": coarse.heads},
                        ("(12, 16) cells in orientation devkit", "(6, 8) in devkit"),
                    ),
                    ({"heads": ()}, ("at least one prediction",)),
                    ({"instances": none}, ("at least one prediction",)),
                )
            ),
            (
                partial(MotionOutput.from_arrays, *stacked(), grid=None),
                GeometryError,
                ("grid", "BevGrid", "NoneType"),
            ),
        )


class TestAccident:
    def test_what_is_not_given(self) -> None:
        now = Accident(positions=np.zeros((2, 2)), time=0.0)
        assert (now.time, now.score, now.ids) == (0.0, 1.0, None)

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
    def test_what_is_no_accident(self, changes: dict[str, Any], message: str) -> None:
        given = {"positions": np.zeros((2, 2)), "time": 1.0} | changes
        assert_refused((lambda: Accident(**given), GeometryError, message))


@pytest.mark.parametrize("orientation", ORIENTATIONS)
@pytest.mark.parametrize("extent", [30.0, 30.5, 41.0, 1.0, 300.0])
def test_the_cells_of_a_range(orientation, extent: float) -> None:
    """A centre on the edge is in on one side."""
    for grid in (
        BevGrid((-20.0, 60.0, 0.5), (-30.0, 10.0, 0.25), orientation),
        BevGrid((20.0, 60.0, 0.5), (-30.0, 10.0, 0.25), orientation),
    ):
        inside = (grid.centers() >= -extent / 2) & (grid.centers() < extent / 2)
        found = np.zeros(grid.shape, dtype=bool)
        found[cells_within(grid, extent)] = True
        np.testing.assert_array_equal(found, inside.all(axis=-1))


def test_labels_are_compared_at_the_present_with_bilinear_centres(da_motion: DeepAccident) -> None:
    label = da_motion.motion_labels(f"{da_motion.scenario[0]['token']}/ego_vehicle/010")
    moved = label.to_present(centerness="bilinear")
    assert (labels_at_present(label).centerness == moved.centerness).all()
    assert labels_at_present(moved) is moved


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
def test_which_labels_predictions_are_compared_with(rules, form, horizon, expected) -> None:
    """By the rules' label protocol, or else by the form's."""
    given = form and SimpleNamespace(grid=GRID, **form)
    names, grid = ("protocol", "step", "future_frames"), BevGrid() if form is None else GRID
    made = expected and MotionLabelConfig(grid=grid, **dict(zip(names, expected, strict=True)))
    assert label_config(SimpleNamespace(**rules), given, horizon) == made
