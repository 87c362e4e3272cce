"""Count how much of the package one sample enters, from results file to summary: `python -m
benchmarks.entered [--list]`.

A module or function is entered if one of its calls is traced in the second evaluation of one sample
of a synthetic release (`evaluate_results(…).summary()`); the first evaluation opens the tables and
fills the caches. Comprehensions, lambdas and what dataclasses generate belong to the function or
class that they stand in.
"""

import sys
from collections.abc import Callable
from types import FrameType
from typing import Any

import click

from benchmarks.measure import temporary_folder
from benchmarks.releases import labels_only_release
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation.runs import default_selection, evaluate_results
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.plugins.baselines import predict_results

PACKAGE, EVALUATION = "deepaccident_devkit", "deepaccident_devkit.evaluation"
EVALUATIONS = (
    ("motion", "motion", "released"),
    ("motion", "accident", "released"),
    ("accident", "accident", "boxes"),
    ("detection", "detection", "released"),
    ("accident", "warning", "clean"),
)
"""Kind of results, task, and protocol of each evaluation."""
FRAMES = 20


def trace_calls(work: Callable[[], object]) -> dict[str, list[str]]:
    """Return the functions that a call of `work` enters by module, in the order of their first
    calls.
    """
    functions_by_module: dict[str, dict[str, None]] = {}

    def note(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        module = frame.f_globals.get("__name__", "")
        if event == "call" and module.split(".")[0] == PACKAGE:
            functions = functions_by_module.setdefault(module, {})
            if not (code.co_name.startswith("<") or code.co_filename.startswith("<")):
                functions[getattr(code, "co_qualname", code.co_name)] = None

    sys.setprofile(note)
    try:
        work()
    finally:
        sys.setprofile(None)
    return {module: list(functions) for module, functions in functions_by_module.items()}


def trace_evaluations() -> dict[str, dict[str, list[str]]]:
    """Return what one sample enters, by task and protocol."""
    calls = {}
    with temporary_folder("entered") as root:
        release = labels_only_release(root, scenarios=2, frames=FRAMES)
        dataset = DeepAccident(dataroot=release, verbose=False)
        accident = dataset.find(collision=True)[0]["token"]
        split = root / "split.txt"
        split.write_text(accident.replace("/", " ") + "\n")
        for kind, task, protocol in EVALUATIONS:
            setup = EvaluationSetup(task=task, protocol=protocol)
            selection = default_selection(
                setup, split, samples="evaluate", scope="all", agents=("ego_vehicle",)
            )
            results = root / f"{kind}_{task}{'' if kind == 'motion' else '.json'}"
            tokens = selection.tokens(dataset)[:1]
            predict_results(dataset, kind, tokens, results, workers=1, progress=False)

            def evaluate(setup=setup, selection=selection, results=results):
                run = evaluate_results(
                    dataset,
                    results,
                    setup,
                    selection,
                    workers=1,
                    progress=False,
                    allow_partial=True,
                )
                return run.summary()

            evaluate()
            calls[f"{task}, {protocol}"] = trace_calls(evaluate)
    return calls


@click.command()
@click.option(
    "--list",
    "listed",
    is_flag=True,
    help="Name modules and functions, in the order of their first calls.",
)
def main(listed: bool) -> None:  # noqa: FBT001 - click's flag
    """Print how many modules and functions of the package one sample enters, for each task."""
    click.echo(
        f"{'task, protocol':<22}{'modules':>9}{'of evaluation':>15}{'functions':>11}{'of evaluation':>15}"  # noqa: E501
    )
    for name, modules in trace_evaluations().items():
        num_functions = sum(map(len, modules.values()))
        own = [functions for module, functions in modules.items() if module.startswith(EVALUATION)]
        num_own = sum(map(len, own))
        click.echo(f"{name:<22}{len(modules):>9}{len(own):>15}{num_functions:>11}{num_own:>15}")
        if listed:
            for module, functions in modules.items():
                click.echo(f"    {module.removeprefix(PACKAGE + '.')}: {', '.join(functions)}")


if __name__ == "__main__":
    main()
