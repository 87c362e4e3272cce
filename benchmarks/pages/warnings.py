"""Warnings by the protocol `clean`: of baselines, of the truth, and of sirens."""

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from benchmarks.pages.marks import put, table
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import Accident, WarningEvaluator
from deepaccident_devkit.evaluation.accident import AccidentContext, accident_context
from deepaccident_devkit.evaluation.runs.text import predictor_tables
from deepaccident_devkit.evaluation.warning.recordings import GIVEN
from deepaccident_devkit.plugins.baselines import outlook
from deepaccident_devkit.plugins.baselines.predict import accidents_ahead
from deepaccident_devkit.plugins.synth import SynthConfig, make_release

RELEASE = SynthConfig(scenarios=60, frames=None, seed=7, sensors=False, traffic="v1")
DESIGNED = replace(RELEASE, designed=True)
"""The clean accidents, which are easier to foresee."""
SPLIT, HORIZON, GROUP = "train", 2.0, "ego_involved"
Predictor = Callable[[DeepAccident, str, AccidentContext], list[Accident]]


def main(release: Path | None = None) -> None:
    """Write the tables."""
    with tempfile.TemporaryDirectory() as folder:
        root = release or make_release(Path(folder) / "release", RELEASE)
        put("warning-clean", measured(root, PREDICTORS))
        easier = make_release(Path(folder) / "designed", DESIGNED)
        rows = measured(easier, BASELINES).strip().splitlines()
        put(
            "warning-designed", "\n".join(rows[: 2 + len(BASELINES)])
        )  # without the rows of references


def measured(root: Path, predictors: Mapping[str, Predictor]) -> str:
    """Of all samples of the split, two a second, each predictor through the protocol `clean`, as
    Markdown.
    """
    dataset = DeepAccident("v1", root, verbose=False)
    warned = {name: WarningEvaluator("clean") for name in predictors}
    for token in dataset.samples(SPLIT, "all"):
        context = accident_context(dataset, token, HORIZON, references=True)
        for name, predict in predictors.items():
            alarms = predict(dataset, token, context)
            warned[name].update(token, alarms, None, context)
    return beside({name: each.compute().as_dict() for name, each in warned.items()}, GROUP)


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
    return lambda dataset, token, _context: accidents_ahead(
        outlook(dataset, token, agents=agents), HORIZON
    )


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


def beside(results: Mapping[str, dict], group: str) -> str:
    """The predictors' rows of one group, then the reference rows, as Markdown."""
    head: tuple[str, ...] = ()
    lines: list[tuple[str, ...]] = []
    for name, metrics in results.items():
        rows = next(each.rows for each in predictor_tables(metrics) if each.rows[0][0] == group)
        head = rows[0]
        lines += [(name, *row[1:]) for row in rows if row[0] == GIVEN]
        references = [row for row in rows[1:] if row[0] != GIVEN]
    return table(head, [*lines, *references])
