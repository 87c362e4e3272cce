"""Measure the tables on warnings of docs/protocols.md: `python docs/make_warning_tables.py [RELEASE]`, from a checkout.

RELEASE is a folder to take in place of a new synthetic release, if it was made as `RELEASE` says. The last table goes
into CHANGELOG.md.
"""

import math
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import make_accident_tables
from make_accident_tables import HERE, put

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.baselines import outlook
from deepaccident_devkit.baselines.predict import accidents_ahead
from deepaccident_devkit.evaluation import Accident, AccidentEvaluator, WarningEvaluator
from deepaccident_devkit.evaluation.accident import AccidentContext, accident_context
from deepaccident_devkit.evaluation.runs.text import predictor_tables
from deepaccident_devkit.evaluation.warning.recordings import GIVEN
from deepaccident_devkit.synth import SynthConfig, make_release

RELEASE = SynthConfig(scenarios=60, seed=7, sensors=False)
SPLIT, HORIZON, GROUP = "train", 2.0, "ego_involved"
Predictor = Callable[[DeepAccident, str, AccidentContext], list[Accident]]


def main() -> None:
    """Write all tables."""
    if len(sys.argv) > 1:
        measure(DeepAccident("v1", sys.argv[1], verbose=False))
        return
    with tempfile.TemporaryDirectory() as folder:
        measure(DeepAccident("v1", make_release(Path(folder) / "release", RELEASE), verbose=False))


def measure(dataset: DeepAccident) -> None:
    """Of all samples of the split, two a second, each predictor through each protocol."""
    warned = {name: {kind: WarningEvaluator(kind) for kind in ("clean", "field")} for name in PREDICTORS}
    accidents = {(name, when): AccidentEvaluator("boxes") for name in PREDICTORS for when in ("before", "after")}
    for token in dataset.samples(SPLIT, "all"):
        context = accident_context(dataset, token, HORIZON, references=True)
        for name, predict in PREDICTORS.items():
            alarms = predict(dataset, token, context)
            for evaluator in warned[name].values():
                evaluator.update(token, alarms, None, context)
            accidents[name, "after"].update(token, alarms, None, context)
            accidents[name, "before"].update(token, alarms, None, as_before(context))
    results = {name: {kind: each.compute() for kind, each in those.items()} for name, those in warned.items()}
    put("warning-clean", beside({name: each["clean"].as_dict() for name, each in results.items()}, GROUP))
    for code in ("drive", "dad"):
        fields = {name: each["field"].as_dict() for name, each in results.items()}
        put(f"warning-{code}", beside(fields, f"{code} {GROUP}"))
    make_accident_tables.PAGE = HERE.parent / "CHANGELOG.md"
    put("boxes-before-and-after", changes({key: each.compute() for key, each in accidents.items()}))


def siren(_dataset: DeepAccident, _token: str, context: AccidentContext) -> list[Accident]:
    """The best siren there is: it never stops, and names the two who collide where anybody does."""
    impact = context.truth.impact if context.truth else None
    positions = [[10.0, 0.0], [14.0, 0.0]] if impact is None else impact.positions
    return [Accident(positions=positions, time=0.0, score=1.0, ids=context.pair)]


def far_siren(dataset: DeepAccident, token: str, context: AccidentContext) -> list[Accident]:
    """The same, for 15 minutes later."""
    return [replace(alarm, time=900.0) for alarm in siren(dataset, token, context)]


def perfect(_dataset: DeepAccident, _token: str, context: AccidentContext) -> list[Accident]:
    """The true accident, from the horizon on."""
    return [context.truth.accident] if context.truth and context.truth.accident else []


def _baseline(agents: str) -> Predictor:
    return lambda dataset, token, _context: accidents_ahead(outlook(dataset, token, agents=agents), HORIZON)


PREDICTORS: Mapping[str, Predictor] = {
    "the truth, 2 s ahead": perfect,
    "baseline, all agents": _baseline("all"),
    "baseline, single": _baseline("single"),
    "siren": siren,
    "siren, 900 s": far_siren,
}


def as_before(context: AccidentContext) -> AccidentContext:
    """Without a bound of the time, and with the impact's frame as a positive one, as `boxes` was."""
    truth = context.truth
    if truth is None:
        return context
    accident = truth.accident
    if accident is not None:
        accident = replace(accident, time=max(accident.time, 0.05))
    return replace(context, truth=replace(truth, horizon=math.inf, accident=accident))


def beside(results: Mapping[str, dict], group: str) -> str:
    """The predictors' rows of one group, then the reference rows, as Markdown."""
    lines: list[str] = []
    for name, metrics in results.items():
        rows = next(each.rows for each in predictor_tables(metrics) if each.rows[0][0] == group)
        if not lines:
            lines += [_line(rows[0]), "|---" * len(rows[0]) + "|"]
        lines += [_line((name, *row[1:])) for row in rows if row[0] == GIVEN]
        references = [row for row in rows[1:] if row[0] != GIVEN]
    return "\n".join([*lines, *map(_line, references)])


def changes(results: Mapping[tuple[str, str], object]) -> str:
    """Accidents by `boxes`, before and after."""
    head = ("predictor", "positives", "APA", "precision", "recall", "false alarm rate")
    lines = [_line(head), "|---" * len(head) + "|"]
    for name in PREDICTORS:
        pairs = [[_cells(results[name, when])[column] for when in ("before", "after")] for column in range(5)]
        lines.append(_line((name, *(one if one == two else f"{one} → {two}" for one, two in pairs))))
    return "\n".join(lines)


def _cells(result: object) -> tuple[str, ...]:
    numbers = (result.apa, result.precision, result.recall, result.false_alarm_rate)
    return str(result.positives), *map(_number, numbers)


def _line(cells: tuple[str, ...]) -> str:
    return f"| {' | '.join(cells)} |"


def _number(value: float | None) -> str:
    return "–" if value is None or math.isnan(value) else f"{value:.3f}"


if __name__ == "__main__":
    main()
