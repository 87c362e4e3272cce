"""`deepaccident sensor-setups`: the cameras, LiDAR and boxes of one source, or of two."""

import sys
from pathlib import Path

import click

from deepaccident_devkit.cli.options import (
    PATH,
    figure_style_parameter,
    json_parameter,
    open_release,
)
from deepaccident_devkit.cli.verbs import verb
from deepaccident_devkit.plugins.nuscenes.sensor_setups import sensor_setup_report


@verb("sensor-setups")
@click.argument("first", type=PATH, metavar="DATAROOT")
@click.argument("second", type=PATH, metavar="[OTHER]", required=False)
@click.option("--out", type=PATH, metavar="FILE", help="Picture to write, such as setups.png.")
@figure_style_parameter
@json_parameter
def sensor_setups(first: Path, second: Path | None, out: Path | None, as_json: bool) -> None:
    """Print what the cameras and LiDAR of a source see and which boxes it has, and compare OTHER.

    Each of them is a release or a nuScenes dataroot. With OTHER, the last lines say what a model
    that was trained on DATAROOT will find unusual in OTHER.
    """
    paths = [path for path in (first, second) if path is not None]
    report = sensor_setup_report(*map(open_release, paths))
    click.echo(report.to_json() if as_json else report.to_text())
    if out is not None:
        from deepaccident_devkit.plugins.nuscenes.sensor_setup_figures import sensor_setups_figure
        from deepaccident_devkit.render.figures import save_picture

        path = save_picture(sensor_setups_figure(report), out)
        click.echo(f"wrote {path}", err=as_json)
    sys.exit(report.exit_status)
