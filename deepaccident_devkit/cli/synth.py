"""`deepaccident synth`: make a synthetic release."""

from pathlib import Path
from typing import Any, get_args

import click

from deepaccident_devkit.cli.options import pixel_size
from deepaccident_devkit.synth import SynthConfig, make_release
from deepaccident_devkit.synth.config import View
from deepaccident_devkit.taxonomy import Layout

_DEFAULTS = SynthConfig()


@click.command()
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--scenarios", default=_DEFAULTS.scenarios, show_default=True, help="Accidents and their normal twins.")
@click.option("--frames", default=_DEFAULTS.frames, show_default=True, help="Recorded frames a scenario, at 10 Hz.")
@click.option(
    "--image-size",
    callback=pixel_size,
    metavar="WxH",
    default="{}x{}".format(*_DEFAULTS.image_size),
    show_default=True,
    help="Of the camera images, pixels; the real ones have 1600x900.",
)
@click.option(
    "--layout",
    type=click.Choice(get_args(Layout)),
    default=_DEFAULTS.layout,
    show_default=True,
    help="A: all splits in one folder; B: a folder a split.",
)
@click.option("--seed", default=_DEFAULTS.seed, show_default=True, help="The same seed gives the same bytes.")
@click.option("--no-sensors", is_flag=True, help="Only labels, calib and meta: no images, point clouds, BEV arrays.")
@click.option(
    "--view",
    type=click.Choice(get_args(View)),
    default=_DEFAULTS.view,
    show_default=True,
    help="hidden: a house on the street corner hides the two who will collide from each other.",
)
@click.option("--workers", type=click.IntRange(min=1), default=None, help="Processes to use.  [default: as it pays]")
def synth(out: Path, *, no_sensors: bool, workers: int | None, **options: Any) -> None:
    """Make a complete synthetic release in the new folder OUT."""
    config = SynthConfig(sensors=not no_sensors, **options)
    made = make_release(out, config, workers=workers, progress=True)
    click.echo(
        f"{made}: {config.scenarios} scenarios of {config.frames} frames and five agents, layout {config.layout}"
    )
    click.echo(f"next: deepaccident info {made}")
