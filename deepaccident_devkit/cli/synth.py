"""`deepaccident synth`: make a synthetic release."""

import re
from pathlib import Path
from typing import get_args

import click

from deepaccident_devkit.synth import SynthConfig, make_release
from deepaccident_devkit.taxonomy import Layout

_DEFAULTS = SynthConfig()


def _image_size(context: click.Context, parameter: click.Parameter, value: str) -> tuple[int, int]:
    """Parse `WxH` to (width, height)."""
    match = re.fullmatch(r"(\d+)x(\d+)", value.strip(), re.IGNORECASE)
    if match is None:
        raise click.BadParameter(f"expected width x height such as 480x270, found {value!r}", context, parameter)
    return int(match[1]), int(match[2])


@click.command()
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--scenarios", default=_DEFAULTS.scenarios, show_default=True, help="Accidents and their normal twins.")
@click.option("--frames", default=_DEFAULTS.frames, show_default=True, help="Recorded frames a scenario, at 10 Hz.")
@click.option(
    "--image-size",
    callback=_image_size,
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
@click.option("--workers", type=click.IntRange(min=1), default=None, help="Processes to use.  [default: as it pays]")
def synth(
    out: Path,
    scenarios: int,
    frames: int,
    image_size: tuple[int, int],
    layout: Layout,
    seed: int,
    no_sensors: bool,
    workers: int | None,
) -> None:
    """Make a complete synthetic release in the new folder OUT."""
    config = SynthConfig(
        scenarios=scenarios,
        frames=frames,
        image_size=image_size,
        layout=layout,
        seed=seed,
        sensors=not no_sensors,
    )
    made = make_release(out, config, workers=workers, progress=True)
    click.echo(f"{made}: {scenarios} scenarios of {frames} frames and five agents, layout {layout}")
    click.echo(f"next: deepaccident info {made}")
