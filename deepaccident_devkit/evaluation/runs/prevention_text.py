"""Prevented accidents as tables: predictors at the operating point, and the ways of braking."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

from deepaccident_devkit.evaluation.metrics.warning.drives import GIVEN
from deepaccident_devkit.evaluation.metrics.warning.outcome_tables import NOMINAL, SETTINGS
from deepaccident_devkit.evaluation.runs.predictors import number_text
from deepaccident_devkit.reports import Table
from deepaccident_devkit.safety import OUTCOMES

Json = Mapping[str, Any]
_COLUMNS: Final = (*OUTCOMES, "if lasting", "warned", "after end", "braking s/min")
"""Shares of the accidents: the classes, avoided if alarms must last, with an alarm, of contacts after the recording."""
_ALARMS: Final = {"right": "right alarms", "any_alarm": "any alarm"}
_AT_ONCE: Final = "0"
"""Name of no latency, as JSON has it."""


def prevention_tables(prevented: Json) -> list[Table]:
    """Two tables for each group of recordings: predictors at the nominal setting, and the predictions at all settings.

    Args:
        prevented: of a summary: a `PreventedResult` as JSON holds it, with `intervals` of its numbers.
    """
    tables = []
    for group, given in prevented["groups"].items():
        everyone = {GIVEN: given, **{name: each[group] for name, each in prevented["references"].items()}}
        head = (f"{group}, {NOMINAL}", *_COLUMNS)
        notes = tuple(_notes(prevented, group, given))
        tables.append(Table(rows=(head, *_predictors(prevented["alarms"], everyone)), notes=notes))
        rows = tuple((name, *_cells(given, prevented["alarms"], setting=name)) for name in SETTINGS)
        tables.append(Table(rows=((f"{group}, {GIVEN}", *_COLUMNS), *rows), notes=()))
    return tables


def prevention_text(prevented: Json) -> str:
    """All tables of `prevention_tables` and the notes, as aligned lines."""
    tables = [each.to_text() for each in prevention_tables(prevented)]
    return "\n\n".join([*tables, *(["\n".join(prevented["notes"])] if prevented["notes"] else [])])


def _predictors(alarms: str, everyone: Mapping[str, Json]) -> Iterator[tuple[str, ...]]:
    """A row a predictor; the given one also with other alarms, and with each latency."""
    for name, figures in everyone.items():
        yield name, *_cells(figures, alarms)
        if name == GIVEN:
            for latency in figures[alarms]:
                if latency != _AT_ONCE:
                    yield f"{name}, {latency} s later", *_cells(figures, alarms, latency)
            (other,) = _ALARMS.keys() - {alarms}
            yield f"{name}, {_ALARMS[other]}", *_cells(figures, other, lasting=None)


def _cells(
    given: Json, alarms: str, latency: str = _AT_ONCE, setting: str = NOMINAL, lasting: str | None = "lasting"
) -> Iterator[str]:
    figures = given[alarms][latency][setting]
    avoided = None if lasting is None else given[lasting][latency][setting]["shares"][OUTCOMES[0]]
    values = [*figures["shares"].values(), avoided]
    values += [figures[name] for name in ("warned", "extrapolated", "braking_seconds_per_minute")]
    yield from map(number_text, values)


def _notes(prevented: Json, group: str, given: Json) -> Iterator[str]:
    threshold, quiet = given["threshold"], given["quiet_braking"]
    how = "given" if prevented["operating_by"] == "given" else "at most 1 braking s/min on these recordings"
    figures = given[prevented["alarms"]][_AT_ONCE][NOMINAL]
    lasting = given["lasting"][_AT_ONCE][NOMINAL]
    path = f"groups/{group}/{prevented['alarms']}/{_AT_ONCE}/{NOMINAL}/shares/{OUTCOMES[0]}"
    ends = prevented["intervals"].get(path)
    interval = "" if not ends or None in ends else f" [{ends[0]:.3f}, {ends[1]:.3f}]"
    yield (
        f"avoided: {number_text(figures['shares'][OUTCOMES[0]])}{interval} of {given['accidents']} accidents "
        f"({number_text(lasting['shares'][OUTCOMES[0]])} by alarms that outlast the reaction), for "
        f"{number_text(figures['braking_seconds_per_minute'])} braking seconds a minute in {given['minutes']:.1f} min "
        f"of {given['recordings']} recordings without an accident"
    )
    yield (
        f"threshold {'none' if threshold is None else f'{threshold:.4g}'} ({how}); for another split: braking "
        f"{'–' if quiet is None else f'{quiet:.4g}'}"
    )
