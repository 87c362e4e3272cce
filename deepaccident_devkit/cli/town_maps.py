"""`deepaccident export town-maps`: the maps of a release's towns as GeoJSON."""

import json
from typing import Any

import click

from deepaccident_devkit.cli.options import (
    engine_options,
    json_parameter,
    release_parameters,
    where_parameter,
)
from deepaccident_devkit.cli.verbs import verb
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.maps.making import town_map, towns_of
from deepaccident_devkit.support.files import writable_folder
from deepaccident_devkit.support.text import counted
from deepaccident_devkit.support.values import NamedValues


@verb("town-maps", short_help="Write the roads and sidewalks of each town as GeoJSON.")
@release_parameters
@where_parameter
@click.option(
    "--out", required=True, type=click.Path(), metavar="FOLDER", help="Folder to write into."
)
@json_parameter
def town_maps(where: tuple[str, ...], out: str, as_json: bool, **release: Any) -> None:
    """Write one file FOLDER/TOWN.geojson for each town of the release in DATAROOT.

    The maps combine what the BEV cameras of all recordings saw. Coordinates are metres in the
    simulator's right-handed world, not longitude and latitude.
    """
    folder = writable_folder(out)
    dataset = DeepAccident(**release)
    scenarios = dataset.find(*where) if where else None
    if scenarios == []:
        raise click.UsageError(
            "no scenario matches --where, so there is no map; change --where or omit it"
        )
    written: dict[str, NamedValues] = {}
    for town in towns_of(dataset, scenarios):
        try:
            town_plan = town_map(
                dataset, town, scenarios=scenarios, progress=True, **engine_options(release)
            )
        except NotAvailableError as error:
            click.echo(f"warning: {error}", err=True)
            continue
        path = town_plan.to_geojson(folder / f"{town_plan.town}.geojson")
        counts = {
            name: getattr(town_plan, name) for name in ("scenarios", "looks", "missing", "damaged")
        }
        drivable_cells = float(town_plan.drivable().sum())
        area = round(drivable_cells * town_plan.resolution**2, 1)
        written[town_plan.town] = {"path": str(path), **counts, "drivable_square_metres": area}
    if not written:
        raise NotAvailableError("no town has a map: the release has no readable BEV camera file")
    if as_json:
        click.echo(json.dumps(written, indent=2))
    else:
        click.echo("\n".join(map(_format_town, written.values())))


def _format_town(facts: NamedValues) -> str:
    pictures = counted(facts["looks"], "picture")
    scenarios = counted(facts["scenarios"], "scenario")
    area = f"{facts['drivable_square_metres']:,.0f} m²"
    text = f"wrote {facts['path']} ({area} of road, from {pictures} of {scenarios}"
    if facts["missing"] or facts["damaged"]:
        text += f"; {facts['missing']:,} missing, {facts['damaged']:,} damaged"
    return f"{text})"
