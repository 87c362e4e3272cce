"""`deepaccident synth`: make a synthetic release."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

import click

from deepaccident_devkit.cli.options import (
    WordChoice,
    engine_parameters,
    pixel_size,
    refuse_unused,
)
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.synth import SynthConfig, make_release
from deepaccident_devkit.synth.config import IMAGE_SIZE, RELEASED_IMAGE_SIZE, Sensors
from deepaccident_devkit.synth.scenario import checked_text
from deepaccident_devkit.synth.sensors.caster import has_embree
from deepaccident_devkit.synth.spec import DESIGN_NUMBERS, View, design_text, designs_text, read_spec
from deepaccident_devkit.taxonomy import Layout

_DEFAULTS = SynthConfig()
_OF_FILES = (
    *("scenarios", "image_size", "layout", "sensors", "unlabelled_test", "exact", "for_released_code"),
    *("unplanned", "workers", "scheduler", "scheduler_file"),
)
"""Options of what is written."""
_FAULTY = 1
"""Exit status if a checked file gives no scenario."""
_EXAMPLES = """\b
Examples:
  deepaccident synth OUT --scenarios 24 --sensors none     only labels, all twelve designs
  deepaccident synth --show-design 3 > mine.yaml         print a scenario file to edit
  deepaccident synth --spec mine.yaml --check            say what happens in your file, and write nothing
  deepaccident synth OUT --spec mine.yaml                make accidents from your file
  deepaccident synth OUT --for-released-code             for the released DeepAccident code"""


def _list_designs(context: click.Context, _parameter: click.Parameter, wanted: bool) -> None:
    if wanted:
        click.echo(designs_text())
        context.exit()


def _show_design(context: click.Context, _parameter: click.Parameter, number: int | None) -> None:
    if number is not None:
        click.echo(design_text(number), nl=False)
        context.exit()


@click.command(epilog=_EXAMPLES)
@click.argument("out", required=False, type=click.Path(path_type=Path))
@click.option(
    "--scenarios",
    default=_DEFAULTS.scenarios,
    show_default=True,
    help="Number of scenarios: accidents and their normal twins in turn.",
)
@click.option(
    "--frames", type=int, help="Record only the last N frames of each scenario (10 Hz).  [default: all, 40 to 100]"
)
@click.option(
    "--size",
    "image_size",
    callback=pixel_size,
    metavar="WxH",
    help="Size of the camera images in pixels. The real ones have 1600x900, and the released DeepAccident code assumes "
    "this size: with another size it computes wrong camera geometry.  [default: {}x{}; {}x{} with "
    "--for-released-code]".format(*IMAGE_SIZE, *RELEASED_IMAGE_SIZE),
)
@click.option(
    "--layout",
    type=WordChoice(get_args(Layout)),
    default=_DEFAULTS.layout,
    show_default=True,
    help="A: all splits in one folder. B: one folder per split.",
)
@click.option("--seed", default=_DEFAULTS.seed, show_default=True, help="The same seed gives the same bytes.")
@click.option(
    "--sensors",
    type=WordChoice(get_args(Sensors)),
    default=_DEFAULTS.sensors,
    show_default=True,
    help="What to write besides labels, calib and meta. all: images, point clouds, BEV arrays. cameras: images alone. "
    "none: nothing.",
)
@click.option("--unlabelled-test", is_flag=True, help="Write no labels for the test split, as in the real release.")
@click.option(
    "--exact", is_flag=True, help="Leave out the small errors of calib and point counts that the real release has."
)
@click.option(
    "--for-released-code",
    is_flag=True,
    help="A release that the released DeepAccident code reads correctly: images of 1600x900, layout A, a labelled test "
    "split, and the split files under split_txt_files/ too.",
)
@click.option(
    "--design",
    "designs",
    type=click.IntRange(DESIGN_NUMBERS[0], DESIGN_NUMBERS[-1]),
    multiple=True,
    help="Only accidents of this design; you can repeat this option.  [default: all twelve in turn]",
)
@click.option(
    "--spec",
    type=click.Path(path_type=Path),
    help="Your own scenario file, in place of the designs; docs/scenarios.md describes its fields.",
)
@click.option(
    "--check",
    is_flag=True,
    help="Draw one accident and its normal twin from the file of --spec, print who hits whom, and write nothing; "
    "without OUT. Exit status 1 if the file gives no scenario.",
)
@click.option(
    "--unplanned",
    default=_DEFAULTS.unplanned,
    show_default=True,
    help="Share of accidents (0 to 1) that follow no design, such as one with a pedestrian or a third vehicle.",
)
@click.option(
    "--view",
    type=WordChoice(get_args(View)),
    help="hidden: a house at the corner hides the two vehicles that will collide from each other.",
)
@engine_parameters
@click.option(
    "--list-designs",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_list_designs,
    help="List the twelve designs and stop.",
)
@click.option(
    "--show-design",
    type=click.IntRange(DESIGN_NUMBERS[0], DESIGN_NUMBERS[-1]),
    is_eager=True,
    expose_value=False,
    callback=_show_design,
    help="Print the scenario file of a design, as a start for your own, and stop.",
)
@click.pass_context
def synth(context: click.Context, /, out: Path | None, *, check: bool, **options: Any) -> None:
    """Make a complete synthetic release in the new folder OUT.

    If a run is interrupted, the same command continues it.
    """
    how = {name: options.pop(name) for name in ("workers", "executor")}
    if check:
        _check(context, out, options)
        return
    if out is None:
        raise click.UsageError("Missing argument 'OUT': the folder to make.", context)
    if options["spec"] is not None or options["view"] == "hidden":
        refuse_unused("with --spec or --view hidden, which ask for one certain accident", "unplanned")
    config = SynthConfig(**options)
    if config.sensors == "none" and not has_embree():
        click.echo("slow without the package embreex; in a checkout: pip install '.[synth]'", err=True)
    made = make_release(out, config, progress=True, **how)
    scenarios = f"{config.scenarios} scenario{'s' if config.scenarios > 1 else ''}"
    frames = "" if config.frames is None else f" of {config.frames} frame{'s' if config.frames > 1 else ''}"
    click.echo(f"{made}: {scenarios}{frames} with five agents, layout {config.layout}")
    click.echo(f"next: deepaccident info {made}")
    if config.spec is None or read_spec(config.spec).meets:
        layers = " --layers boxes" if config.sensors == "none" else ""
        click.echo(f"or:   deepaccident render accident {made}{layers} --out countdown.png")


def _check(context: click.Context, out: Path | None, options: Mapping[str, Any]) -> None:
    """Print what a scenario file gives; exit status 1 with the error if it gives nothing."""
    if options["spec"] is None:
        raise click.UsageError("--check needs the scenario file: --spec FILE.", context)
    if out is not None:
        raise click.UsageError(f"--check writes nothing; leave {out} out.", context)
    refuse_unused("with --check, which draws one pair and writes nothing", *_OF_FILES)
    try:
        click.echo(checked_text(SynthConfig(**options), progress=True))
    except ConfigError as error:
        click.echo(f"error: {error}", err=True)
        context.exit(_FAULTY)
