"""`deepaccident study`: run a recipe."""

from pathlib import Path
from typing import Any

import click

from deepaccident_devkit.cli.options import (
    PATH,
    engine_of,
    engine_parameters,
    figure_style_parameter,
    refuse_unused,
    use_threads_sparingly,
)
from deepaccident_devkit.cli.verbs import verb
from deepaccident_devkit.plugins.study import read_recipe, run_study
from deepaccident_devkit.plugins.study.page import PAGE_FILE
from deepaccident_devkit.support.parallel import workers_kept

_EXAMPLES = """\b
Examples:
  deepaccident study v2x studies --smoke
  deepaccident study agents studies
  deepaccident study mine.yaml studies --workers 8"""


@verb(epilog=_EXAMPLES)
@click.argument("recipe")
@click.argument("out", type=PATH)
@click.option(
    "--smoke",
    is_flag=True,
    help="Run the recipe's tiny version, of minutes; its numbers say nothing.",
)
@engine_parameters
@click.option(
    "--device",
    default="auto",
    show_default=True,
    help="cpu, cuda, …; auto takes a GPU where there is one.",
)
@figure_style_parameter
@workers_kept()
def study(recipe: str, out: Path, smoke: bool, device: str, **options: Any) -> None:
    """Train and compare what RECIPE says, and write tables, figures and a page into OUT/NAME.

    RECIPE is a YAML file, or the name of one that the devkit ships; docs/studies.md explains it. If
    the command is interrupted or killed, the same command goes on. Studies with the same OUT share
    releases, weights and rows.
    """
    use_threads_sparingly()
    study_recipe = read_recipe(recipe, smoke=smoke)
    if not study_recipe.weights:
        refuse_unused("with a recipe without weights", "device")
    report = run_study(study_recipe, out, device=device, progress=True, **engine_of(options))
    folder = out / study_recipe.name
    click.echo(report.to_text())
    click.echo(f"written: {folder}; open {folder / PAGE_FILE} in a browser")
