"""`deepaccident export town-maps`: the maps of a release's towns as GeoJSON."""

import json
from typing import Any

import click

from deepaccident_devkit.cli.options import (
    engine_of,
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


@verb("town-maps", short_help="Write the roads and sidewalks of each town as GeoJSON.")
@release_parameters
@where_parameter
@click.option(
    "--out", required=True, type=click.Path(), metavar="FOLDER", help="Folder to write into."
)
@json_parameter
def town_maps(where: tuple[str, ...], out: str, as_json: bool, **release: Any) -> None:
    """Write a file FOLDER/TOWN.geojson for each town of the release in DATAROOT.

    The maps are made from what the BEV cameras of all recordings saw. Coordinates are metres of the
    simulator's world, right-handed: no longitude and latitude.
    """
    folder, dataset = writable_folder(out), DeepAccident(**release)
    scenarios = dataset.find(*where) if where else None
    if scenarios == []:
        raise click.UsageError(
            "no scenario matches --where, so there is no map; change it or omit it"
        )
    written: dict[str, dict[str, Any]] = {}
    for town in towns_of(dataset, scenarios):
        try:
            town_plan = town_map(
                dataset, town, scenarios=scenarios, progress=True, **engine_of(release)
            )
        except NotAvailableError as error:
            click.echo(f"left out: {error}", err=True)
            continue
        path = town_plan.to_geojson(folder / f"{town_plan.town}.geojson")
        counts = {
            name: getattr(town_plan, name) for name in ("scenarios", "looks", "missing", "damaged")
        }
        area = round(float(town_plan.drivable().sum()) * town_plan.resolution**2, 1)
        written[town_plan.town] = {"path": str(path), **counts, "drivable_square_metres": area}
    if not written:
        raise NotAvailableError("no town has a map: there is no readable file of a BEV camera")
    click.echo(
        json.dumps(written, indent=2) if as_json else "\n".join(map(_town_line, written.values()))
    )


def _town_line(facts: dict[str, Any]) -> str:
    return (
        f"{facts['path']}: {facts['drivable_square_metres']:,.0f} m² of road, from "
        f"{facts['looks']:,} pictures of {counted(facts['scenarios'], 'scenario')} "
        f"({facts['missing']:,} missing, {facts['damaged']:,} damaged)"
    )
