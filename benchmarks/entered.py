"""`python -m benchmarks.entered [--list]`: how much of the package one sample enters, from results
file to summary.

What is entered is a module of the package with a traced call, and a function with one, in the
second evaluation of one sample of a synthetic release (`evaluate_results(…).summary()`): the first
opens the tables and fills what is kept. Comprehensions, lambdas and what dataclasses generate
belong to the function or class that they stand in.
"""

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import click

from benchmarks.releases import labels_only_release
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation.runs import default_selection, evaluate_results
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.plugins.baselines import predict_results

PACKAGE, EVALUATION = "deepaccident_devkit", "deepaccident_devkit.evaluation"
WALKS = (
    ("motion", "motion", "released"),
    ("motion", "accident", "released"),
    ("accident", "accident", "boxes"),
    ("detection", "detection", "released"),
    ("accident", "warning", "clean"),
)
"""Kind of results, task, protocol."""
FRAMES = 20


def entered(work: Callable[[], object]) -> dict[str, list[str]]:
    """Module → its functions that a call of `work` enters, in the order of their first calls."""
    found: dict[str, dict[str, None]] = {}

    def note(frame: FrameType, event: str, _: Any) -> None:
        code, module = frame.f_code, frame.f_globals.get("__name__", "")
        if event == "call" and module.split(".")[0] == PACKAGE:
            functions = found.setdefault(module, {})
            if not (code.co_name.startswith("<") or code.co_filename.startswith("<")):
                functions[getattr(code, "co_qualname", code.co_name)] = None

    sys.setprofile(note)
    try:
        work()
    finally:
        sys.setprofile(None)
    return {module: list(functions) for module, functions in found.items()}


def walks() -> dict[str, dict[str, list[str]]]:
    """Task and protocol → what one sample enters."""
    made = {}
    with tempfile.TemporaryDirectory(prefix="deepaccident_entered_") as folder:
        root = Path(folder)
        release = labels_only_release(root, scenarios=2, frames=FRAMES)
        dataset = DeepAccident(dataroot=release, verbose=False)
        split = root / "split.txt"
        split.write_text(dataset.find(collision=True)[0]["token"].replace("/", " ") + "\n")
        listed = {"samples": "evaluate", "scope": "all", "agents": ("ego_vehicle",)}
        for kind, task, protocol in WALKS:
            setup = EvaluationSetup(task=task, protocol=protocol)
            selection = default_selection(setup, split, **listed)
            results = root / f"{kind}_{task}{'' if kind == 'motion' else '.json'}"
            predict_results(
                dataset, kind, selection.tokens(dataset)[:1], results, workers=1, progress=False
            )
            how = {"workers": 1, "progress": False, "allow_partial": True}

            def evaluate(setup=setup, selection=selection, results=results, how=how):
                return evaluate_results(dataset, results, setup, selection, **how).summary()

            evaluate()
            made[f"{task}, {protocol}"] = entered(evaluate)
    return made


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
    for walk, modules in walks().items():
        own = {name: each for name, each in modules.items() if name.startswith(EVALUATION)}
        counts = [sum(map(len, each.values())) for each in (modules, own)]
        click.echo(f"{walk:<22}{len(modules):>9}{len(own):>15}{counts[0]:>11}{counts[1]:>15}")
        for module, functions in modules.items() if listed else ():
            click.echo(f"    {module.removeprefix(PACKAGE + '.')}: {', '.join(functions)}")


if __name__ == "__main__":
    main()
