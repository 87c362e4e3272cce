"""`deepaccident safety report`: one HTML page of the accidents of a release."""

from typing import Any

import click

from deepaccident_devkit.cli.options import engine_of, release_parameters, where_parameter
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.files import writable_folder
from deepaccident_devkit.render.safety import save_safety_report
from deepaccident_devkit.render.safety.report import REPLAYS
from deepaccident_devkit.safety import safety_report


def _replay_count(context: click.Context, parameter: click.Parameter, value: str) -> int | None:
    """Parse a number, `none` (0) or `all` (None)."""
    word = value.strip().lower()
    if word == "all":
        return None
    if word != "none" and not word.isdecimal():
        raise click.BadParameter(f"expected a number, all or none, found {value!r}", context, parameter)
    return 0 if word == "none" else int(word)


@click.command(short_help="Write one HTML page of all accidents, with links to replays.")
@release_parameters
@where_parameter
@click.option(
    "--out",
    type=click.Path(),
    metavar="DIR",
    required=True,
    help="Folder to write the page into, with its tables, figures and replay pages.",
)
@click.option(
    "--replays",
    default=str(REPLAYS),
    show_default=True,
    callback=_replay_count,
    metavar="N|all|none",
    help="How many accidents have a replay page, the hardest first. With images, a page takes up to 15 MB.",
)
def report(where: tuple[str, ...], out: str, replays: int | None, **options: Any) -> None:
    """Write one HTML page of the accidents in DATAROOT, a row an accident, that opens in any browser without a network.

    It tells for each accident what happens, who saw it first, until when braking would have avoided it and where its
    normal twin parts from it; for all of them, which share a warning would have avoided. What cannot be told is named
    with its reason.
    """
    folder = writable_folder(out)
    dataset = DeepAccident(**options)
    chosen = dataset.find(*where) if where else None
    if chosen == []:
        raise click.UsageError("no scenario matches --where, so there is nothing to write; change it")
    found = safety_report(dataset, chosen, progress=True, **engine_of(options))
    written = save_safety_report(found, folder, dataset=dataset, replays=replays, progress=True, **engine_of(options))
    left_out = f"; {len(found.left_out)} reasons for what is left out are in the page" if found.left_out else ""
    click.echo(f"{len(found.rows)} accidents of {found.scenarios} scenarios{left_out}")
    click.echo(f"written: {len(written)} files in {folder}; open {written[-1]} in a browser")
