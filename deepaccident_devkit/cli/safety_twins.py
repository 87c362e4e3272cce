"""`deepaccident safety twins`: accidents beside their normal twins."""

import math
from typing import Any

import click

from deepaccident_devkit.cli.options import (
    engine_of,
    refuse_unused,
    release_parameters,
    say_report,
    where_parameter,
    write_report,
)
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.files import writable_folder
from deepaccident_devkit.render.axes import detached_figure
from deepaccident_devkit.render.pictures import write_figure
from deepaccident_devkit.render.safety import render_twins
from deepaccident_devkit.render.safety.twins import TWINS_SIZE
from deepaccident_devkit.safety import Parting, twin_diff, twin_report

_USUAL = Parting()
_DPI = 150


@click.command(short_help="Show where accidents and their normal twins part.")
@release_parameters
@click.argument("scenario", required=False)
@where_parameter
@click.option(
    "--distance",
    type=click.FloatRange(min=0, min_open=True),
    default=_USUAL.distance,
    show_default=True,
    help="From how many metres between its two places on an actor acts differently.",
)
@click.option(
    "--turn",
    type=click.FloatRange(min=0, max=180, min_open=True),
    default=round(math.degrees(_USUAL.heading), 6),
    show_default=True,
    help="From how many degrees between its two headings on an actor acts differently.",
)
@click.option(
    "--out",
    type=click.Path(),
    metavar="DIR",
    help="Folder to write a JSON file and four CSV files into; with SCENARIO also a picture, and the values over time.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object, for programs.")
def twins(
    scenario: str | None,
    where: tuple[str, ...],
    distance: float,
    turn: float,
    out: str | None,
    as_json: bool,
    **options: Any,
) -> None:
    """Compare each accident in DATAROOT with its normal twin, which has the same name and subtype.

    Show when they part, who acts differently and how near the colliders come to each other in the twin, and list the
    twins that the split tears apart. SCENARIO is a token of the form TYPE/NAME, of an accident or of a twin; with it,
    show all actors of these two alone.
    """
    if scenario is not None:
        refuse_unused("with a scenario", "where")
    parting = Parting(distance=distance, heading=math.radians(turn))
    folder = None if out is None else writable_folder(out)
    dataset = DeepAccident(**options)
    chosen: Any = dataset.find(*where) if where else None
    diff = None if scenario is None else twin_diff(dataset, scenario, parting)
    if diff is not None:
        chosen = [diff.accident]
    report = twin_report(dataset, chosen, parting, **engine_of(options))
    written = write_report(report, folder, "twins.json")
    if folder is not None and diff is not None:
        written.append(diff.to_csv(folder / "twins_over_time.csv"))
        figure = render_twins(diff, fig=detached_figure(TWINS_SIZE))
        written.append(write_figure(figure, folder / "twins.png", dpi=_DPI))
    say_report(report, written, folder, as_json=as_json)
