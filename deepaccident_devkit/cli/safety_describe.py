"""`deepaccident safety describe`: what happens in scenarios, in sentences and as facts."""

import json
from pathlib import Path
from typing import Any

import click

from deepaccident_devkit.cli.options import engine_of, refuse_unused, release_parameters, where_parameter
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.files import write_bytes
from deepaccident_devkit.safety import stories


@click.command(short_help="Tell what happens in scenarios, in sentences and as facts.")
@release_parameters
@click.argument("scenario", required=False)
@where_parameter
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    help="JSON Lines file to write into: the facts and the text of each scenario.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object for each scenario, for programs.")
def describe(scenario: str | None, where: tuple[str, ...], out: Path | None, as_json: bool, **options: Any) -> None:
    """Tell for each scenario in DATAROOT who collides, how fast, who saw it before, and what would have avoided it.

    SCENARIO is a token of the form TYPE/NAME; without it, all scenarios are told. Each clause tells a fact that is
    computed from labels and meta; what these do not tell is left out.
    """
    if scenario is not None:
        refuse_unused("with a scenario", "where")
    dataset = DeepAccident(**options)
    chosen: Any = None if scenario is None else [scenario]
    if where:
        chosen = dataset.find(*where)
    told = stories(dataset, chosen, **engine_of(options))
    lines = [json.dumps({**each.facts, "text": each.text}, allow_nan=False) for each in told]
    if out is not None:
        write_bytes(out, "".join(f"{line}\n" for line in lines).encode())
    for line, each in zip(lines, told, strict=True):
        click.echo(line if as_json else f"{each.facts['scenario']}\n  {each.text}")
        for reason in () if as_json else each.facts["unknown"]:
            click.echo(f"  not known: {reason}")
    if out is not None:
        click.echo(f"written: {len(lines)} scenarios in {out}", err=as_json)
