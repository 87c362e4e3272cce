"""`deepaccident export town-maps`: drivable areas and sidewalks of towns, as GeoJSON."""

import json
from typing import Any

import click

from deepaccident_devkit.cli.options import engine_of, release_parameters, where_parameter
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.files import writable_folder
from deepaccident_devkit.maps import TownMapConfig, town_map, towns_of


@click.command("town-maps", short_help="Write the roads and sidewalks of each town as GeoJSON.")
@release_parameters
@where_parameter
@click.option("--out", required=True, type=click.Path(), metavar="FOLDER", help="Folder to write into.")
@click.option("--town", "towns", multiple=True, metavar="NAME", help="Only this town; you can repeat this option.")
@click.option(
    "--resolution",
    type=float,
    default=TownMapConfig().resolution,
    show_default=True,
    help="Side of a cell of the map, in metres.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object, for programs.")
def town_maps(
    where: tuple[str, ...],
    out: str,
    towns: tuple[str, ...],
    resolution: float,
    as_json: bool,
    **release: Any,
) -> None:
    """Write a file FOLDER/TOWN.geojson for each town of the release in DATAROOT.

    The maps are made from what the BEV cameras of all recordings saw. Coordinates are metres of the simulator's world,
    right-handed: no longitude and latitude.
    """
    config = TownMapConfig(resolution=resolution)  # before the release is indexed
    folder, dataset = writable_folder(out), DeepAccident(**release)
    chosen = dataset.find(*where) if where else None
    if chosen == []:
        raise click.UsageError("no scenario matches --where, so there is no map; change it or omit it")
    written: dict[str, dict[str, Any]] = {}
    for town in towns or towns_of(dataset, chosen):
        try:
            made = town_map(dataset, town, config=config, scenarios=chosen, progress=True, **engine_of(release))
        except NotAvailableError as error:
            if towns:
                raise
            click.echo(f"left out: {error}", err=True)
            continue
        path = made.to_geojson(folder / f"{made.town}.geojson")
        counts = {name: getattr(made, name) for name in ("scenarios", "looks", "missing", "damaged")}
        area = round(float(made.drivable().sum()) * made.resolution**2, 1)
        written[made.town] = {"path": str(path), **counts, "drivable_square_metres": area}
    if not written:
        raise NotAvailableError("no town has a map: there is no readable file of a BEV camera")
    click.echo(json.dumps(written, indent=2) if as_json else "\n".join(map(_line, written.values())))


def _line(told: dict[str, Any]) -> str:
    return (
        f"{told['path']}: {told['drivable_square_metres']:,.0f} m² of road, from {told['looks']:,} pictures of "
        f"{told['scenarios']:,} scenarios ({told['missing']:,} missing, {told['damaged']:,} damaged)"
    )
