"""`deepaccident export`: a scenario in another tool's format."""

from pathlib import Path
from typing import Any, get_args

import click

from deepaccident_devkit.cli.options import agent_names, agents_parameter, frame_range, release_parameters
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.evaluation.results import read_results
from deepaccident_devkit.export.mcap import McapConfig, export_mcap
from deepaccident_devkit.motion import PRESETS
from deepaccident_devkit.taxonomy import AGENTS, OnError
from deepaccident_devkit.v2x.collisions import first_accident


@click.group()
def export() -> None:
    """Write data in other tools' formats."""


def _points(context: click.Context, parameter: click.Parameter, value: str) -> str | int:
    """Parse `all`, or n."""
    if value != "all" and not value.isdecimal():
        raise click.BadParameter(f"expected all, or a number for every n-th point, found {value!r}", context, parameter)
    return value if value == "all" else int(value)


@export.command(short_help="A scenario as an interactive 3D scene.")
@release_parameters
@click.argument("scenario", required=False)
@click.option("--out", required=True, type=click.Path(path_type=Path), metavar="FILE", help="Such as accident.mcap.")
@agents_parameter
@click.option("--channels", multiple=True, metavar="NAME[,NAME…]", help="Cameras, lidar01; all if not given.")
@click.option("--frames", callback=frame_range, metavar="FIRST..LAST", help="Frame numbers from 1; all if not given.")
@click.option(
    "--points",
    callback=_points,
    metavar="all|N",
    default="all",
    show_default=True,
    help="All, or every N-th of a cloud.",
)
@click.option("--labels/--no-labels", default=True, show_default=True, help="The boxes.")
@click.option("--motion-labels", type=click.Choice(list(PRESETS)), help="Motion labels too.")
@click.option("--results", type=click.Path(path_type=Path), metavar="FILE", help="Predictions too: a results file.")
@click.option(
    "--on-missing",
    type=click.Choice(get_args(OnError)),
    default="skip",
    show_default=True,
    help="Leave out sensor files that are not there, or stop.",
)
def mcap(
    scenario: str | None,
    out: Path,
    agents: tuple[str, ...],
    channels: tuple[str, ...],
    results: Path | None,
    **options: Any,
) -> None:
    """Write SCENARIO of the release under DATAROOT as an MCAP file, which Foxglove and rerun open.

    SCENARIO is a token, such as type1_subtype1_accident/Town03_type001_subtype0001_scenario00024; the first one with
    a collision if not given.
    """
    names = agent_names(agents)
    choices = {name: options.pop(name) for name in ("frames", "points", "labels", "motion_labels", "on_missing")}
    choices["agents"] = None if names == AGENTS else names
    choices["channels"] = [name for text in channels for name in text.split(",")] if channels else None
    McapConfig.of(**choices)  # before the release is indexed
    prediction = None if results is None else read_results(results)
    dataset = DeepAccident(**options)
    token = scenario or first_accident(dataset)
    made = export_mcap(dataset, token, out, prediction=prediction, progress=True, **choices)
    click.echo(f"{made}: {token}, {made.stat().st_size / 1e6:.1f} MB; open it in Foxglove, or with: rerun {made}")
