"""`deepaccident safety lead-time`: who observes both colliders first, and how long before the impact."""

from typing import Any, get_args

import click

from deepaccident_devkit.cli.options import (
    WordChoice,
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
from deepaccident_devkit.render.safety import render_lead_times
from deepaccident_devkit.render.safety.lead_time import LEAD_TIME_SIZE
from deepaccident_devkit.safety import ObservationRule, lead_time_ledger
from deepaccident_devkit.safety.observation import ObservationKind

_USUAL = ObservationRule()
_DPI = 150


@click.command(name="lead-time", short_help="Show how long before the impact agents observe both colliders.")
@release_parameters
@where_parameter
@click.option(
    "--rule",
    "kind",
    type=WordChoice(get_args(ObservationKind)),
    default=_USUAL.kind,
    show_default=True,
    help="What an observation is. points: the agent's label counts enough LiDAR points in the actor's box. released: "
    "the visibility rule of the released code. annotated: the label has the actor, hidden or not.",
)
@click.option(
    "--points",
    "least_points",
    type=click.IntRange(min=1),
    default=_USUAL.least_points,
    show_default=True,
    help="With --rule points: how many LiDAR points are enough.",
)
@click.option(
    "--memory",
    type=float,
    default=_USUAL.memory,
    show_default=True,
    help="For how many seconds an agent still knows an actor that it does not observe any more, in steps of 0.1.",
)
@click.option(
    "--sustained",
    type=click.IntRange(min=1),
    default=_USUAL.sustained,
    show_default=True,
    help="At how many frames in a row an agent must observe an actor before it counts.",
)
@click.option(
    "--out", type=click.Path(), metavar="DIR", help="Folder to write a JSON file, two CSV files and a figure into."
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object, for programs.")
def lead_time(where: tuple[str, ...], out: str | None, as_json: bool, **options: Any) -> None:
    """Show for each accident in DATAROOT how long before the impact both colliders are observed.

    By ego_vehicle alone, with each partner and with all of them, and how the gain is shared among the partners (Shapley
    values of the sixteen sets of agents). Observation bounds warning from above; it is no prediction.
    """
    if options["kind"] != "points":
        refuse_unused("without --rule points", "least_points")
    rule = ObservationRule(**{name: options.pop(name) for name in ("kind", "least_points", "memory", "sustained")})
    folder = None if out is None else writable_folder(out)
    dataset = DeepAccident(**options)
    chosen = dataset.find(*where) if where else None
    ledger = lead_time_ledger(dataset, chosen, rule, **engine_of(options))
    written = write_report(ledger, folder, "lead_times.json")
    if folder is not None and ledger.accidents:
        figure = render_lead_times(ledger, fig=detached_figure(LEAD_TIME_SIZE))
        written.append(write_figure(figure, folder / "lead_times.png", dpi=_DPI))
    say_report(ledger, written, folder, as_json=as_json)
