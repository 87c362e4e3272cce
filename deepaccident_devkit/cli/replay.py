"""`deepaccident replay`: a scenario as one HTML file."""

from typing import Any

import click

from deepaccident_devkit.cli.options import cooperating_parameter, names_or_configuration, release_parameters
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.evaluation.results import read_results
from deepaccident_devkit.render.replay import render_replay


@click.command()
@release_parameters
@click.argument("scenario", required=False)
@click.option("--out", required=True, type=click.Path(), help="File to write, such as replay.html.")
@click.option("--results", type=click.Path(), help="Results file of motion or accidents, shown with its verdicts.")
@cooperating_parameter("Agents to show", "available")
@click.option(
    "--image-width", type=int, metavar="N", help="Image width in pixels.  [default: so that the file has at most 15 MB]"
)
@click.option(
    "--quality", type=int, metavar="Q", help="JPEG quality, 1 to 95.  [default: so that the file has at most 15 MB]"
)
def replay(
    scenario: str | None,
    out: str,
    results: str | None,
    agents: tuple[str, ...],
    image_width: int | None,
    quality: int | None,
    **release: Any,
) -> None:
    """Write one scenario of the release in DATAROOT as one HTML file that plays in any browser, without a network.

    SCENARIO is a token of the form TYPE/NAME. Without SCENARIO the command takes the first
    accident, or if there is none, the first scenario.
    """
    prediction = None if results is None else read_results(results)  # before the release is indexed
    path = render_replay(
        DeepAccident(**release),
        scenario,
        out,
        prediction=prediction,
        agents=names_or_configuration(agents),
        image_width=image_width,
        quality=quality,
        progress=True,
    )
    click.echo(f"written: {path}, {path.stat().st_size / 1e6:.1f} MB; open it in a browser")
