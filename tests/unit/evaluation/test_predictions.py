"""What models say: motion in maps of any framework, and explicit accidents."""

import pickle
from typing import Any

import numpy as np
import pytest
from refusals import assert_refused

from deepaccident_devkit.errors import ChoiceError, EvaluationError, GeometryError
from deepaccident_devkit.evaluation import Accident, MotionOutput, instances_of
from deepaccident_devkit.evaluation.predictions import checked_prediction
from deepaccident_devkit.geometry import BevGrid, Boxes
from deepaccident_devkit.motion import MotionHeads

GRID = BevGrid((-4.0, 4.0, 0.5), (-3.0, 3.0, 0.5))
NAMES = ("segmentation", "centerness", "offset", "flow")


def stacked(count: int = 3, shape: tuple[int, int] = GRID.shape) -> list[np.ndarray]:
    """Heads of so many predictions of 5 frames, no two values alike."""
    source = np.random.default_rng(0)
    return [source.normal(size=(count, 5, channels, *shape)).astype(np.float32) for channels in (2, 1, 2, 2)]


class TestMotionOutput:
    def test_stacked_arrays_are_heads(self) -> None:
        arrays = stacked()
        output = MotionOutput.from_arrays(*arrays, grid=GRID)
        assert len(output) == 3
        assert output.heads is not None
        for index, heads in enumerate(output.heads):
            for name, values in zip(NAMES, arrays, strict=True):
                np.testing.assert_array_equal(getattr(heads, name), values[index])
        assert np.shares_memory(output.heads[0].flow, arrays[3])

    def test_other_ways_to_give_the_same(self) -> None:
        segmentation, centerness, offset, flow = stacked()
        expected = MotionOutput.from_arrays(segmentation, centerness, offset, flow, grid=GRID)
        assert expected.heads is not None
        for some in (
            MotionOutput.from_arrays(segmentation, centerness[:, :, 0], offset, flow, grid=GRID),
            MotionOutput.from_arrays(segmentation.tolist(), centerness, offset.astype(float), flow, grid=GRID),
        ):
            assert same(some, expected)
        one = MotionOutput(grid=GRID, heads=expected.heads[1])  # type: ignore[arg-type]  # a lone one is taken
        for some in (
            MotionOutput.from_arrays(segmentation[1], centerness[1], offset[1], flow[1], grid=GRID),
            MotionOutput.from_arrays(segmentation[1], centerness[1, :, 0], offset[1], flow[1], grid=GRID),
            MotionOutput(grid=GRID, heads=[expected.heads[1]]),  # type: ignore[arg-type]  # any sequence is
            pickle.loads(pickle.dumps(one)),
        ):
            assert same(some, one)

    def test_the_orientation_is_the_grids_unless_it_is_given(self) -> None:
        arrays = stacked(shape=GRID.shape[::-1])
        output = MotionOutput.from_arrays(*arrays, grid=GRID, orientation="fiery")
        assert output.grid == GRID.with_orientation("fiery")
        assert output.orientation is None
        assert output.heads is not None
        assert {heads.orientation for heads in output.heads} == {"fiery"}
        assert same(MotionOutput(grid=GRID, heads=output.heads, orientation="fiery"), output)
        maps = np.zeros((1, 5, *GRID.shape[::-1]), dtype=np.int32)
        assert MotionOutput(grid=GRID, instances=maps, orientation="fiery").grid.orientation == "fiery"
        assert_refused(
            (lambda: MotionOutput(grid=GRID, heads=output.heads), GeometryError, "orientation devkit"),
            (
                lambda: MotionOutput(grid=GRID, instances=maps, orientation="north"),
                ChoiceError,
                "orientation: expected one of",
            ),
        )

    @pytest.mark.parametrize("heads", [stacked()[0], stacked(), dict(zip(NAMES, stacked(), strict=True)), 3, [None]])
    def test_arrays_are_no_heads(self, heads: Any) -> None:
        with pytest.raises(GeometryError, match=r"heads: expected MotionHeads, found .*MotionOutput\.from_arrays\("):
            MotionOutput(grid=GRID, heads=heads)

    def test_boxes_are_no_prediction_and_none_of_them_no_quiet_one(self) -> None:
        none = Boxes.from_arrays(np.zeros((0, 3)), np.zeros((0, 3)), [])
        for given in (none, [none]):
            with pytest.raises(EvaluationError, match=r"expected a MotionOutput or a list of Accidents, found .*Boxes"):
                checked_prediction(given)

    def test_what_is_no_output(self) -> None:
        segmentation, centerness, offset, flow = stacked()
        for words, refused in (
            (
                r"offset: expected \(K, T, channels, H, W\).* offset \(2, 5",
                lambda: MotionOutput.from_arrays(segmentation, centerness, offset[:2], flow, grid=GRID),
            ),
            (
                r"segmentation: expected \(K, T, channels, H, W\)",
                lambda: MotionOutput.from_arrays(segmentation[0, 0], centerness, offset, flow, grid=GRID),
            ),
            (
                "flow: expected shape",
                lambda: MotionOutput.from_arrays(segmentation, centerness, offset, flow[:, :4], grid=GRID),
            ),
            (
                "at least one prediction",
                lambda: MotionOutput.from_arrays(segmentation[:0], centerness[:0], offset[:0], flow[:0], grid=GRID),
            ),
            (
                r"grid: expected a BevGrid, .*found NoneType",
                lambda: MotionOutput.from_arrays(segmentation, centerness, offset, flow, grid=None),  # type: ignore[arg-type]
            ),
            ("and not both", lambda: MotionOutput(grid=GRID)),
            (
                r"heads: expected maps of \(12, 16\) cells in orientation devkit, found \(6, 8\) in devkit",
                lambda: MotionOutput(
                    grid=GRID,
                    heads=MotionOutput.from_arrays(
                        *stacked(1, (6, 8)), grid=BevGrid((-4.0, 4.0, 1.0), (-3.0, 3.0, 1.0))
                    ).heads,
                ),
            ),
            ("at least one prediction", lambda: instances_of(np.zeros((0, 5, *GRID.shape), dtype=int), GRID)),
        ):
            with pytest.raises(GeometryError, match=words):
                refused()

    def test_its_text_says_how_many_predictions_of_which_form(self) -> None:
        three, one = MotionOutput.from_arrays(*stacked(), grid=GRID), instances_of(np.zeros((4, *GRID.shape)), GRID)
        assert repr(three) == f"MotionOutput(3 predictions of 5 frames, {GRID.text}, heads)"
        assert repr(one) == f"MotionOutput(1 prediction of 4 frames, {GRID.text}, instances)"


