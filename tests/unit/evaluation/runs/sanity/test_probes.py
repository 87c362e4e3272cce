"""The eight symmetries: of points and of rasters alike, and which orientations are mistaken for which."""

import numpy as np
import pytest
from memory_results import MemoryResults

from deepaccident_devkit.evaluation import Accident
from deepaccident_devkit.evaluation.runs.sanity.check import _says_something
from deepaccident_devkit.evaluation.runs.sanity.pairs import _rank_tally
from deepaccident_devkit.evaluation.runs.sanity.probes import IDENTITY, SYMMETRIES, Symmetry, orientation_mistaken
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS, Orientation

of_all = pytest.mark.parametrize("symmetry", [IDENTITY, *SYMMETRIES], ids=lambda each: each.name)
GRID = BevGrid((-2.0, 2.0, 0.5), (-2.0, 2.0, 0.5))


@of_all
def test_undo_takes_back_what_apply_did(symmetry: Symmetry) -> None:
    points = np.array([[3.0, 1.0], [-2.0, 5.0]])
    np.testing.assert_array_equal(symmetry.undo(symmetry.apply(points)), points)


@of_all
def test_a_raster_is_set_right_as_its_points_are(symmetry: Symmetry) -> None:
    point = np.array([[1.3, -0.4]])
    right, found = np.zeros(GRID.shape), np.zeros(GRID.shape)
    for raster, points in ((right, point), (found, symmetry.apply(point))):
        row, column = GRID.index_of(points)[0][0]
        raster[row, column] = 1
    np.testing.assert_array_equal(symmetry.undo_raster(found), right)


def test_a_turn_by_90_degrees_is_to_the_left() -> None:
    turn = next(each for each in SYMMETRIES if each.name == "turned by 90°")
    np.testing.assert_array_equal(turn.apply(np.array([1.0, 0.0])), [0.0, 1.0])


@pytest.mark.parametrize("stated", ORIENTATIONS)
@pytest.mark.parametrize("meant", ORIENTATIONS)
def test_each_mixed_up_orientation_is_one_symmetry(stated: Orientation, meant: Orientation) -> None:
    raster = np.random.default_rng(0).uniform(size=(8, 8))
    lies_so = GRID.reorient(raster, meant)
    looks = GRID.with_orientation(stated).reorient(lies_so, "devkit")
    found = [each for each in SYMMETRIES if np.array_equal(each.undo_raster(looks), raster)]
    assert len(found) == int(stated != meant)
    if found:
        assert orientation_mistaken(found[0], stated) == meant


def test_no_orientation_explains_what_is_mirrored_along_x() -> None:
    assert orientation_mistaken(SYMMETRIES[0], "devkit") is None


def test_equal_scores_rank_no_pair() -> None:
    wrong_is_surer, pairs, right_is_surer, *_ = _rank_tally(np.array([0.5, 0.5]), np.array([True, False]))
    assert (wrong_is_surer, pairs, right_is_surer) == (0, 1, 0)
    assert _rank_tally(np.array([0.5, 0.9]), np.array([True, False]))[0] == 1


def test_of_accident_lists_samples_with_an_alarm_say_something() -> None:
    alarm = Accident(positions=[[12.0, 0.5], [13.0, -1.5]], time=1.5, score=0.8)
    says = _says_something(MemoryResults("accident", {"with": [alarm], "without": []}))
    assert (says("with"), says("without")) == (True, False)
