"""`deepaccident index`: make or refresh the index ahead of time."""

from pathlib import Path

import click

from deepaccident_devkit.cli.options import release_parameters
from deepaccident_devkit.release import find_release
from deepaccident_devkit.tables import Tables, open_index
from deepaccident_devkit.taxonomy import OnError


@click.command()
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