class TestAccident:
    def test_what_is_not_given(self) -> None:
        now = Accident(positions=np.zeros((2, 2)), time=0.0)
        assert (now.time, now.score, now.ids) == (0.0, 1.0, None)

    def test_its_positions_and_the_maps_of_an_output_are_read_only(self) -> None:
        positions, maps = np.zeros((2, 2)), np.zeros((1, 5, *GRID.shape), dtype=np.int32)
        accident, output = Accident(positions=positions, time=1.0), instances_of(maps, GRID)
        for array in (accident.positions, output.instances):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 1
        positions[0] = maps[0] = 1  # the caller's own stay as they were

    def test_numbers_of_numpy_become_pythons(self) -> None:
        accident = Accident(
            positions=[[0, 1], [2, 3]],  # type: ignore[arg-type]  # lists are taken
            time=np.float32(0.5),  # type: ignore[arg-type]
            score=np.array(1),  # type: ignore[arg-type]
            ids=np.array([4, -100]),  # type: ignore[arg-type]
        )
        assert (accident.time, accident.score, accident.ids) == (0.5, 1.0, (4, -100))
        assert [type(each) for each in (accident.time, accident.score, *(accident.ids or ()))] == [float] * 2 + [
            int
        ] * 2

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
        with pytest.raises(GeometryError, match=message):
            Accident(**{"positions": np.zeros((2, 2)), "time": 1.0, **changes})


def same(one: MotionOutput, other: MotionOutput) -> bool:
    mine, others = one.heads or (), other.heads or ()
    return one.grid == other.grid and len(mine) == len(others) and all(map(same_heads, mine, others))


def same_heads(one: MotionHeads, other: MotionHeads) -> bool:
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in NAMES)
