"""`deepaccident info`: contents of a release, its statistics, and fields to find scenarios by."""

import json
import sys
from pathlib import Path
from typing import Any

import click

from deepaccident_devkit.cli.options import (
    engine_of,
    json_parameter,
    open_release,
    refuse_unused,
    release_parameters,
    say_report,
    where_parameter,
    write_report,
)
from deepaccident_devkit.cli.verbs import verb
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.statistics.overview import overview, scenario_lines


def _list_fields(context: click.Context, _parameter: click.Parameter, is_set: bool) -> None:
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
    callback=_list_fields,
    help="List what --where takes: fields, their values and what they mean; without DATAROOT.",
)
@click.option("--statistics", is_flag=True, help="Print the paper's statistics by split instead.")
@click.option(
    "--interactions",
    is_flag=True,
    help="With --statistics: also count how soon moving pairs would collide.",
)
@click.option(
    "--out",
    type=click.Path(),
    help="With --statistics: folder to write statistics.json, one CSV file per table, and figures "
    "into; earlier ones there are replaced.",
)
@click.option(
    "--facts",
    is_flag=True,
    help="Compare the release with what others measured of the real one instead; broken scenarios "
    "are left out, and counted (docs/validation.md).",
)
@click.option(
    "--croissant",
    is_flag=True,
    help="Print the release's data card instead: Croissant metadata, as JSON-LD (docs/format.md).",
)
@click.option(
    "--licence",
    metavar="TEXT",
    help="With --croissant: the licence that you have the data under, or its URL.",
)
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
    """Print what the release in DATAROOT holds: tables, splits, agents, sensors, attributes.

    With --where, list the scenarios that match all filters instead; with --json, their records.
    """
    if croissant:
        from deepaccident_devkit.validation import data_card

        refuse_unused(
            "with --croissant", "where", "statistics", "interactions", "out", "facts", "as_json"
        )
        card = data_card(open_release(**release), licence=licence)
        click.echo(json.dumps(card, indent=2, ensure_ascii=False))
        return
    refuse_unused("without --croissant", "licence")
    if facts or not statistics:
        refuse_unused(
            "with --facts" if facts else "without --statistics",
            "interactions",
            "out",
            *(["statistics"] if facts else []),
        )
    dataset = open_release(**(release | {"on_error": "skip"} if facts else release))
    scenarios = dataset.find(*where) if where else None
    if facts:
        from deepaccident_devkit.statistics import release_facts

        report = release_facts(dataset, scenarios, **engine_of(release))
        say_report(report, [], None, as_json=as_json)
        sys.exit(report.exit_status)
    if scenarios == [] and out is not None:
        raise click.UsageError(
            "no scenario matches --where, so there is nothing to write; change it or omit --out"
        )
    if statistics:
        _statistics(
            dataset,
            scenarios,
            out,
            interactions=interactions,
            as_json=as_json,
            **engine_of(release),
        )
        return
    if scenarios is None:
        summary = overview(dataset)
        click.echo(summary.to_json() if as_json else summary.to_text())
    elif as_json:
        click.echo(json.dumps(scenarios, indent=2, ensure_ascii=False))
    elif scenarios:
        click.echo(f"{len(scenarios)} of {len(dataset.scenario)} scenarios match")
        click.echo("\n".join(scenario_lines(scenarios)))
    else:
        click.echo(
            f"no scenario matches {' and '.join(where)}; deepaccident info --fields lists what "
            "can be asked for"
        )


def _statistics(
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

    folder = None if out is None else writable_folder(out)
    statistics = dataset_statistics(dataset, scenarios, **engine)
    written: list[Path] = write_report(statistics, folder, "statistics.json")
    if folder:
        written += save_statistics(statistics, folder)
    say_report(statistics, written, folder, as_json=as_json)
