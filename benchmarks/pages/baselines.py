"""Write what the baselines foresee, by the agents that cooperate; with the functions of the
commands.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from benchmarks.measure import temporary_folder
from benchmarks.pages.marks import put, table
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation.breakdowns import Group
from deepaccident_devkit.evaluation.intervals import numbers_of
from deepaccident_devkit.evaluation.runs import (
    SampleSelection,
    compare_bundles,
    evaluate_results,
    save_run,
)
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.plugins.baselines import Baseline, predict_results
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.v2x import AGENT_CONFIGS

RELEASES = {
    "ordinary": SynthConfig(scenarios=24, frames=40, seed=12, sensors=False, traffic="v1"),
    "designed": SynthConfig(scenarios=24, frames=40, seed=12, sensors=False, designed=True),
    "hidden": SynthConfig(scenarios=24, frames=40, seed=12, sensors=False, view="hidden"),
}
SELECTION = SampleSelection(split="train", agents=("ego_vehicle",))
EVALUATIONS = {
    "motion": ("motion", EvaluationSetup(task="motion", protocol="paper")),
    "maps": ("motion", EvaluationSetup(task="accident", protocol="paper")),
    "boxes": ("accident", EvaluationSetup(task="accident", protocol="boxes")),
    "detection": ("detection", EvaluationSetup(task="detection", protocol="paper")),
}
"""Name → kind of predictions, and rules by which they are evaluated."""
NUMBERS = {
    "IoU, 30 m × 30 m": ("motion", "ranges/30x30/iou"),
    "IoU, 100 m × 100 m": ("motion", "ranges/100x100/iou"),
    "VPQ": ("motion", "ranges/100x100/pq"),
    "APA": ("maps", "apa"),
    "APA boxes": ("boxes", "apa"),
    "mAP": ("detection", "mean_average_precision"),
}
"""Name of a number → its evaluation and its path in the result."""
TABLE_NUMBERS = ("VPQ", "APA", "mAP")
BASE = "single"
"""The agents that the others are compared with."""


@dataclass(frozen=True)
class Evaluated:
    """A baseline's evaluations: the folder of their bundles, and their results for all samples."""

    folder: Path
    groups: Mapping[str, Group]

    def text(self, name: str) -> str:
        """Return a number as text."""
        evaluation, path = NUMBERS[name]
        digits = 2 if path == "apa" else 1
        return f"{numbers_of(self.groups[evaluation].result)[path]:.{digits}f}"


Views = Mapping[str, Mapping[str, Evaluated]]
"""Evaluations by view and by agents."""
Decided = Mapping[tuple[str, str], Mapping[str, str]]
"""Number and view → agents whose difference from the base is decided → `more` or `less`."""


def main(_release: Path | None = None) -> None:
    """Write all tables."""
    with temporary_folder() as folder:
        views = {view: evaluate_view(folder / view, config) for view, config in RELEASES.items()}
        put("size", size_text(views))
        decided = decided_differences(views, BASE)
        put("configurations", numbers_table(views, TABLE_NUMBERS, decided))
        put("decided", decided_text(decided))


def evaluate_view(folder: Path, config: SynthConfig) -> dict[str, Evaluated]:
    """Return the evaluations of all sets of agents in a release, which is made if need be."""
    root = folder / "release"
    if not root.exists():
        make_release(root, config)
    dataset = DeepAccident("v1", root, verbose=False)
    return {
        agents: evaluate_baseline(dataset, Baseline(agents=agents), folder / agents)
        for agents in AGENT_CONFIGS
    }


def evaluate_baseline(dataset: DeepAccident, baseline: Baseline, folder: Path) -> Evaluated:
    """Predict, evaluate, and write bundles below a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    groups = {}
    for name, (kind, setup) in EVALUATIONS.items():
        tokens = SELECTION.tokens(dataset)
        path = predict_results(dataset, kind, tokens, folder / f"{kind}_results", baseline)
        run = evaluate_results(dataset, path, setup, SELECTION).broken_down(("all",))
        save_run(run, folder / name)
        groups[name] = run.breakdowns[0].groups[0]
    return Evaluated(folder, groups)


def size_text(views: Views) -> str:
    """Return how many samples and accidents the table is made from."""
    sizes = {}
    for view, evaluations in views.items():
        group = evaluations[BASE].groups["motion"]
        sizes[view] = (
            f"{group.samples} samples of {group.scenarios} accidents ({group.clusters} clusters)"
        )
    if len(set(sizes.values())) == 1:
        return f"Each view has {sizes.popitem()[1]}."
    return " ".join(f"The {view} view has {size}." for view, size in sizes.items())


def numbers_table(views: Views, names: Iterable[str], decided: Decided) -> str:
    """Return numbers of all views, a column for each number and view, a row for each set of
    agents; a number is bold if its difference from the base is decided.
    """
    columns = [(name, view) for name in names for view in views]
    rows = []
    for agents in AGENT_CONFIGS:
        row = [f"`{agents}`"]
        for name, view in columns:
            text = views[view][agents].text(name)
            row.append(f"**{text}**" if agents in decided[name, view] else text)
        rows.append(row)
    return table(["agents", *map(", ".join, columns)], rows)


def decided_differences(views: Views, base: str) -> Decided:
    """Return for which agents the interval of the difference from the base does not contain 0."""
    decided: dict[tuple[str, str], dict[str, str]] = {}
    for view, evaluations in views.items():
        for name in NUMBERS:
            decided[name, view] = {}
        for agents, evaluated in evaluations.items():
            if agents == base:
                continue
            for name, (low, high) in compare(evaluations[base], evaluated).items():
                if low > 0:
                    decided[name, view][agents] = "more"
                elif high < 0:
                    decided[name, view][agents] = "less"
    return decided


def decided_text(decided: Decided) -> str:
    """Return the decided differences of the numbers that the table leaves out."""
    lines = []
    for (name, view), side_by_agents in decided.items():
        if name in TABLE_NUMBERS:
            continue
        for side in ("more", "less"):
            members = [f"`{agents}`" for agents, word in side_by_agents.items() if word == side]
            if members:
                lines.append(f"- {name}, {view} view: {side} with {', '.join(members)}")
    return "\n".join(lines)


def compare(base: Evaluated, other: Evaluated) -> dict[str, tuple[float, float]]:
    """Return the intervals of the differences of all numbers; (0, 0) where there is none."""
    comparisons = {}
    for evaluation in EVALUATIONS:
        comparison = compare_bundles(base.folder / evaluation, other.folder / evaluation)
        for difference in comparison.numbers:
            comparisons[evaluation, difference.number] = difference
    intervals = {}
    for name, key in NUMBERS.items():
        difference = comparisons[key]
        intervals[name] = (difference.low or 0.0, difference.high or 0.0)
    return intervals
