"""`deepaccident export <format>`: scenarios of a release for the loaders of other frameworks."""

from typing import Any, get_args

import click

from deepaccident_devkit.cli.export_bulk import Verb, export_parameters, run_export
from deepaccident_devkit.cli.options import WordChoice, refuse_unused
from deepaccident_devkit.export.mmdet3d import Mmdet3d
from deepaccident_devkit.export.nuscenes import NuScenes
from deepaccident_devkit.export.nuscenes.scenes import LidarAxes, Van
from deepaccident_devkit.export.opencood import OpenCood
from deepaccident_devkit.export.parquet import Parquet
from deepaccident_devkit.export.released_infos import ReleasedInfos
from deepaccident_devkit.export.webdataset import Frames, WebDataset
from deepaccident_devkit.taxonomy import CATEGORIES, VEHICLE_AGENTS

_OF_NUSCENES = (
    click.option("--van", type=WordChoice(get_args(Van)), default="car", show_default=True, help="What vans become."),
    click.option(
        "--lidar-axes",
        type=WordChoice(get_args(LidarAxes)),
        default="ego",
        show_default=True,
        help="Axes of the clouds. ego: x forward, y left. nuscenes: x right, y forward.",
    ),
    click.option(
        "--sweeps/--no-sweeps", default=True, show_default=True, help="Whether to write the frames between keyframes."
    ),
)


def _nuscenes_parameters(verb: Verb) -> Verb:
    """Give a verb --van, --lidar-axes and --sweeps."""
    for option in reversed(_OF_NUSCENES):
        verb = option(verb)
    return verb


@click.command(short_help="Write infos for mmdet3d, or for the released code.")
@export_parameters
@click.option(
    "--style",
    type=WordChoice(("nuscenes", "released")),
    default="nuscenes",
    show_default=True,
    help="nuscenes: for mmdet3d from 1.1 on. released: as the released code's converter makes them.",
)
@_nuscenes_parameters
@click.option(
    "--root-prefix",
    default=ReleasedInfos.root_prefix,
    show_default=True,
    metavar="PATH",
    help="released: what paths begin with.",
)
@click.option("--drop-empty", is_flag=True, help="released: leave out infos without boxes, at which its code stops.")
def mmdet3d(style: str, root_prefix: str, *, drop_empty: bool, **options: Any) -> None:
    """Write the infos that mmdet3d's NuScenesDataset reads, beside a nuScenes export, which is made if it is missing.

    With --style released, write carla_infos_train.pkl and carla_infos_val.pkl, which the released code's two dataset
    classes read together with the release itself.
    """
    own = {name: options.pop(name) for name in ("van", "lidar_axes", "sweeps")}
    if style == "released":
        refuse_unused("with --style released", *own, "link")
        run_export(ReleasedInfos, {"root_prefix": root_prefix, "drop_empty": drop_empty}, **options)
        return
    refuse_unused("without --style released", "root_prefix", "drop_empty")
    for kind in (NuScenes, Mmdet3d):
        run_export(kind, own, **options)


@click.command(short_help="Write nuScenes tables and their sensor files.")
@export_parameters
@_nuscenes_parameters
def nuscenes(van: str, lidar_axes: str, *, sweeps: bool, **options: Any) -> None:
    """Write scenarios of the release in DATAROOT for the nuScenes devkit 1.2 and all that reads nuScenes.

    Keyframes are at 2 Hz, sweeps at 10 Hz. Images are linked, clouds are written: those of a whole release take about
    210 GB, and 42 GB with --no-sweeps; the nuScenes devkit holds its tables in 6 GB of memory, or 4 GB. --dry-run says
    how large yours are. If a run is interrupted, the same command continues it.
    """
    run_export(NuScenes, {"van": van, "lidar_axes": lidar_axes, "sweeps": sweeps}, **options)


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
@click.option(
    "--without-clouds",
    is_flag=True,
    help="Also write agents and moments that lack a point cloud, for models of cameras alone.",
)
def opencood(classes: str, ego: str, *, without_clouds: bool, **options: Any) -> None:
    """Write scenarios of the release in DATAROOT as OPV2V has them: a folder each, with yaml, json and pcd files.

    If a run is interrupted, the same command continues it.
    """
    own = {"classes": tuple(classes.split(",")), "ego": ego, "without_clouds": without_clouds}
    run_export(OpenCood, own, **options)


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
