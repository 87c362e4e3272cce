"""`deepaccident safety avoidability`: when accidents could have been avoided by braking."""

from typing import Any

import click

from deepaccident_devkit.cli.options import engine_of, release_parameters, say_report, where_parameter, write_report
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.files import writable_folder
from deepaccident_devkit.render.axes import detached_figure
from deepaccident_devkit.render.pictures import write_figure
from deepaccident_devkit.render.safety.avoidability import AVOIDABILITY_SIZE, render_avoidability
from deepaccident_devkit.safety import avoidability_report
from deepaccident_devkit.safety.avoidability_shares import GROUPS

_DPI = 150


@click.command(short_help="Show until when braking would have avoided the accidents.")
@release_parameters
@where_parameter
@click.option(
    "--out", type=click.Path(), metavar="DIR", help="Folder to write a JSON file, five CSV files and figures into."
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object, for programs.")
def avoidability(where: tuple[str, ...], out: str | None, as_json: bool, **options: Any) -> None:
    """Show for the accidents in DATAROOT until when braking would have avoided them.

    Either collider brakes, or both: on its recorded path, with three reaction times and three decelerations. The other
    goes on as recorded, and after the recording straight on for 3 s. First the replay without braking is checked: the
    accidents whose recording does not show them are named and left out.
    """
    folder = None if out is None else writable_folder(out)
    dataset = DeepAccident(**options)
    chosen = dataset.find(*where) if where else None
    report = avoidability_report(dataset, chosen, **engine_of(options))
    written = write_report(report, folder, "avoidability.json")
    if folder is not None:
        for group in GROUPS:
            if report.members(group):
                figure = render_avoidability(report, group, fig=detached_figure(AVOIDABILITY_SIZE))
                written.append(write_figure(figure, folder / f"avoidability_{group.replace('-', '_')}.png", dpi=_DPI))
    say_report(report, written, folder, as_json=as_json)
