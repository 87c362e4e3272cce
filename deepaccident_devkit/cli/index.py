"""`deepaccident index`: make or refresh the index ahead of time, look at it, remove it."""

from pathlib import Path

import click

from deepaccident_devkit.cli.groups import VerbGroup
from deepaccident_devkit.cli.options import release_parameters
from deepaccident_devkit.release import find_release
from deepaccident_devkit.tables import Tables, clear_index, index_report, open_index
from deepaccident_devkit.taxonomy import VERSIONS, OnError


@click.group(cls=VerbGroup)
@release_parameters
@click.option("--check", is_flag=True, help="Compare every label, calib and meta file, not only folders' times.")
def index(
    dataroot: Path, version: str, index_dir: Path | None, workers: int | None, on_error: OnError, check: bool
) -> None:
    """Make the index of the release under DATAROOT, or bring it up to date, and say where it lies."""
    made = open_index(
        find_release(dataroot, version),
        index_dir=index_dir,
        workers=workers,
        on_error=on_error,
        progress=True,
        check_files=check,
    )
    tables = Tables(made.tables_folder)
    counts = ", ".join(f"{len(tables.table(name)):,} {name}s" for name in ("scenario", "sample", "annotation"))
    click.echo(f"{made.tables_folder}: {counts}")


@index.command(short_help="Where it lies, what it holds, whether it is up to date.")
@click.argument("dataroot", type=click.Path(path_type=Path))
@click.option("--version", type=click.Choice(VERSIONS), help="Of which release.  [default: of every one]")
@click.option("--index-dir", type=click.Path(path_type=Path), help="Where to look instead.")
@click.option("--check", is_flag=True, help="Compare every label, calib and meta file, not only folders' times.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object, for programs.")
def info(dataroot: Path, version: str | None, index_dir: Path | None, check: bool, as_json: bool) -> None:
    """Print where the indexes of DATAROOT lie, what they hold and whether they are up to date; change nothing."""
    report = index_report(dataroot, version=version, index_dir=index_dir, check_files=check)
    click.echo(report.to_json() if as_json else report.to_text())


@index.command(short_help="Remove it.")
@click.argument("dataroot", type=click.Path(path_type=Path))
@click.option("--version", type=click.Choice(VERSIONS), default="v1", show_default=True, help="Of which release.")
@click.option("--index-dir", type=click.Path(path_type=Path), help="Where it lies, if not in the usual places.")
def clear(dataroot: Path, version: str, index_dir: Path | None) -> None:
    """Remove the index of DATAROOT, in its own folder and in your cache; the release itself is not touched."""
    cleared = clear_index(dataroot, version=version, index_dir=index_dir)
    click.echo("\n".join(removed.to_text() for removed in cleared) or f"{dataroot}: no index to remove")
