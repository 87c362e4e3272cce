"""`deepaccident index`: make or refresh the index ahead of time, look at it, remove it."""

from pathlib import Path
from typing import Any

import click

from deepaccident_devkit.cli.groups import VerbGroup
from deepaccident_devkit.cli.options import DATAROOT, WordChoice, engine_of, release_parameters
from deepaccident_devkit.release import find_release
from deepaccident_devkit.release.store import Dataroot, open_dataroot
from deepaccident_devkit.tables import Tables, clear_index, index_report, open_index
from deepaccident_devkit.taxonomy import VERSIONS, OnError

_check = click.option(
    "--check", is_flag=True, help="Compare the content of each label, calib and meta file and of the tables, not times."
)


@click.group(cls=VerbGroup)
@release_parameters
@_check
def index(dataroot: Dataroot, version: str, on_error: OnError, check: bool, **options: Any) -> None:
    """Make or update the index of the release in DATAROOT, and print where it is."""
    engine = {**engine_of(options), "progress": True}
    layout = find_release(open_dataroot(dataroot, options["index_dir"], refresh=True, **engine), version)
    made = open_index(layout, on_error=on_error, check_files=check, progress=True, **options)
    tables = Tables(made.tables_folder)
    counts = ", ".join(f"{len(tables.table(name)):,} {name}s" for name in ("scenario", "sample", "annotation"))
    click.echo(f"{made.tables_folder}: {counts}")


@index.command(short_help="Print where the index is, what it holds, and whether it is up to date.")
@click.argument("dataroot", type=DATAROOT)
@click.option("--version", type=WordChoice(VERSIONS), help="Version of the release.  [default: all]")
@click.option("--index-dir", type=click.Path(path_type=Path), help="Folder to look in, in place of the usual ones.")
@_check
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object, for programs.")
def info(dataroot: Dataroot, version: str | None, index_dir: Path | None, check: bool, as_json: bool) -> None:
    """Print where the indexes of DATAROOT are, what they hold, and whether they are up to date. Nothing is changed."""
    report = index_report(dataroot, version=version, index_dir=index_dir, check_files=check)
    click.echo(report.to_json() if as_json else report.to_text())


@index.command(short_help="Remove the index.")
@click.argument("dataroot", type=DATAROOT)
@click.option("--version", type=WordChoice(VERSIONS), default="v1", show_default=True, help="Version of the release.")
@click.option("--index-dir", type=click.Path(path_type=Path), help="Folder of the index, if it is not a usual one.")
def clear(dataroot: Dataroot, version: str, index_dir: Path | None) -> None:
    """Remove the index of DATAROOT, from its own folder and from your cache. The release itself stays as it is."""
    cleared = clear_index(dataroot, version=version, index_dir=index_dir)
    click.echo("\n".join(removed.to_text() for removed in cleared) or f"{dataroot}: no index to remove")
