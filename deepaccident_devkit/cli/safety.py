"""`deepaccident safety`: what is to be learnt from the accidents of a release, from its labels alone."""

import json
import math
from pathlib import Path
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
from deepaccident_devkit.files import writable_folder, write_bytes
from deepaccident_devkit.render.axes import detached_figure
from deepaccident_devkit.render.pictures import write_figure
from deepaccident_devkit.render.safety import render_lead_times, render_twins, save_safety_report
from deepaccident_devkit.render.safety.figures import AVOIDABILITY_SIZE, LEAD_TIME_SIZE, TWINS_SIZE, render_avoidability
from deepaccident_devkit.render.safety.report import REPLAYS
from deepaccident_devkit.safety import (
    ObservationRule,
    Parting,
    avoidability_report,
    lead_time_ledger,
    safety_report,
    stories,
    twin_diff,
    twin_report,
)
from deepaccident_devkit.safety.avoidability import GROUPS
from deepaccident_devkit.safety.observation import ObservationKind

_RULE = ObservationRule()
_PARTING = Parting()
_DPI = 150
_json_parameter = click.option("--json", "as_json", is_flag=True, help="Print one JSON object, for programs.")


@click.group()
def safety() -> None:
    """Look into accidents: who saw the danger first, when it was too late, and how a normal twin differs."""


@safety.command(name="lead-time", short_help="Show how long before the impact agents observe both colliders.")
@release_parameters
@where_parameter
@click.option(
    "--rule",
    "kind",
    type=WordChoice(get_args(ObservationKind)),
    default=_RULE.kind,
    show_default=True,
    help="What an observation is. points: the agent's label counts enough LiDAR points in the actor's box. released: "
    "the visibility rule of the released code. annotated: the label has the actor, hidden or not.",
)
@click.option(
    "--points",
    "least_points",
    type=click.IntRange(min=1),
    default=_RULE.least_points,
    show_default=True,
    help="With --rule points: how many LiDAR points are enough.",
)
@click.option(
    "--memory",
    type=float,
    default=_RULE.memory,
    show_default=True,
    help="For how many seconds an agent still knows an actor that it does not observe any more, in steps of 0.1.",
)
@click.option(
    "--sustained",
    type=click.IntRange(min=1),
    default=_RULE.sustained,
    show_default=True,
    help="At how many frames in a row an agent must observe an actor before it counts.",
)
@click.option(
    "--out", type=click.Path(), metavar="DIR", help="Folder to write a JSON file, two CSV files and a figure into."
)
@_json_parameter
def lead_time(where: tuple[str, ...], out: str | None, as_json: bool, **options: Any) -> None:
    """Show for each accident in DATAROOT how long before the impact both colliders are observed.

    By ego_vehicle alone, with each partner and with all of them, and how the gain is shared among the partners (Shapley
    values of the sixteen sets of agents). Observation bounds warning from above; it is no prediction.
    """
    if options["kind"] != "points":
        refuse_unused("without --rule points", "least_points")
    rule = ObservationRule(**{name: options.pop(name) for name in ("kind", "least_points", "memory", "sustained")})
    folder = None if out is None else writable_folder(out)
    dataset, chosen = _release(where, options)
    ledger = lead_time_ledger(dataset, chosen, rule, **engine_of(options))
    written = write_report(ledger, folder, "lead_times.json")
    if folder is not None and ledger.accidents:
        figure = render_lead_times(ledger, fig=detached_figure(LEAD_TIME_SIZE))
        written.append(write_figure(figure, folder / "lead_times.png", dpi=_DPI))
    say_report(ledger, written, folder, as_json=as_json)


@safety.command(short_help="Show until when braking would have avoided the accidents.")
@release_parameters
@where_parameter
@click.option(
    "--out", type=click.Path(), metavar="DIR", help="Folder to write a JSON file, five CSV files and figures into."
)
@_json_parameter
def avoidability(where: tuple[str, ...], out: str | None, as_json: bool, **options: Any) -> None:
    """Show for the accidents in DATAROOT until when braking would have avoided them.

    Either collider brakes, or both: on its recorded path, with three reaction times and three decelerations. The other
    goes on as recorded, and after the recording straight on for 3 s. First the replay without braking is checked: the
    accidents whose recording does not show them are named and left out.
    """
    folder = None if out is None else writable_folder(out)
    dataset, chosen = _release(where, options)
    report = avoidability_report(dataset, chosen, **engine_of(options))
    written = write_report(report, folder, "avoidability.json")
    for group in GROUPS:
        if folder is not None and report.members(group):
            figure = render_avoidability(report, group, fig=detached_figure(AVOIDABILITY_SIZE))
            written.append(write_figure(figure, folder / f"avoidability_{group.replace('-', '_')}.png", dpi=_DPI))
    say_report(report, written, folder, as_json=as_json)


