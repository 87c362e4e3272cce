"""Evaluate warnings by the protocol `clean`: of baselines, of the truth, and of sirens.

All numbers are stored in warnings.json.
"""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.measure import temporary_folder
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import Accident, WarningEvaluator
from deepaccident_devkit.evaluation.accident import AccidentContext, accident_context
from deepaccident_devkit.plugins.baselines import outlook
from deepaccident_devkit.plugins.baselines.predict import accidents_ahead
from deepaccident_devkit.plugins.synth import SynthConfig, make_release

RELEASE = SynthConfig(scenarios=60, frames=None, seed=7, sensors=False, traffic="v1")
DESIGNED = replace(RELEASE, designed=True)
"""The clean accidents, which are easier to foresee."""
SPLIT, HORIZON, GROUP = "train", 2.0, "ego_involved"
MEASURED = Path(__file__).with_suffix(".json")
OPERATING_NUMBERS = (
    "precision",
    "time_in_alarm",
    "alarm_seconds_per_minute",
    "episodes_per_minute",
    "recall",
    "tta0",
    "tta_hit",
)
NUMBERS = ("auc_ahead", "twin_wins", "average_precision", "mean_time")
Figures = dict[str, dict[str, float | None]]
Predictor = Callable[[DeepAccident, str, AccidentContext], list[Accident]]


def main(release: Path | None = None) -> None:
    """Measure and store the numbers; docs/protocols.md quotes some of them."""
    with temporary_folder() as folder:
        root = release or make_release(folder / "release", RELEASE)
        figures = predictor_figures(root, PREDICTORS)
        easier = make_release(folder / "designed", DESIGNED)
        easier_figures = predictor_figures(easier, BASELINES)
    measured = {
        "ordinary": figures,
        "designed": {name: easier_figures[name] for name in BASELINES},
    }
    text = json.dumps(measured, indent=1, ensure_ascii=False)
    MEASURED.write_text(f"{text}\n", encoding="utf-8")


def predictor_figures(root: Path, predictors: Mapping[str, Predictor]) -> Figures:
    """Evaluate each predictor on all samples of the split, two a second, by the protocol `clean`.

    Returns:
        Name of the predictor → name of a number → the number, with three digits; None for NaN.
    """
    dataset = DeepAccident("v1", root, verbose=False)
    evaluators = {name: WarningEvaluator("clean") for name in predictors}
    for token in dataset.samples(SPLIT, "all"):
        context = accident_context(dataset, token, HORIZON, references=True)
        for name, predict in predictors.items():
            alarms = predict(dataset, token, context)
            evaluators[name].update(token, alarms, None, context)
    results = {name: evaluator.compute().as_dict() for name, evaluator in evaluators.items()}
    return figures_of_group(results, GROUP)


def siren(_dataset: DeepAccident, _token: str, context: AccidentContext) -> list[Accident]:
    """Return the best possible siren's alarm: it never stops, and names the pair where anybody
    collides.
    """
    impact = context.truth.impact if context.truth else None
    positions = [[10.0, 0.0], [14.0, 0.0]] if impact is None else impact.positions
    return [Accident(positions=positions, time=0.0, score=1.0, ids=context.pair)]


def far_siren(dataset: DeepAccident, token: str, context: AccidentContext) -> list[Accident]:
    """Return the siren's alarm, 15 minutes later."""
    return [replace(alarm, time=900.0) for alarm in siren(dataset, token, context)]


def perfect(_dataset: DeepAccident, _token: str, context: AccidentContext) -> list[Accident]:
    """Return the true accident, from the horizon on."""
    if context.truth is None or context.truth.accident is None:
        return []
    return [context.truth.accident]


def _baseline(agents: str) -> Predictor:
    def predict(dataset: DeepAccident, token: str, _context: AccidentContext) -> list[Accident]:
        return accidents_ahead(outlook(dataset, token, agents=agents), HORIZON)

    return predict


BASELINES: Mapping[str, Predictor] = {
    "baseline, all agents": _baseline("all"),
    "baseline, single": _baseline("single"),
}
PREDICTORS: Mapping[str, Predictor] = {
    "the truth, 2 s ahead": perfect,
    **BASELINES,
    "siren": siren,
    "siren, 900 s": far_siren,
}


def figures_of_group(results: Mapping[str, dict], group: str) -> Figures:
    """Return the predictors' figures in one group, then the figures of the reference predictors."""
    figures = {}
    references = {}
    for name, metrics in results.items():
        figures[name] = rounded_numbers(metrics["groups"][group])
        for reference_name, groups in metrics["references"].items():
            references[reference_name] = rounded_numbers(groups[group])
    return figures | references


def rounded_numbers(figures: Mapping[str, Any]) -> dict[str, float | None]:
    """Return the numbers of a predictor, and its numbers at the operating point."""
    numbers = {name: figures[name] for name in NUMBERS}
    numbers |= {name: figures["operating"][name] for name in OPERATING_NUMBERS}
    rounded = {}
    for name, value in numbers.items():
        is_unknown = value is None or math.isnan(value)
        rounded[name] = None if is_unknown else round(value, 3)
    return rounded
