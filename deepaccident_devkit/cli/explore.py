"""`deepaccident explore`: a release in the browser."""

from pathlib import Path
from typing import Any

import click

from deepaccident_devkit.cli.options import reader_parameters, refuse_unused, where_parameter
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.evaluation.runs.bundles import SUMMARY_FILE


@click.command()
@reader_parameters
@click.option(
    "--results",
    "predictions",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="PATH",
    help="Results file or bundle of an evaluation, shown with the scenarios; you can repeat this option.",
)
@click.option(
    "--port", type=click.IntRange(1, 65535), help="Port to listen on.  [default: the first free one from 8765 on]"
)
@click.option("--no-open", is_flag=True, help="Do not open a browser.")
@click.option(
    "--root-path",
    default="",
    metavar="PATH",
    help="Where a proxy shows the pages, such as /user/me/proxy/8765, or the whole URL.",
)
@click.option(
    "--host",
    default="127.0.0.1",
    show_default=True,
    help="Address to listen on. With another one, the pages can be reached from other machines.",
)
@click.option(
    "--out",
    "target",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Write the pages into this folder instead, as files for any web server.",
)
@where_parameter
def explore(target: Path | None, predictions: tuple[Path, ...], **options: Any) -> None:
    """Show the release in DATAROOT in the browser: find a scenario, watch it, see what a model says of it.

    The command prints the address of the pages and runs until Ctrl-C. The pages change no file. They can be read
    only with the token in that address. On another machine, use the SSH tunnel that the command prints.

    With --out, the command writes the pages of the scenarios that match --where, and ends.
    """
    from deepaccident_devkit.explore.serving import need_extra

    if target is None:
        refuse_unused("without --out", "where")
    else:
        refuse_unused("with --out, which starts no server", "port", "no_open", "root_path", "host")
    need_extra()
    from deepaccident_devkit.explore import Explorer, export_pages
    from deepaccident_devkit.explore import explore as show

    shown: dict[str, Any] = {"bundles": [], "results": []}
    for path in predictions:
        shown["bundles" if (path / SUMMARY_FILE).is_file() else "results"].append(path)
    where, no_open = options.pop("where"), options.pop("no_open")
    server = {name: options.pop(name) for name in ("host", "port", "root_path")}
    dataset = DeepAccident(**options)
    if target is not None:
        how: dict[str, Any] = {"workers": options["workers"], "progress": True}
        path = export_pages(dataset, target, where=where, **shown, **how)
        click.echo(f"written: {path}; open it in a browser")
        return
    explorer = Explorer(dataset, **shown, workers=options["workers"])
    show(explorer, open_browser=not no_open, say=click.echo, **server)
