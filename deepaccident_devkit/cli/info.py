"""`deepaccident info`: what a release holds, or what is missing of it."""

import sys
from typing import Any

import click

from deepaccident_devkit.cli.options import engine_of, release_parameters, tell_unused, where_parameter
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.overview import Overview, overview
from deepaccident_devkit.validation import Completeness, release_completeness


@click.command()
@release_parameters
@where_parameter
@click.option(
    "--missing",
    is_flag=True,
    help="Print instead which scenarios are whole, and how many files and bytes of each split, agent and sensor are "
    "missing. The command then lists folders; only --where needs the index.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object, for programs.")
def info(where: tuple[str, ...], missing: bool, as_json: bool, **release: Any) -> None:
    """Print what the release in DATAROOT holds: tables, splits, agents, sensors, attributes."""
    summary = _completeness(where, release) if missing else _overview(where, release)
    click.echo(summary.to_json() if as_json else summary.to_text())


def _overview(where: tuple[str, ...], release: dict[str, Any]) -> Overview:
    dataset = DeepAccident(**release)
    return overview(dataset, dataset.find(*where) if where else None)


def _completeness(where: tuple[str, ...], release: dict[str, Any]) -> Completeness:
    scenarios = None
    if where:
        scenarios = [scenario["token"] for scenario in DeepAccident(**release).find(*where)]
    else:  # a broken release, which cannot be indexed, is what --missing is for
        tell_unused("with --missing without --where, as no index is read", "index_dir", "on_error")
    return release_completeness(
        release["dataroot"],
        release["version"],
        scenarios=scenarios,
        progress=sys.stderr.isatty(),
        **engine_of(release),
    )
