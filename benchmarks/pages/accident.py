"""Accidents through the protocols: golden ones, and the labels themselves as predictions."""

import sys
import tempfile
from pathlib import Path

from benchmarks.pages.marks import TESTS, number, put, table
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation.accident import PROTOCOLS, AccidentEvaluator, AccidentResult, accident_context
from deepaccident_devkit.evaluation.predictions import MotionOutput
from deepaccident_devkit.evaluation.task import switched
from deepaccident_devkit.motion import MotionHeads
from deepaccident_devkit.synth import SynthConfig, make_release
from deepaccident_devkit.taxonomy import AGENTS

RELEASE = SynthConfig(scenarios=24, frames=40, seed=12, sensors=False)
HORIZON = 2.0
PAPER_CHOICES: tuple[tuple[str, object], ...] = (
    ("reading.danger_distance", 0.5),
    ("reading.danger_distance", 1.5),
    ("reading.danger_distance", 2.5),
    ("sample_choice", "mean_first"),
)


def main(_release: Path | None = None) -> None:
    """Write all tables into the page."""
    put("accident-golden", golden_table())
    put("accident-perfect", perfect_table())


def golden_table() -> str:
    """Golden accidents (d_accident) through each protocol of rasters, and `paper` with each choice changed."""
    sys.path.insert(0, str(TESTS))
    from parity.conftest import GoldenCase
    from parity.test_accident import heads_of, label_of

    folder = TESTS / "data" / "golden"
    evaluators = {"`released`": AccidentEvaluator("released"), "**`paper`**": AccidentEvaluator("paper")}
    paper = PROTOCOLS["paper"]
    evaluators |= {f"`{name}={to}`": AccidentEvaluator(switched(paper, {name: to})) for name, to in PAPER_CHOICES}
    for index in range(len(GoldenCase(folder, "d_accident", "samples", None).whole["samples"])):
        case = GoldenCase(folder, "d_accident", "samples", index)
        label = label_of(case, "devkit")
        output = MotionOutput(grid=label.config.grid, heads=heads_of(case, "devkit"))
        for evaluator in evaluators.values():
            evaluator.update(f"sample {index}", output, label)
    rows = {name: evaluator.compute() for name, evaluator in evaluators.items()}
    return accident_table(rows, "protocol, or the choice of `paper` that is changed")


def perfect_table() -> str:
    """The labels themselves as predictions, through the protocols."""
    evaluators = {
        (name, given): AccidentEvaluator(name) for name in ("released", "paper", "boxes") for given in ("maps", "heads")
    }
    with tempfile.TemporaryDirectory() as folder:
        dataset = DeepAccident("v1", make_release(Path(folder) / "release", RELEASE), verbose=False)
        for token in _evaluated(dataset):
            label = dataset.motion_labels(token).to_present("bilinear")
            context = accident_context(dataset, token, horizon=HORIZON)
            outputs = {
                "maps": MotionOutput(grid=label.config.grid, instances=label.instance[None]),
                "heads": MotionOutput(grid=label.config.grid, heads=(MotionHeads.from_labels(label),)),
            }
            for (_, given), evaluator in evaluators.items():
                evaluator.update(token, outputs[given], label, context)
    rows = {f"`{name}`, {given}": each.compute() for (name, given), each in evaluators.items()}
    return accident_table(rows, "protocol, and how the labels are given", ("meta", "another", "none"))


def accident_table(rows: dict[str, AccidentResult], what: str, names: tuple[str, ...] = ()) -> str:
    """One line a result, with the truths that name somebody of `names`."""
    head = [what, "truths", "TP", "FP", "FN at 10 m", "APA (%)", "id", "position (m)", "time (s)", *names]
    lines = []
    for name, result in rows.items():
        at = result.within[10.0]
        errors = (number(value, 2) for value in (result.id_error, result.position_error, result.time_error))
        named = (result.truths[each] for each in names)
        numbers = (result.positives, at.tp, at.fp, at.fn, number(100 * result.apa, 1), *errors, *named)
        lines.append([name, *map(str, numbers)])
    return table(head, lines)


def _evaluated(dataset: DeepAccident) -> list[str]:
    """The samples of the released test mode, of every split."""
    result = []
    for scenario in dataset.scenario:
        if not scenario["designed_accident"]:
            continue
        for back in (5, 10, 15, 20):
            frame = f"{scenario['num_frames'] - back:03d}"
            result += [f"{scenario['token']}/{agent}/{frame}" for agent in AGENTS]
    return result
