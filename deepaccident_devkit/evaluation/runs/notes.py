"""What a reader of an evaluation's numbers has to know before comparing them with published ones."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

Json = Mapping[str, Any]
_PUBLISHED_CELLS: Final = [-50.0, 50.0, 0.5]
_PUBLISHED_PREDICTIONS: Final = 6
_FEW_PATHS: Final = 0.9
"""Share of true paths with a match below which errors of paths say little of the others."""


def reading_notes(summary: Json) -> list[str]:
    """Sentences on a summary's numbers: cells, frames and predictions that published numbers do not have, and others.

    Args:
        summary: as `EvaluationRun.summary` makes it and `metrics_summary.json` has it.
    """
    form, metrics = summary["results"]["form"], summary["metrics"]
    notes = [] if form is None else [*_cells(form, metrics.get("ranges") or ()), *_frames(form, summary["horizon"])]
    released = summary["protocol"] == "released"
    if summary["task"] == "motion":
        notes += _paths(metrics)
    elif summary["task"] == "accident" and released and form is not None:
        notes += _predictions(form)
    elif summary["task"] == "detection" and released:
        notes.append(
            "released: hidden boxes are truth, a class without true boxes counts as 0, velocities are compared with "
            "the label's raw ones; --protocol paper leaves these out"
        )
    return notes


def _cells(form: Json, ranges: Sequence[str]) -> Iterator[str]:
    if form["x"] == form["y"] == _PUBLISHED_CELLS:
        return
    axes = ", ".join(f"{name} from {low:g} to {high:g} m" for name in "xy" for low, high, _ in [form[name]])
    yield (
        f"the maps have cells of {form['x'][2]:g} m, {axes}, and so have the labels that they are compared with; "
        "published numbers are of cells of 0.5 m, x and y from -50 to 50 m, and cannot be compared with these"
    )
    reach = min(abs(end) for name in "xy" for end in form[name][:2])
    for name in ranges:
        if max(float(side) for side in name.split("x")) > 2 * reach:
            yield f"{name}: the maps end before this range does; only their cells count"


def _frames(form: Json, horizon: float) -> Iterator[str]:
    needed = round(horizon / form["step"]) + 1
    if form["frames"] > needed:
        yield (
            f"predictions have {form['frames']} frames; the first {needed} are evaluated, and the first of all must be "
            "the present: leave out past frames"
        )


def _predictions(form: Json) -> Iterator[str]:
    if form["stored"] == "instances":
        yield "instance maps: cannot be compared with published APA, which is of heads (docs/comparable_numbers.md)"
    if form["predictions"] < _PUBLISHED_PREDICTIONS:
        yield (
            f"predictions of a sample: {form['predictions']}; published numbers are of {_PUBLISHED_PREDICTIONS}, five "
            "samples and then their mean"
        )


def _paths(metrics: Json) -> Iterator[str]:
    found = metrics["path_true_positive"]
    true = found + metrics["path_false_negative"]
    if found < _FEW_PATHS * true:
        yield f"{found} of {true} true paths have a match; min_ade, min_fde and miss_rate are of these alone"
