"""`deepaccident export <format>`: scenarios of a release for the loaders of other frameworks."""

from typing import Any

import click

from deepaccident_devkit.cli.export_bulk import export_parameters, run_export
from deepaccident_devkit.cli.options import WordChoice
from deepaccident_devkit.export.opencood import OpenCood
from deepaccident_devkit.taxonomy import CATEGORIES, VEHICLE_AGENTS


@click.command(short_help="Write OPV2V's folders, for OpenCOOD, V2X-ViT, CoAlign and HEAL.")
@export_parameters
@click.option(
    "--classes",
    default="car,truck,van",
    show_default=True,
    metavar="NAME[,NAME…]",
    help=f"Which boxes become vehicles: {', '.join(CATEGORIES)}.",
)
@click.option(
    "--ego", type=WordChoice(VEHICLE_AGENTS), default="ego_vehicle", show_default=True, help="The vehicle that is 1."
)
def opencood(classes: str, ego: str, **options: Any) -> None:
    """Write scenarios of the release in DATAROOT as OPV2V has them: a folder each, with yaml, json and pcd files.

    If a run is interrupted, the same command continues it.
    """
    run_export(OpenCood, {"classes": tuple(classes.split(",")), "ego": ego}, **options)
