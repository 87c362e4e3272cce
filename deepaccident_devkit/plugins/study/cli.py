"""`deepaccident study`: run a recipe."""

from pathlib import Path
from typing import Any

import click

from deepaccident_devkit.cli.options import (
    PATH,
    engine_options,
    engine_parameters,
    figure_style_parameter,
    refuse_unused,
    use_threads_sparingly,
)
from deepaccident_devkit.cli.verbs import verb
from deepaccident_devkit.plugins.study import read_recipe, run_study
from deepaccident_devkit.plugins.study.page import PAGE_FILE
from deepaccident_devkit.support.parallel import keep_workers

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
    help="Run the tiny version of the recipe, which takes minutes but gives meaningless numbers.",
)
@engine_parameters
@click.option(
    "--device",
    default="auto",
    show_default=True,
    help="Device of the models: cpu, cuda, …; auto uses a GPU if there is one.",
)
@figure_style_parameter
@keep_workers()
def study(recipe: str, out: Path, smoke: bool, device: str, **options: Any) -> None:
    """Train and compare models as RECIPE says, and write tables, figures and a page into OUT/NAME.

    RECIPE is a YAML file, or the name of a recipe of the devkit; docs/studies.md explains both. If
    a run is interrupted, the same command continues it. Studies with the same OUT share releases,
    weights and rows.
    """
    use_threads_sparingly()
    study_recipe = read_recipe(recipe, smoke=smoke)
    if not study_recipe.weights:
        refuse_unused("with a recipe that trains no model", "device")
    report = run_study(study_recipe, out, device=device, progress=True, **engine_options(options))
    folder = out / study_recipe.name
    click.echo(report.to_text())
    click.echo(f"wrote {folder}; open {folder / PAGE_FILE} in a browser")
