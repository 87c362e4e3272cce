"""The command that evaluates results: with the split, samples and options for which they were probably made."""

from __future__ import annotations

import shlex
from collections import Counter
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit.evaluation.runs import SampleSelection, coverage, default_selection
from deepaccident_devkit.explore.background import Job
from deepaccident_devkit.taxonomy import FRAME_PERIOD, SPLITS

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset
    from deepaccident_devkit.evaluation.results import Results
    from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
    from deepaccident_devkit.explore.explorer import Explorer
    from deepaccident_devkit.explore.models import Model

_USUAL_HORIZON: Final = 2.0
_USUAL_VERSION: Final = "v1"


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluateCommand:
    """How results are evaluated.

    Attributes:
        text: the command, for a shell.
        note: what the results lack of the samples, or have besides; empty if they have just these.
    """

    text: str
    note: str


def command_job(explorer: Explorer, model: Model, results: Results) -> Job:
    """The work that gives the `EvaluateCommand` of results: it looks for the samples that they were made for."""

    def work() -> EvaluateCommand:
        return evaluate_command(explorer.dataset, results, model.setup, f"{model.name}_bundle")

    return explorer.jobs.ask(f"command {model.name}", f"how {model.name} is evaluated", work)


def evaluate_command(dataset: Dataset, results: Results, setup: EvaluationSetup, out: str) -> EvaluateCommand:
    """The command that makes a bundle of results.

    Args:
        dataset: the release.
        results: of the task.
        setup: task and rules.
        out: the bundle's folder.

    Raises:
        NotAvailableError: the release has no labelled samples of the split that most of the results are of.
    """
    selection = default_selection(setup, split_of(dataset, results))
    found = coverage(dataset, results.tokens, selection)
    if found.guess is not None:
        selection = found.guess
        found = coverage(dataset, results.tokens, selection)
    words = ["deepaccident", "evaluate", setup.task, str(dataset.dataroot)]
    words += ["--version", dataset.version] if dataset.version != _USUAL_VERSION else []
    words += ["--results", str(results.path), *_selecting(setup, selection), "--protocol", setup.protocol]
    words += ["--allow-partial"] * (not found.is_complete) + ["--out", out]
    note = "" if found.is_complete else replace(found, guess=None).to_text()
    return EvaluateCommand(text=shlex.join(words), note=note)


def split_of(dataset: Dataset, results: Results) -> str:
    """The split of most of the scenarios that results tell of; `val` if they are of none."""
    scenarios = {token.rsplit("/", 2)[0] for token in results.tokens}
    splits = Counter(each["split"] for each in dataset.scenario if each["token"] in scenarios)
    known = {name: count for name, count in splits.items() if name in SPLITS}
    return max(known, key=lambda name: known[name], default="val")


def _selecting(setup: EvaluationSetup, selection: SampleSelection) -> list[str]:
    """The options that choose the samples, without those that are the default."""
    usual = default_selection(setup, selection.split, samples=selection.samples)
    options: dict[str, Any] = {"split": selection.split}
    if selection.samples != "evaluate":
        options["samples"] = selection.samples
    if selection.scope != usual.scope:
        options["scope"] = selection.scope
    if selection.agents is not None:
        options["agents"] = ",".join(selection.agents)
    horizon = selection.horizon if selection.samples == "evaluate" else setup.horizon
    if abs(horizon - _USUAL_HORIZON) > FRAME_PERIOD / 2:
        options["horizon"] = f"{horizon:g}"
    return [word for name, value in options.items() for word in (f"--{name}", value)]
