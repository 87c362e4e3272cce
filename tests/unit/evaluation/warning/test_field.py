"""Protocol `field` on a few recordings by hand; parity has what the published codes print of
many.
"""

import math
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest
from evaluation_of_warnings import always, evaluated, never
from refusals import assert_refused

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

NAN, LOW = math.nan, -math.inf
RISING = [[0.1, 0.3, 0.6, 0.9], [0.2, 0.5, 0.5, 0.7], [0.1, 0.1, 0.4, 0.2]]
GAPS = [[0.5, NAN, 0.9, NAN], [NAN] * 4, [0.2, LOW, 0.4, 0.1]]
CLOSE = [[0.99] * 5 + [0.9955] * 5, [0.99] * 10, [0.99] * 4 + [0.9935] * 6]
"""So close that the codes whose thresholds are 0.001 apart have room for all."""
TWO = [True, True, False]
FIVE = [[0.99] * 10, *[[0.99] * 3 + [0.9955] * 7] * 4, [0.9925] * 10]
"""Of five accidents four are warned of at the higher thresholds."""
ABOVE = (
    "recall 1.5, AP 1.5: at the threshold 0 recordings without an accident count as true positives"
)
RAISES = "the published code raises an error here: "
BY_ZERO = "the published code divides 0 by 0: no accident, or thresholds at which none is warned of"


def series(scores: Any, positive: list[bool], toa: Any = None) -> ScoreSeries:
    """Two frames a second, up to the array's end."""
    given = np.array(scores, dtype=np.float64)
    ends = (
        np.full(len(given), float(given.shape[1]))
        if toa is None
        else np.array(toa, dtype=np.float64)
    )
    return ScoreSeries(scores=given, positive=np.array(positive), toa=ends, fps=2.0)


def all_unknown(code: str, note: str) -> tuple[Any, ...]:
    """NaN, but for what the code does not print at all."""
    own = {"dsta": (NAN, None, None, None), "drive": (None, NAN, NAN, NAN)}.get(code, (None,) * 4)
    return (NAN, NAN, NAN, *own, note)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (series(np.full((2, 3), NAN), TWO[1:]), dict.fromkeys(FIELD_CODES, "there is no score")),
        (
            series(RISING, [False] * 3),
            {
                **dict.fromkeys(
                    ("ustring", "dsta"), f"{RAISES}no threshold has another recall than the others"
                ),
                "drive": (0, 0, 0, None, 0, 0, 0, ""),
                "dad": BY_ZERO,
            },
        ),
        (
            series(RISING, TWO),
            {
                **dict.fromkeys(("ustring", "dsta"), f"{RAISES}more thresholds than frames"),
                "drive": (0.9375, 1.2, 1.75, None, 1, 0.625, 1.25, ""),
                "dad": (11 / 12, 3.125, 5, None, None, None, None, ""),
            },
        ),
        (
            series(np.zeros((2, 4)), [False] * 2),
            dict.fromkeys(
                ("ustring", "dsta"), f"{RAISES}no threshold has another recall than the others"
            ),
        ),
        (
            series(np.zeros((3, 4)), TWO),
            {"ustring": ABOVE, "dsta": ABOVE, "drive": (0, 0, 0, None, 0, 0, 0, "")},
        ),
        (
            series(np.full((3, 4), LOW), TWO),
            {"ustring": ABOVE, "dad": (0, 0, 0, None, None, None, None, "")},
        ),
        (
            series(GAPS, TWO, [3, 4, 2]),
            {
                "drive": (5 / 14, 1, 1.5, None, 1, 3 / 7, 1.5, ""),
                "dad": (0.125, 2.5, 5, None, None, None, None, ""),
            },
        ),
        (
            series(CLOSE, TWO),
            {
                "ustring": (0.5 + 5 / 12, 3.75, 5, None, None, None, None, ""),
                "dsta": (0.5 + 5 / 12, 3.75, 5, 2 / 3, None, None, None, ""),
                "drive": (2 / 3, 5, 5, None, 2 / 3, 1, 5, ""),
            },
        ),
        (
            series(FIVE, [True] * 5 + [False]),
            {
                "ustring": (0.8 + 11 / 60, 4.25, 3.5, None, None, None, None, ""),
                "dsta": (0.8 + 11 / 60, 4.25, 3.5, 1, None, None, None, ""),
            },
        ),
        (
            series(FIVE[1:], [True] * 2 + [False] * 3),
            {"dsta": (0.4, 5, 5, 0.4, None, None, None, "")},
        ),
    ],
)
def test_what_each_code_prints(given: ScoreSeries, expected: dict[str, Any]) -> None:
    for code, printed in expected.items():
        found = tuple(asdict(field_figures(given, code)).values())
        assert found == pytest.approx(
            all_unknown(code, printed) if isinstance(printed, str) else printed, nan_ok=True
        )


def test_what_a_code_prints_may_be_above_1() -> None:
    nothing = series(np.zeros((4, 6)), [True, False] * 2)
    assert [
        printed_figures(nothing, "ustring").average_precision,
        field_figures(nothing, "drive").note,
    ] == [2.0, ""]
    assert_refused(
        (
            lambda: field_figures(nothing, "sota"),
            ChoiceError,
            ("code", "ustring, dsta, drive, dad", "sota"),
        )
    )


@pytest.mark.parametrize("references", [False, True])
def test_what_a_result_holds(*, references: bool) -> None:
    """For each code and group, of all alarms; of the reference predictors where they are asked
    for.
    """
    counts = evaluated(
        always, pairs=2, agents=[("a", "ego_involved"), ("b", "bystander")], right=False
    ).counts
    made = FieldWarnings().result(list(counts.values()), references=references)
    names = [f"{code} {group}" for group in ("ego_involved", "bystander") for code in FIELD_CODES]
    assert ([*made.figures], made.samples, made.beyond) == (names, 2 * 2 * (13 + 19), 0)
    assert [*made.references] == ([*TRIVIAL, *REFERENCES] if references else [])
    assert all([*each] == names for each in made.references.values())
    assert made.figures["drive bystander"].precision_at_half == pytest.approx(12 / (12 + 19))
    rows = (("AP", "share"), ("mTTA", "s"), ("TTA@R80", "s"))
    assert [(each.name, each.unit, each.higher_is_better) for each in headlines(made)] == [
        (f"{row} {name}", unit, True) for row, unit in rows for name in names
    ]
    *said, last = made.notes
    assert said == [f"{name}: {each.note}" for name, each in made.figures.items() if each.note]
    assert last.startswith("times and precisions of different codes are not comparable")


def test_silence_is_unknown_and_a_note_says_why() -> None:
    result = evaluated(never, "field", pairs=2).compute()
    assert math.isnan(result.figures["ustring ego_involved"].average_precision)
    assert any(
        "recordings without an accident count as true positives" in note for note in result.notes
    )
