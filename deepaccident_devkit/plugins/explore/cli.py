"""`deepaccident explore`: a release in the browser."""

from pathlib import Path
from typing import Any

import click

from deepaccident_devkit.cli.options import PATH, reader_parameters, refuse_unused, where_parameter
from deepaccident_devkit.cli.verbs import advanced, verb
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.evaluation.runs.bundles import SUMMARY_FILE


def _parse_address(
    context: click.Context, parameter: click.Parameter, value: str | None
) -> dict[str, Any]:
    """Parse a host, a port, or both with a colon in between; without a text, return nothing."""
    if value is None:
        return {}
    from deepaccident_devkit.plugins.explore.access import HostPort

    location = HostPort.parse(f"127.0.0.1:{value}" if value.isdecimal() else value)
    if location is None or location.port == 0:
        raise click.BadParameter(
            f"expected HOST:PORT, HOST or PORT, found {value!r}", context, parameter
        )
    return {"host": location.name, "port": location.port}


@verb()
@reader_parameters
@click.option(
    "--results",
    "predictions",
    multiple=True,
    type=PATH,
    metavar="PATH",
    help="Results file or bundle of an evaluation, shown with the scenarios; you can repeat this "
    "option.",
)
@click.option(
    "--address",
    callback=_parse_address,
    metavar="HOST:PORT",
    help="Address to listen on, or only the port. With a host other than 127.0.0.1, other machines "
    "can open the pages.  [default: 127.0.0.1, and the first free port from 8765]",
)
@click.option("--no-open", is_flag=True, help="Do not open a browser.")
@advanced(
    "--root-path",
    default="",
    metavar="PATH",
    help="Path at which a proxy shows the pages, such as /user/me/proxy/8765, or the whole URL.",
)
@click.option(
    "--out",
    "target",
    type=PATH,
    metavar="DIR",
    help="Write the pages into this folder instead, as files for any web server.",
)
@where_parameter
def explore(target: Path | None, predictions: tuple[Path, ...], **options: Any) -> None:
    """Show the release in DATAROOT in the browser: find a scenario, watch it, see a model's output.

    The command prints the address of the pages and runs until Ctrl-C. The pages change no file.
    They can be read only with the token in that address. On another machine, use the SSH tunnel
    that the command prints.

    With --out, the command writes the pages of the scenarios that match --where, and ends.
    """
    from deepaccident_devkit.plugins.explore.serving import need_extra

    if target is None:
        refuse_unused("without --out", "where")
    else:
        refuse_unused("with --out, which starts no server", "address", "no_open", "root_path")
    need_extra()
    from deepaccident_devkit.plugins.explore import Explorer, export_pages
    from deepaccident_devkit.plugins.explore import explore as show

    models: dict[str, Any] = {"bundles": [], "results": []}
    for path in predictions:
        kind = "results"
        if (path / SUMMARY_FILE).is_file():
            kind = "bundles"
        models[kind].append(path)
    where = options.pop("where")
    no_open = options.pop("no_open")
    server = {**options.pop("address"), "root_path": options.pop("root_path")}
    dataset = DeepAccident(**options)
    if target is not None:
        engine: dict[str, Any] = {"workers": options["workers"], "progress": True}
        path = export_pages(dataset, target, where=where, **models, **engine)
        click.echo(f"wrote {path}; open it in a browser")
        return
    explorer = Explorer(dataset, **models, workers=options["workers"])
    show(explorer, open_browser=not no_open, say=click.echo, **server)
