"""`python -m benchmarks [NAME…] [--json]`: run all benchmarks, or only the named ones."""

import importlib
import json

import click

from benchmarks.measure import table

NAMES = (
    "parsing",
    "indexing",
    "scale",
    "validation",
    "geometry",
    "labels",
    "evaluation",
    "coverage",
    "safety",
    "render",
    "synth",
    "export",
    "clips",
    "loader",
    "engine",
    "stores",
    "explore",
    "beside",
)


@click.command()
@click.argument("names", nargs=-1, type=click.Choice(NAMES), metavar="[NAME…]")
@click.option(
    "--json", "as_json", is_flag=True, help="One flat JSON object (name: number) and nothing else."
)
def main(names: tuple[str, ...], as_json: bool) -> None:  # noqa: FBT001 - click's flag
    """Measure the devkit; NAME is one of parsing, indexing, scale, validation, geometry, labels,
    evaluation, coverage, safety, render, synth, export, clips, loader, engine, stores, explore,
    beside.
    """
    all_figures = []
    for name in names or NAMES:
        figures = importlib.import_module(f"benchmarks.{name}").measure()
        all_figures += figures
        if not as_json:
            click.echo(f"{name}\n{table(figures)}\n")
    if as_json:
        click.echo(json.dumps({figure.name: figure.value for figure in all_figures}))


if __name__ == "__main__":
    main()
