"""The cost of false alarms: runs, seconds of braking, and alarms that outlast the reaction."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from deepaccident_devkit.evaluation.warning.recordings import AlarmRuns

ALARMS = arrays(bool, st.tuples(st.integers(0, 4), st.integers(0, 9)))
ROWS = np.array([[1, 1, 0, 1, 1, 1], [0, 0, 0, 0, 0, 0], [1, 0, 1, 0, 1, 1]]) > 0


def test_runs_begin_and_end_with_their_rows() -> None:
    runs = AlarmRuns.of(ROWS, 2.0)
    assert runs.row.tolist() == [0, 0, 2, 2, 2]
    assert runs.begin.tolist() == [0, 3, 0, 2, 4]
    assert runs.length.tolist() == [2, 3, 1, 1, 2]


def test_braking_is_what_is_left_of_each_run_after_the_reaction() -> None:
    assert AlarmRuns.of(ROWS, 2.0).braking_seconds(0.5).tolist() == [0.5 + 1.0, 0.0, 0.5]
    assert AlarmRuns.of(ROWS, 2.0).braking_seconds(1.0).tolist() == [0.5, 0.0, 0.0]


def test_a_run_lasts_if_it_is_longer_than_the_reaction() -> None:
    assert AlarmRuns.of(ROWS, 2.0).first_lasting(0.5).tolist() == [0, 6, 4]
    assert AlarmRuns.of(ROWS, 2.0).first_lasting(1.0).tolist() == [3, 6, 6]


@given(ALARMS, st.sampled_from((0.0, 0.5, 1.0)))
def test_alarms_last_where_they_cost_something(alarm: np.ndarray, reaction: float) -> None:
    costly = AlarmRuns.of(alarm, 2.0).braking_seconds(reaction) > 0
    assert (costly == (AlarmRuns.of(alarm, 2.0).first_lasting(reaction) < alarm.shape[1])).all()


@given(ALARMS, ALARMS, st.sampled_from((0.0, 0.5, 1.0)))
def test_fewer_alarms_never_cost_more(alarm: np.ndarray, other: np.ndarray, reaction: float) -> None:
    """So the cost never rises with the threshold, and the lowest within a budget can be bisected."""
    if alarm.shape == other.shape:
        fewer = AlarmRuns.of(alarm & other, 2.0).braking_seconds(reaction)
        assert (fewer <= AlarmRuns.of(alarm, 2.0).braking_seconds(reaction)).all()
