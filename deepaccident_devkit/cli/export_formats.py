"""`deepaccident export <format>`: scenarios of a release for the loaders of other frameworks."""

from typing import Any, get_args

import click

from deepaccident_devkit.cli.export_bulk import export_parameters, run_export
from deepaccident_devkit.cli.options import WordChoice, refuse_unused
from deepaccident_devkit.export.opencood import OpenCood
from deepaccident_devkit.export.parquet import Parquet
from deepaccident_devkit.export.webdataset import Frames, WebDataset
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


@click.command(short_help="Write all tables as Parquet files, for datasets, DuckDB, Polars and pandas.")
@export_parameters
def parquet(**options: Any) -> None:
    """Write all tables of the release in DATAROOT as Parquet files by split, with tokens in place of row numbers.

    If a run is interrupted, the same command continues it.
    """
    refuse_unused("here: no file is linked", "link")
    run_export(Parquet, {}, **options)


@click.command(short_help="Write samples with images, LiDAR and boxes as tar files, for webdataset.")
@export_parameters
@click.option(
    "--frames",
    type=WordChoice(get_args(Frames)),
    default="every",
    show_default=True,
    help="every frame, or keyframes: two a second, counted back from the last.",
)
@click.option(
    "--shard-size",
    type=click.IntRange(min=1),
    default=1000,
    show_default=True,
    metavar="MB",
    help="Size of a tar file, about.",
)
def webdataset(frames: Frames, shard_size: int, **options: Any) -> None:
    """Write samples of the release in DATAROOT as tar files: the images, the LiDAR points, and the rest as JSON.

    If a run is interrupted, the same command continues it.
    """
    refuse_unused("here: no file is linked", "link")
    run_export(WebDataset, {"frames": frames, "shard_size": shard_size * 10**6}, **options)
