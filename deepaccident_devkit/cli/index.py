"""`deepaccident index` and `deepaccident check index`: make, update, check or remove an index."""

from typing import Any

import click

from deepaccident_devkit.cli.options import engine_options, refuse_unused, release_parameters
from deepaccident_devkit.cli.verbs import verb
from deepaccident_devkit.release import find_release
from deepaccident_devkit.release.store import Dataroot, open_dataroot
from deepaccident_devkit.support.text import counted
from deepaccident_devkit.tables import Tables, clear_index, open_index
from deepaccident_devkit.taxonomy import OnError


@verb()
@release_parameters
@click.option(
    "--clear",
    is_flag=True,
    help="Remove the index instead, from its own folder and from your cache. The release itself "
    "stays unchanged.",
)
def index(dataroot: Dataroot, version: str, on_error: OnError, clear: bool, **options: Any) -> None:
    """Create or update the index of the release in DATAROOT, and print where it is."""
    if clear:
        refuse_unused("with --clear, which creates no index", "workers", "on_error")
        cleared = clear_index(dataroot, version=version, index_dir=options["index_dir"])
        lines = [f"removed {folder}" for folder in cleared]
        click.echo("\n".join(lines) or f"{dataroot}: no index to remove")
        return
    _update_index(dataroot, version, on_error, check_files=False, **options)


@verb("index")
@release_parameters
def check_index(dataroot: Dataroot, version: str, on_error: OnError, **options: Any) -> None:
    """Compare the index of the release in DATAROOT with the content of its files, and repair it.

    The command reads all label, calib and meta files. `deepaccident index` compares only their
    times.
    """
    tables = _update_index(dataroot, version, on_error, check_files=True, **options)
    scenarios = counted(len(tables.table("scenario")), "scenario")
    click.echo(f"compared the tables, and the label, calib and meta files of {scenarios}")


def _update_index(
    dataroot: Dataroot, version: str, on_error: OnError, *, check_files: bool, **options: Any
) -> Tables:
    """Make or update an index, print where it is, and return its tables."""
    root = open_dataroot(
        dataroot,
        options["index_dir"],
        refresh=True,
        on_error=on_error,
        progress=True,
        **engine_options(options),
    )
    index = open_index(
        find_release(root, version),
        on_error=on_error,
        check_times=True,
        check_files=check_files,
        progress=True,
        **options,
    )
    tables = Tables(index.tables_folder)
    counts = ", ".join(
        f"{len(tables.table(name)):,} {name}s" for name in ("scenario", "sample", "annotation")
    )
    click.echo(f"{index.tables_folder}: {counts}")
    return tables
