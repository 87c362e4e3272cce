"""What the baselines foresee, by who cooperates; by the functions of the commands."""

import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

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
"""Name → the predictions that are evaluated, and by which rules."""
NUMBERS = {
    "IoU 30x30": ("motion", "ranges/30x30/iou"),
    "IoU 100x100": ("motion", "ranges/100x100/iou"),
    "VPQ 100x100": ("motion", "ranges/100x100/pq"),
    "APA": ("maps", "apa"),
    "APA boxes": ("boxes", "apa"),
    "mAP": ("detection", "mean_average_precision"),
}
"""Name → its evaluation and its path in the result."""
SHOWN = ("VPQ 100x100", "APA", "mAP")


@dataclass(frozen=True)
class Evaluated:
    """A baseline's evaluations: the bundles, and of each the result of all samples with its
    intervals.
    """

    folder: Path
    groups: Mapping[str, Group]

    def text(self, name: str) -> str:
        """A number with its interval, if it has one."""
        evaluation, path = NUMBERS[name]
        ends = self.groups[evaluation].intervals.get(path)
        digits = 2 if path == "apa" else 1
        sure = "" if ends is None else f" [{ends[0]:.{digits}f}, {ends[1]:.{digits}f}]"
        return f"{numbers_of(self.groups[evaluation].result)[path]:.{digits}f}{sure}"


Views = Mapping[str, Mapping[str, Evaluated]]
"""View → agents → evaluations."""


def main(_release: Path | None = None) -> None:
    """Write all tables."""
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        views = {name: evaluated_view(folder / name, config) for name, config in RELEASES.items()}
        put("size", size_text(views))
        put("configurations", numbers_table(views, SHOWN, list(AGENT_CONFIGS)))
        put(
            "decided",
            decided_table(views, {name: "single" for name in AGENT_CONFIGS if name != "single"}),
        )


def evaluated_view(folder: Path, config: SynthConfig) -> dict[str, Evaluated]:
    """What all sets of agents foresee in a release."""
    root = folder / "release"
    if not root.exists():
        make_release(root, config)
    dataset = DeepAccident("v1", root, verbose=False)
    baselines = {name: Baseline(agents=name) for name in AGENT_CONFIGS}
    return {
        name: evaluated(dataset, baseline, folder / name) for name, baseline in baselines.items()
    }


def evaluated(dataset: DeepAccident, baseline: Baseline, folder: Path) -> Evaluated:
    """Predict, evaluate, and write bundles below a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    groups = {}
    for name, (task, setup) in EVALUATIONS.items():
        path = predict_results(
            dataset, task, SELECTION.tokens(dataset), folder / f"{task}_results", baseline
        )
        run = evaluate_results(dataset, path, setup, SELECTION).broken_down(("all",))
        save_run(run, folder / name)
        groups[name] = run.breakdowns[0].groups[0]
    return Evaluated(folder, groups)


def size_text(views: Views) -> str:
    """How much the tables are of."""
    groups = {view: found["single"].groups["motion"] for view, found in views.items()}
    parts = [
        f"{group.samples} samples of {group.scenarios} accidents ({group.clusters} "
        f"clusters) in the {view} view"
        for view, group in groups.items()
    ]
    return f"The tables are of {', '.join(parts[:-1])} and {parts[-1]}."


def numbers_table(views: Views, names: Iterable[str], rows: Iterable[str]) -> str:
    """The views beside each other."""
    shown = [(name, view) for name in names for view in views]
    lines = [[f"`{row}`", *(views[view][row].text(name) for name, view in shown)] for row in rows]
    return table(["agents", *(", ".join(each) for each in shown)], lines)


def decided_table(views: Views, bases: Mapping[str, str]) -> str:
    """Which rows have surely more or less of a number than their base."""
    lines = []
    for view, found in views.items():
        differences = {row: compared(found[base], found[row]) for row, base in bases.items()}
        for name in NUMBERS:
            sides: dict[str, list[str]] = {"more": [], "less": [], "not decided": []}
            for row, ends in differences.items():
                low, high = ends[name]
                sides["more" if low > 0 else "less" if high < 0 else "not decided"].append(
                    f"`{row}`"
                )
            words = [
                "every one" if len(each) == len(bases) else ", ".join(each) or "–"
                for each in sides.values()
            ]
            lines.append([name, view, *words])
    return table(["number", "view", "more", "less", "not decided"], lines)


def compared(base: Evaluated, other: Evaluated) -> dict[str, tuple[float, float]]:
    """The intervals of the differences of all numbers; (0, 0) for none."""
    numbers = {
        name: {
            each.number: each
            for each in compare_bundles(base.folder / name, other.folder / name).numbers
        }
        for name in EVALUATIONS
    }
    found = {name: numbers[evaluation][path] for name, (evaluation, path) in NUMBERS.items()}
    return {name: (each.low or 0.0, each.high or 0.0) for name, each in found.items()}