@safety.command(short_help="Show where accidents and their normal twins part.")
@release_parameters
@click.argument("scenario", required=False)
@where_parameter
@click.option(
    "--distance",
    type=click.FloatRange(min=0, min_open=True),
    default=_PARTING.distance,
    show_default=True,
    help="From how many metres between its two places on an actor acts differently.",
)
@click.option(
    "--turn",
    type=click.FloatRange(min=0, max=180, min_open=True),
    default=round(math.degrees(_PARTING.heading), 6),
    show_default=True,
    help="From how many degrees between its two headings on an actor acts differently.",
)
@click.option(
    "--out",
    type=click.Path(),
    metavar="DIR",
    help="Folder to write a JSON file and four CSV files into; with SCENARIO also a picture, and the values over time.",
)
@_json_parameter
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
    dataset, chosen = _release(where, options)
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


@safety.command(short_help="Tell what happens in scenarios, in sentences and as facts.")
@release_parameters
@click.argument("scenario", required=False)
@where_parameter
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    help="JSON Lines file to write into: the facts and the text of each scenario.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object for each scenario, for programs.")
def describe(scenario: str | None, where: tuple[str, ...], out: Path | None, as_json: bool, **options: Any) -> None:
    """Tell for each scenario in DATAROOT who collides, how fast, who saw it before, and what would have avoided it.

    SCENARIO is a token of the form TYPE/NAME; without it, all scenarios are told. Each clause tells a fact that is
    computed from labels and meta; what these do not tell is left out.
    """
    if scenario is not None:
        refuse_unused("with a scenario", "where")
    dataset, chosen = _release(where, options)
    told = stories(dataset, chosen if scenario is None else [scenario], **engine_of(options))
    lines = [json.dumps({**each.facts, "text": each.text}, allow_nan=False) for each in told]
    if out is not None:
        write_bytes(out, "".join(f"{line}\n" for line in lines).encode())
    for line, each in zip(lines, told, strict=True):
        click.echo(line if as_json else f"{each.facts['scenario']}\n  {each.text}")
        for reason in () if as_json else each.facts["unknown"]:
            click.echo(f"  not known: {reason}")
    if out is not None:
        click.echo(f"written: {len(lines)} scenarios in {out}", err=as_json)


def _replay_count(context: click.Context, parameter: click.Parameter, value: str) -> int | None:
    """Parse a number, `none` (0) or `all` (None)."""
    word = value.strip().lower()
    if word == "all":
        return None
    if word != "none" and not word.isdecimal():
        raise click.BadParameter(f"expected a number, all or none, found {value!r}", context, parameter)
    return 0 if word == "none" else int(word)


@safety.command(short_help="Write one HTML page of all accidents, with links to replays.")
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
    dataset, chosen = _release(where, options)
    if chosen == []:
        raise click.UsageError("no scenario matches --where, so there is nothing to write; change it")
    found = safety_report(dataset, chosen, progress=True, **engine_of(options))
    written = save_safety_report(found, folder, dataset=dataset, replays=replays, progress=True, **engine_of(options))
    left_out = f"; {len(found.left_out)} reasons for what is left out are in the page" if found.left_out else ""
    click.echo(f"{len(found.rows)} accidents of {found.scenarios} scenarios{left_out}")
    click.echo(f"written: {len(written)} files in {folder}; open {written[-1]} in a browser")


def _release(where: tuple[str, ...], options: dict[str, Any]) -> tuple[DeepAccident, Any]:
    """The release that a verb names, and those of its scenarios that match all filters; None for all."""
    dataset = DeepAccident(**options)
    return dataset, dataset.find(*where) if where else None
