"""`deepaccident info`: what a release holds."""

from typing import Any

import click

from deepaccident_devkit.cli.options import release_parameters, where_parameter
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.overview import overview


@click.command()
@release_parameters
@where_parameter
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object, for programs.")
def info(where: tuple[str, ...], as_json: bool, **release: Any) -> None:
    """Print what the release in DATAROOT holds: tables, splits, agents, sensors, attributes."""
    dataset = DeepAccident(**release)
    summary = overview(dataset, dataset.find(*where) if where else None)
    click.echo(summary.to_json() if as_json else summary.to_text())
