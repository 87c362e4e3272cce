"""Protocol `field` on a few recordings made by hand.

tests/parity compares many with what the published codes print.
"""

import math
from dataclasses import astuple
from typing import Any

import numpy as np
import pytest
from support.expected_errors import assert_raises
from support.warning_evaluations import always_alarm, evaluate_scores, never_alarm

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation.task import headlines
from deepaccident_devkit.evaluation.warning import (
    FieldWarnings,
    ScoreSeries,
    field_figures,
    printed_figures,
)
from deepaccident_devkit.evaluation.warning.field import FIELD_CODES
from deepaccident_devkit.evaluation.warning.recordings import REFERENCES, TRIVIAL
from deepaccident_devkit.support.human_names import human_name

NAN = math.nan
NO_ALARM = -math.inf
RISING = [[0.1, 0.3, 0.6, 0.9], [0.2, 0.5, 0.5, 0.7], [0.1, 0.1, 0.4, 0.2]]
GAPS = [[0.5, NAN, 0.9, NAN], [NAN] * 4, [0.2, NO_ALARM, 0.4, 0.1]]
# Scores so close that codes with thresholds 0.001 apart have room for all.
CLOSE = [[0.99] * 5 + [0.9955] * 5, [0.99] * 10, [0.99] * 4 + [0.9935] * 6]
TWO_ACCIDENTS = [True, True, False]
# At the higher thresholds four of five accidents are warned of.
FIVE = [[0.99] * 10, *[[0.99] * 3 + [0.9955] * 7] * 4, [0.9925] * 10]
RECALL_ABOVE_1 = (
    "recall 1.5, AP 1.5: at the threshold 0 recordings without an accident count as true positives"
)
RAISES = "the published code raises an error here: "
SAME_RECALLS = f"{RAISES}all thresholds have the same recall"
MANY_THRESHOLDS = f"{RAISES}more thresholds than frames"
BY_ZERO = (
    "the published code divides 0 by 0: there is no accident, or no accident is warned of at some "
    "thresholds"
)


def make_series(scores: Any, positive: list[bool], toa: Any = None) -> ScoreSeries:
    """Make scores at two frames a second; recordings end with the array unless `toa` is given."""
    array = np.array(scores, dtype=np.float64)
    if toa is None:
        toa = [array.shape[1]] * len(array)
    return ScoreSeries(
        scores=array,
        positive=np.array(positive),
        toa=np.array(toa, dtype=np.float64),
        fps=2.0,
    )


def unknown_figures(code: str, note: str) -> tuple[Any, ...]:
    """Return NaN for all figures that the code prints, None for the others, and the note."""
    figures_of_code = {
        "dsta": (NAN, None, None, None),
        "drive": (None, NAN, NAN, NAN),
    }.get(code, (None, None, None, None))
    return (NAN, NAN, NAN, *figures_of_code, note)


