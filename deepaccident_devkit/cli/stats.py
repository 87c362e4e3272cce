"""`deepaccident stats`: the paper's statistics of a release, as text, tables and figures."""

from typing import Any, get_args

import click

from deepaccident_devkit.cli.options import (
    WordChoice,
    engine_of,
    release_parameters,
    say_report,
    where_parameter,
    write_report,
)
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.files import writable_folder
from deepaccident_devkit.render.statistics import PictureFormat, save_statistics
from deepaccident_devkit.statistics import dataset_statistics


@click.command()
@release_parameters
@where_parameter
@click.option("--interactions", is_flag=True, help="Also count how soon moving pairs would collide.")
@click.option(
    "--out", type=click.Path(), help="Folder to write statistics.json, one CSV file per table, and figures into."
)
@click.option(
    "--format",
    "formats",
    type=WordChoice(get_args(PictureFormat)),
    multiple=True,
    help="With --out: format of the figures; you can repeat this option.  [default: both]",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object, for programs.")
def stats(
    where: tuple[str, ...],
    interactions: bool,
    out: str | None,
    formats: tuple[PictureFormat, ...],
    as_json: bool,
    **release: Any,
) -> None:
    """Print the paper's statistics of the release in DATAROOT by split: scenarios and their ends, actors, boxes.

    With --out, also write them into files. Earlier statistics in that folder are replaced.
    """
    if formats and out is None:
        raise click.UsageError("--format is for figures; give --out FOLDER too")
    dataset = DeepAccident(**release)
    chosen = dataset.find(*where) if where else None
    if out is not None and chosen == []:
        raise click.UsageError("no scenario matches --where, so there is nothing to write; change it or omit --out")
    folder = None if out is None else writable_folder(out)
    statistics = dataset_statistics(dataset, chosen, interactions=interactions, **engine_of(release))
    written = write_report(statistics, folder, "statistics.json")
    if folder:
        written += save_statistics(statistics, folder, formats or get_args(PictureFormat))
    say_report(statistics, written, folder, as_json=as_json)
