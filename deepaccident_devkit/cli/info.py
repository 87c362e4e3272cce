"""`deepaccident info`: contents of a release, its statistics, and fields to find scenarios by."""

import json
import sys
from pathlib import Path
from typing import Any

import click

from deepaccident_devkit.cli.options import (
    engine_options,
    figure_style_parameter,
    json_parameter,
    open_release,
    print_report,
    print_written_report,
    refuse_unused,
    release_parameters,
    where_parameter,
    write_report,
)
from deepaccident_devkit.cli.verbs import verb
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.statistics.overview import overview, scenario_lines
from deepaccident_devkit.support.text import counted

# Parameters that need --statistics.
_STATISTICS_PARAMETERS = ("interactions", "out", "style", "no_title")


def _print_fields(context: click.Context, _parameter: click.Parameter, is_set: bool) -> None:
    if is_set:
        from deepaccident_devkit.selection.fields import fields_text

        click.echo(fields_text())
        context.exit()


@verb()
@release_parameters
@where_parameter
@click.option(
    "--fields",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_print_fields,
    help="List the fields that --where takes, with their values and meanings; needs no DATAROOT.",
)
@click.option("--statistics", is_flag=True, help="Print the paper's statistics of each split.")
@click.option(
    "--interactions",
    is_flag=True,
    help="With --statistics: also count how soon moving pairs would collide.",
)
@click.option(
    "--out",
    type=click.Path(),
    help="With --statistics: write statistics.json, one CSV file per table, and figures into this "
    "folder. Existing files are replaced.",
)
@click.option(
    "--facts",
    is_flag=True,
    help="Compare the release with published measurements of the real one. Broken scenarios are "
    "excluded and counted (docs/validation.md).",
)
@click.option(
    "--croissant",
    is_flag=True,
    help="Print the release's data card: Croissant metadata as JSON-LD (docs/format.md).",
)
@click.option(
    "--licence",
    metavar="TEXT",
    help="With --croissant: the licence under which you have the data, or its URL.",
)
@figure_style_parameter
@json_parameter
def info(
    where: tuple[str, ...],
    statistics: bool,
    interactions: bool,
    out: str | None,
    facts: bool,
    croissant: bool,
    licence: str | None,
    as_json: bool,
    **release: Any,
) -> None:
    """Print what the release in DATAROOT contains: tables, splits, agents, sensors, attributes.

    With --where, list only the scenarios that match all filters; with --json, print their records.
    """
    if croissant:
        from deepaccident_devkit.validation import data_card

        unused = ("where", "statistics", "facts", "as_json", *_STATISTICS_PARAMETERS)
        refuse_unused("with --croissant", *unused)
        card = data_card(open_release(**release), licence=licence)
        click.echo(json.dumps(card, indent=2, ensure_ascii=False))
        return
    refuse_unused("without --croissant", "licence")
    if facts:
        refuse_unused("with --facts", "statistics", *_STATISTICS_PARAMETERS)
        release["on_error"] = "skip"
    elif not statistics:
        refuse_unused("without --statistics", *_STATISTICS_PARAMETERS)
    dataset = open_release(**release)
    scenarios = dataset.find(*where) if where else None
    if facts:
        from deepaccident_devkit.statistics import release_facts

        report = release_facts(dataset, scenarios, **engine_options(release))
        print_report(report, as_json=as_json)
        sys.exit(report.exit_status)
    if scenarios == [] and out is not None:
        raise click.UsageError(
            "no scenario matches --where, so there is nothing to write; change it or omit --out"
        )
    if statistics:
        _print_statistics(
            dataset,
            scenarios,
            out,
            interactions=interactions,
            as_json=as_json,
            **engine_options(release),
        )
        return
    if scenarios is None:
        summary = overview(dataset)
        print_report(summary, as_json=as_json)
    elif as_json:
        click.echo(json.dumps(scenarios, indent=2, ensure_ascii=False))
    elif scenarios:
        click.echo(f"{len(scenarios)} of {counted(len(dataset.scenario), 'scenario')} match")
        click.echo("\n".join(scenario_lines(scenarios)))
    else:
        click.echo(
            f"no scenario matches {' and '.join(where)}; deepaccident info --fields lists the "
            "possible filters"
        )


def _print_statistics(
    dataset: DeepAccident,
    scenarios: list[Any] | None,
    out: str | None,
    *,
    as_json: bool,
    **engine: Any,
) -> None:
    from deepaccident_devkit.render.statistics import save_statistics  # it imports matplotlib
    from deepaccident_devkit.statistics import dataset_statistics
    from deepaccident_devkit.support.files import writable_folder

    if out is None:
        refuse_unused("without --out", "style", "no_title")
    folder = None if out is None else writable_folder(out)
    statistics = dataset_statistics(dataset, scenarios, **engine)
    written: list[Path] = write_report(statistics, folder, "statistics.json")
    if folder:
        written += save_statistics(statistics, folder)
    print_written_report(statistics, written, folder, as_json=as_json)
