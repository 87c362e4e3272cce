"""`deepaccident synth`: make a synthetic release."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from deepaccident_devkit.cli.options import (
    PATH,
    engine_options,
    engine_parameters,
    pixel_size,
    refuse_unused,
)
from deepaccident_devkit.cli.verbs import WordChoice, advanced, field_option, verb
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.plugins.synth.benchmark import (
    BENCHMARKS,
    compared_kinds,
    described_release,
    differences,
    published,
)
from deepaccident_devkit.plugins.synth.plan import IMAGE_SIZE, RELEASED_IMAGE_SIZE, Sensors
from deepaccident_devkit.plugins.synth.sensors.caster import has_embree
from deepaccident_devkit.plugins.synth.spec import DESIGN_NUMBERS, design_text, read_spec
from deepaccident_devkit.support.text import counted
from deepaccident_devkit.support.values import NamedValues

_EXAMPLES = """\b
Examples:
  deepaccident synth OUT --scenarios 24 --sensors none     labels only, all twelve designs
  deepaccident synth --show-design 3 > mine.yaml           print a scenario file to edit
  deepaccident synth OUT --design mine.yaml                make accidents from your file
  deepaccident synth OUT --for-released-code               for the released DeepAccident code
  deepaccident synth OUT --benchmark v1 --sensors cameras  a benchmark, identical for everyone
"""
_MAX_SHOWN_DIFFERENCES = 5


def _show_design(context: click.Context, parameter: click.Parameter, value: str | None) -> None:
    """Print the scenario file of a design, and exit."""
    if value is not None:
        click.echo(design_text(_read_number(context, parameter, value)), nl=False)
        context.exit()


def _read_number(context: click.Context, parameter: click.Parameter, text: str) -> int:
    """Return the number of a design; raise BadParameter if there is no such design."""
    first, *_, last = DESIGN_NUMBERS
    number_type: Any = click.IntRange(first, last)
    return int(number_type.convert(text, parameter, context))


def _read_designs(
    context: click.Context, parameter: click.Parameter, texts: tuple[str, ...]
) -> NamedValues:
    """Return the fields `designs` and `spec`: numbers of designs, or one scenario file."""
    files = [text for text in texts if not text.isdecimal()]
    if files and len(texts) > 1:
        raise click.BadParameter(
            "expected one scenario file, or numbers of designs", context, parameter
        )
    if files:
        return {"designs": (), "spec": Path(files[0])}
    numbers = [_read_number(context, parameter, text) for text in texts]
    return {"designs": tuple(numbers), "spec": None}


@verb(epilog=_EXAMPLES)
@click.argument("out", type=PATH)
@field_option(SynthConfig, "scenarios")
@field_option(
    SynthConfig,
    "frames",
    default=None,
    show_default=False,
    help="Record only the last N frames of each scenario (10 Hz).  [default: all, 40 to 100]",
)
@click.option(
    "--size",
    "image_size",
    callback=pixel_size,
    metavar="WxH",
    help="Size of the camera images in pixels. Real images have 1600x900. The released code "
    "assumes this size, and computes wrong camera geometry with any other.  "
    "[default: {}x{}; {}x{} with --for-released-code]".format(*IMAGE_SIZE, *RELEASED_IMAGE_SIZE),
)
@field_option(SynthConfig, "layout")
@field_option(SynthConfig, "seed")
@field_option(SynthConfig, "sensors")
@field_option(SynthConfig, "view")
@field_option(SynthConfig, "unlabelled_test", option=advanced)
@field_option(SynthConfig, "for_released_code")
@click.option(
    "--design",
    "designs",
    multiple=True,
    callback=_read_designs,
    metavar="N|FILE",
    help="Make only accidents of this design; you can repeat this option. Or make those of your "
    "own scenario file (docs/synth.md).  [default: all twelve in turn]",
)
@field_option(SynthConfig, "designed")
@field_option(SynthConfig, "unplanned", option=advanced)
@field_option(SynthConfig, "traffic", option=advanced)
@click.option(
    "--benchmark",
    type=WordChoice(BENCHMARKS),
    help="Make the release of this benchmark, and compare it with the published one. With "
    "--sensors cameras or clouds, make only a part of its files. An existing release is only "
    "compared. See docs/benchmark.md.",
)
@engine_parameters
@click.option(
    "--show-design",
    metavar="N",
    is_eager=True,
    expose_value=False,
    callback=_show_design,
    help="Print the scenario file of a design, as a start for your own, and exit. docs/synth.md "
    "lists the designs.",
)
def synth(out: Path, *, designs: dict[str, Any], benchmark: str | None, **options: Any) -> None:
    """Make a complete synthetic release in the new folder OUT.

    If a run is interrupted, the same command continues it.
    """
    engine = engine_options(options)
    if benchmark is not None:
        unused = (set(options) | {"designs"}) - {*engine, "sensors"}
        refuse_unused("with --benchmark, which defines all settings", *unused)
        _make_benchmark(out, benchmark, options["sensors"], engine)
        return
    settings = {name: value for name, value in options.items() if name not in engine} | designs
    if settings["spec"] is not None or settings["view"] == "hidden":
        refuse_unused(
            "with a scenario file or --view hidden, which define the accident", "unplanned"
        )
    config = SynthConfig(**settings)
    if config.sensors == "none" and not has_embree():
        click.echo(
            "warning: slow without the package embreex; run pip install '.[synth]' in a checkout",
            err=True,
        )
    release = make_release(out, config, progress=True, **engine)
    frames = ""
    if config.frames is not None:
        frames = f" of {counted(config.frames, 'frame')}"
    scenarios = counted(config.scenarios, "scenario")
    click.echo(f"wrote {release} ({scenarios}{frames} with five agents, layout {config.layout})")
    click.echo(f"next: deepaccident info {release}")
    if config.spec is None or read_spec(config.spec).meets:
        layers = " --layers boxes" if config.sensors == "none" else ""
        click.echo(f"or:   deepaccident render accident {release}{layers} --out countdown.png")


def _make_benchmark(out: Path, name: str, sensors: Sensors, engine: NamedValues) -> None:
    """Make a benchmark's release unless it exists, and compare it with the published one.

    Args:
        out: Folder of the release.
        name: Name of the benchmark.
        sensors: Which files of sensors to make, as in `SynthConfig`.
        engine: Workers, executor and progress.

    Raises:
        ClickException: The release differs from the published one.
    """
    if not (out.is_dir() and any(out.iterdir())):
        config = replace(BENCHMARKS[name], sensors=sensors)
        make_release(out, config, progress=True, **engine)
    release = described_release(out, progress=True, **engine)
    faults = differences(release, published(name))
    if faults:
        raise click.ClickException(
            f"{out}: differs from the published benchmark {name} "
            f"({counted(len(faults), 'difference')}):\n"
            + "\n".join(faults[:_MAX_SHOWN_DIFFERENCES])
            + f"\nMake it with the libraries in benchmarks/{name}/lock.txt; evaluations on this "
            "release cannot be compared with others."
        )
    scenarios = counted(len(release["scenarios"]), "scenario")
    kinds = ", ".join(compared_kinds(release))
    click.echo(f"{out}: same as the published benchmark {name} ({scenarios}: labels, {kinds})")
    click.echo(f"next: deepaccident info {out}")
