"""`deepaccident export`: the data in other tools' formats."""

from pathlib import Path
from typing import Any

import click

from deepaccident_devkit.cli.export_formats import mmdet3d, nuscenes, opencood, parquet, webdataset
from deepaccident_devkit.cli.export_questions import questions
from deepaccident_devkit.cli.export_town_maps import town_maps
from deepaccident_devkit.cli.options import (
    WordChoice,
    agent_names,
    agents_parameter,
    frame_range_parameter,
    refuse_unused,
    release_parameters,
)
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.evaluation.results import read_results
from deepaccident_devkit.export.mcap import McapConfig, export_mcap
from deepaccident_devkit.motion import PRESETS
from deepaccident_devkit.taxonomy import AGENTS, LIDAR
from deepaccident_devkit.text import spelled
from deepaccident_devkit.v2x.collisions import default_scenario


@click.group()
def export() -> None:
    """Write data in the formats of other tools."""


for verb in (mmdet3d, nuscenes, opencood, parquet, questions, town_maps, webdataset):
    export.add_command(verb)


def _points(context: click.Context, parameter: click.Parameter, value: str) -> str | int:
    """Parse `all`, or n."""
    value = spelled(value, ("all",))
    if value != "all" and not value.isdecimal():
        raise click.BadParameter(f"expected all, or a number for every n-th point, found {value!r}", context, parameter)
    return value if value == "all" else int(value)


@export.command(short_help="Write a scenario as an interactive 3D scene (MCAP).")
@release_parameters
@click.argument("scenario", required=False)
@click.option(
    "--out",
    required=True,
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="File to write, such as accident.mcap.",
)
@agents_parameter
@click.option(
    "--channels",
    multiple=True,
    metavar="NAME[,NAME…]",
    help="Sensors, such as Camera_Front or lidar01.  [default: all]",
)
@frame_range_parameter
@click.option(
    "--points",
    callback=_points,
    metavar="all|N",
    default="all",
    show_default=True,
    help="all, or N for every N-th point of a cloud.",
)
@click.option("--labels/--no-labels", default=True, show_default=True, help="Whether to write the boxes.")
@click.option("--motion-labels", type=WordChoice(PRESETS), help="Also write motion labels by this preset.")
@click.option(
    "--results",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Also write the predictions of this results file.",
)
def mcap(
    scenario: str | None,
    out: Path,
    agents: tuple[str, ...],
    channels: tuple[str, ...],
    results: Path | None,
    **options: Any,
) -> None:
    """Write one scenario of the release in DATAROOT as an MCAP file for Foxglove or rerun.

    SCENARIO is a token, such as type1_subtype1_accident/Town03_type001_subtype0001_scenario00024. Without SCENARIO the
    command takes the first scenario with a collision, or if there is none, the first scenario.
    """
    names = agent_names(agents)
    choices = {name: options.pop(name) for name in ("frames", "points", "labels", "motion_labels")}
    choices["agents"] = None if names == AGENTS else names
    choices["channels"] = [name for text in channels for name in text.split(",")] if channels else None
    config = McapConfig.of(**choices)  # before the release is indexed
    if LIDAR not in (config.channels or ()):
        refuse_unused(f"without the channel {LIDAR}", "points")
    prediction = None if results is None else read_results(results)
    dataset = DeepAccident(**options)
    token = scenario or default_scenario(dataset)
    made = export_mcap(dataset, token, out, prediction=prediction, progress=True, **choices)
    click.echo(f"{made}: {token}, {made.stat().st_size / 1e6:.1f} MB; open it in Foxglove, or with: rerun {made}")