@pytest.mark.parametrize(
    ("series", "expected"),
    [
        (
            make_series(np.full((2, 3), NAN), TWO_ACCIDENTS[1:]),
            dict.fromkeys(FIELD_CODES, "there is no score"),
        ),
        (
            make_series(RISING, [False] * 3),
            {
                "ustring": SAME_RECALLS,
                "dsta": SAME_RECALLS,
                "drive": (0, 0, 0, None, 0, 0, 0, ""),
                "dad": BY_ZERO,
            },
        ),
        (
            make_series(RISING, TWO_ACCIDENTS),
            {
                "ustring": MANY_THRESHOLDS,
                "dsta": MANY_THRESHOLDS,
                "drive": (0.9375, 1.2, 1.75, None, 1, 0.625, 1.25, ""),
                "dad": (11 / 12, 3.125, 5, None, None, None, None, ""),
            },
        ),
        (
            make_series(np.zeros((2, 4)), [False] * 2),
            {"ustring": SAME_RECALLS, "dsta": SAME_RECALLS},
        ),
        (
            make_series(np.zeros((3, 4)), TWO_ACCIDENTS),
            {
                "ustring": RECALL_ABOVE_1,
                "dsta": RECALL_ABOVE_1,
                "drive": (0, 0, 0, None, 0, 0, 0, ""),
            },
        ),
        (
            make_series(np.full((3, 4), NO_ALARM), TWO_ACCIDENTS),
            {"ustring": RECALL_ABOVE_1, "dad": (0, 0, 0, None, None, None, None, "")},
        ),
        (
            make_series(GAPS, TWO_ACCIDENTS, [3, 4, 2]),
            {
                "drive": (5 / 14, 1, 1.5, None, 1, 3 / 7, 1.5, ""),
                "dad": (0.125, 2.5, 5, None, None, None, None, ""),
            },
        ),
        (
            make_series(CLOSE, TWO_ACCIDENTS),
            {
                "ustring": (0.5 + 5 / 12, 3.75, 5, None, None, None, None, ""),
                "dsta": (0.5 + 5 / 12, 3.75, 5, 2 / 3, None, None, None, ""),
                "drive": (2 / 3, 5, 5, None, 2 / 3, 1, 5, ""),
            },
        ),
        (
            make_series(FIVE, [True] * 5 + [False]),
            {
                "ustring": (0.8 + 11 / 60, 4.25, 3.5, None, None, None, None, ""),
                "dsta": (0.8 + 11 / 60, 4.25, 3.5, 1, None, None, None, ""),
            },
        ),
        (
            make_series(FIVE[1:], [True] * 2 + [False] * 3),
            {"dsta": (0.4, 5, 5, 0.4, None, None, None, "")},
        ),
    ],
)
def test_what_each_code_prints(series: ScoreSeries, expected: dict[str, Any]) -> None:
    for code, printed in expected.items():
        numbers = unknown_figures(code, printed) if isinstance(printed, str) else printed
        assert astuple(field_figures(series, code)) == pytest.approx(numbers, nan_ok=True)


def test_what_a_code_prints_may_be_above_1() -> None:
    silent = make_series(np.zeros((4, 6)), [True, False] * 2)
    assert printed_figures(silent, "ustring").average_precision == 2.0
    assert field_figures(silent, "drive").note == ""
    assert_raises(
        (
            lambda: field_figures(silent, "sota"),
            ChoiceError,
            ("code", "ustring, dsta, drive, dad", "sota"),
        )
    )


@pytest.mark.parametrize("references", [False, True])
def test_what_a_result_holds(*, references: bool) -> None:
    """The result has figures for each code and group, and for reference predictors on request."""
    evaluator = evaluate_scores(
        always_alarm,
        pairs=2,
        agents=[("a", "ego_involved"), ("b", "bystander")],
        right=False,
    )
    result = FieldWarnings().result(
        list(evaluator.counts.values()),
        references=references,
    )
    names = [f"{code} {group}" for group in ("ego_involved", "bystander") for code in FIELD_CODES]
    assert [*result.figures] == names
    assert (result.samples, result.beyond) == (2 * 2 * (13 + 19), 0)
    assert [*result.references] == ([*TRIVIAL, *REFERENCES] if references else [])
    for figures in result.references.values():
        assert [*figures] == names
    assert result.figures["drive bystander"].precision_at_half == pytest.approx(12 / (12 + 19))

    rows = [(row.name, row.unit, row.higher_is_better) for row in headlines(result)]
    assert rows == [
        *((f"AP {name}", "share", True) for name in names),
        *((f"mTTA {name}", "s", True) for name in names),
        *((f"TTA@R80 {name}", "s", True) for name in names),
    ]
    *notes, last_note = result.notes
    assert notes == [
        f"{human_name(name)}: {figures.note}"
        for name, figures in result.figures.items()
        if figures.note
    ]
    assert last_note.startswith(
        "do not compare these times and precisions with those of other code"
    )


def test_silence_is_unknown_and_a_note_explains_why() -> None:
    result = evaluate_scores(never_alarm, "field", pairs=2).compute()
    assert math.isnan(result.figures["ustring ego_involved"].average_precision)
    notes = " ".join(result.notes)
    assert "recordings without an accident count as true positives" in notes
