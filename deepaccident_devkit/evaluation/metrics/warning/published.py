"""`FieldWarnings`: the numbers of four published anticipation codes with their quirks (protocol `field`)."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from deepaccident_devkit.evaluation.metrics.evaluator import Counts
from deepaccident_devkit.evaluation.metrics.headlines import TaskResult
from deepaccident_devkit.evaluation.metrics.warning.drives import (
    GIVEN,
    PREDICTORS,
    by_group,
    drives_of,
    left_out_notes,
    parts_of,
    series_of,
)
from deepaccident_devkit.evaluation.metrics.warning.field import FIELD_CODES, FieldFigures, field_figures


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldResult(TaskResult):
    """The result of the protocol `field`: not comparable between codes, and predictors that know nothing can win.

    Attributes:
        samples: how many.
        figures: code and involvement of the agent, such as `ustring ego_involved` → what that code prints.
        references: predictor (of `PREDICTORS` but the given one) → the same.
        beyond: alarms for later than the horizon, which do not count.
        notes: sentences that a reader of the numbers should know: why numbers are NaN.
    """

    task: ClassVar[str] = "warning"
    samples: int
    figures: Mapping[str, FieldFigures]
    references: Mapping[str, Mapping[str, FieldFigures]]
    beyond: int
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldWarnings:
    """Published anticipation metrics, for numbers beside published ones.

    A recording's score is as of `CleanWarnings`, of all its alarms, since dash-cam sets know recordings alone.
    """

    def settings(self) -> dict[str, Any]:
        """No choices: it is as those codes are."""
        return {}

    def result(self, counts: Collection[Counts], *, references: bool = False) -> FieldResult:
        """The metrics of some samples' counts, with those of the reference predictors or without."""
        parts = parts_of(counts)
        groups, samples = dict(by_group(drives_of(parts))), [sample for part in parts for sample in part]
        made = {
            predictor: {
                f"{code} {group}": field_figures(series_of(those, predictor, "recording"), code)
                for group, those in groups.items()
                for code in FIELD_CODES
            }
            for predictor in (PREDICTORS if references else PREDICTORS[:1])
        }
        given = made.pop(GIVEN)
        notes = [*left_out_notes(samples), *(f"{name}: {each.note}" for name, each in given.items() if each.note)]
        return FieldResult(
            samples=len(samples),
            figures=given,
            references=made,
            beyond=sum(each["beyond"] for each in samples),
            notes=(*notes, "times and precisions of different codes are not comparable; the protocol clean ranks"),
        )
