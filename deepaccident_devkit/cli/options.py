"""Parameters that several verbs share, and functions that read them."""

import functools
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast, get_args

import click
from click.core import ParameterSource

from deepaccident_devkit.cli.verbs import Function, WordChoice, advanced, together
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.errors import DatarootError
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.support.plugins import Opener, offers
from deepaccident_devkit.support.text import counted
from deepaccident_devkit.taxonomy import VERSIONS, StyleName

_BOOLEAN_WORDS = {"yes": "true", "no": "false"}


class DatarootParameter(click.Path):
    """A release on the command line: a path, or a URL, which stays a text."""

    def convert(
        self,
        value: str | os.PathLike[str],
        param: click.Parameter | None,
        ctx: click.Context | None,
    ) -> str | bytes | os.PathLike[str]:
        """Return the path, or the URL unchanged."""
        if isinstance(value, str) and "://" in value:
            return value
        return super().convert(value, param, ctx)


DATAROOT = DatarootParameter(path_type=Path)
"""The type of arguments that name a release."""
PATH = click.Path(path_type=Path)
dataroot_argument = click.argument("dataroot", type=DATAROOT)
_SCHEDULER = advanced(
    "--scheduler",
    metavar="ADDRESS|FILE.json",
    help="Run on this dask scheduler, or on that which wrote its address into a file; or mpi: on "
    "all ranks (docs/clusters.md).",
)
version_parameter = click.option(
    "--version",
    type=WordChoice(VERSIONS),
    default="v1",
    show_default=True,
    help="Version of the release.",
)
workers_parameter = click.option(
    "--workers", type=click.IntRange(min=1), help="Number of processes to use."
)
index_dir_parameter = advanced("--index-dir", type=PATH, help="Folder of the index.")
on_error_parameter = advanced(
    "--on-error",
    type=WordChoice(["raise", "skip"]),
    default="raise",
    show_default=True,
    help="raise: list broken scenarios and archives, and stop. skip: leave them out.",
)
reader_parameters = together(
    dataroot_argument, version_parameter, workers_parameter, index_dir_parameter, on_error_parameter
)
"""DATAROOT, --version, --index-dir, --workers and --on-error, for verbs in a single process."""


def _enter_style(context: click.Context, _: click.Parameter, value: str | None) -> None:
    """Draw all figures of the command in a style."""
    from deepaccident_devkit.render.styles import style

    if value is not None:
        context.with_resource(style(cast("Any", value)))


figure_style_parameter = click.option(
    "--style",
    type=WordChoice(get_args(StyleName)),
    expose_value=False,
    callback=_enter_style,
    help="Make the figures as wide as a paper's column or page, or for a slide, and write them as "
    "PDF files, too.",
)
where_parameter = click.option(
    "--where",
    multiple=True,
    metavar="FILTER",
    help="Only scenarios that match, such as town=Town03,Town05, weather!=Clear, length=40..60 or "
    "collision=true. If you repeat this option, all filters must match.",
)
channels_parameter = click.option(
    "--channels",
    multiple=True,
    metavar="NAME[,NAME…]",
    help="Only these sensors, such as Camera_Front,Camera_Back.  [default: all]",
)
model_parameters = together(
    click.option(
        "--device",
        default="auto",
        show_default=True,
        help="cpu, cuda, …; auto takes a GPU where there is one.",
    ),
    click.option(
        "--images-cache", type=PATH, help="Folder of `deepaccident cache` with the images."
    ),
)
json_parameter = click.option(
    "--json", "as_json", is_flag=True, help="Print one JSON object, for programs."
)


def engine_parameters(run_verb: Function) -> Function:
    """Add `workers` to a verb, and as `executor` that of --scheduler, open while the verb runs."""

    @functools.wraps(run_verb)
    def run(*arguments: Any, scheduler: str | None, **options: Any) -> Any:
        if scheduler is None:
            return run_verb(*arguments, executor=None, **options)
        # here, since most verbs start without it
        from deepaccident_devkit.support.parallel import cluster_executor

        refuse_unused("with a scheduler, which has workers of its own", "workers")
        for name, value in options.items():
            if isinstance(value, Path):  # workers have other working folders
                options[name] = value.absolute()
        file = Path(scheduler) if scheduler.endswith(".json") else None
        with cluster_executor(None if file else scheduler, file) as executor:
            return run_verb(*arguments, executor=executor, **options)

    return cast("Function", workers_parameter(_SCHEDULER(run)))


release_options = together(
    version_parameter, engine_parameters, index_dir_parameter, on_error_parameter
)
"""--version, --index-dir, --on-error and the options of `engine_parameters`."""
release_parameters = together(dataroot_argument, release_options)
"""For a verb on a release: DATAROOT and its options."""


def engine_of(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a verb that choose its workers."""
    return {name: options[name] for name in ("workers", "executor")}


def open_release(dataroot: Any, *, index_dir: Path | None = None, **options: Any) -> DeepAccident:
    """Return the release of a verb; plug-ins open other datasets, such as nuScenes."""
    opener = _opener(dataroot, own=True)
    if opener is None:
        try:
            return DeepAccident(dataroot=dataroot, index_dir=index_dir, **options)
        except DatarootError:  # perhaps a third-party plug-in opens it
            opener = _opener(dataroot, own=False)
            if opener is None:
                raise
    return opener.open_release(dataroot, index_dir)


def _opener(dataroot: Any, *, own: bool) -> Opener | None:
    """Return the plug-ins' opener that accepts a dataroot; None for a URL, or without any."""
    if not isinstance(dataroot, Path):
        return None
    openers = offers(lambda plugin: plugin.openers, own=own).by_name.values()
    return next((opener for opener in openers if opener.recognizes(dataroot)), None)


def release_of(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a verb that choose the release, and how it is opened."""
    return {name: options[name] for name in ("dataroot", "version", "index_dir", "on_error")}


def switches_of(texts: Sequence[str]) -> dict[str, Any]:
    """Return the names and values of repeated --switch NAME=VALUE.

    A value that is neither yes, no nor JSON stays a text.
    """
    switches: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (name and equals):
            raise click.BadParameter(f"--switch: expected NAME=VALUE, found {text!r}")
        try:
            switches[name] = parsed_json(_BOOLEAN_WORDS.get(value.lower(), value).encode())
        except ValueError:
            switches[name] = value
    return switches


def write_report(report: Any, folder: Path | None, name: str) -> list[Path]:
    """Write a report's tables, and all of it as JSON into a file `name`.

    Returns:
        The written files; none without a folder.
    """
    if folder is None:
        return []
    json_path = folder / name
    write_bytes(json_path, report.to_json().encode())
    return [*report.to_csv(folder), json_path]


def say_report(report: Any, written: Sequence[Path], folder: Path | None, *, as_json: bool) -> None:
    """Print a report, and how many files were written into a folder before.

    No written file depends on the print.
    """
    click.echo(report.to_json() if as_json else report.to_text())
    if folder is not None:
        click.echo(f"written: {counted(len(written), 'file')} in {folder}", err=as_json)


def words_of(texts: Sequence[str]) -> list[str]:
    """Return the words of a repeated option; a text is one word, or several with commas."""
    return [word for text in texts for word in text.split(",")]


seed_parameter = click.option(
    "--seed", default=0, show_default=True, help="Seed of all that is drawn."
)


def use_threads_sparingly() -> None:
    """Let idle threads sleep, unless the environment has another setting; call it before torch.

    By default they spin, and on a machine with other work each step then takes several times as
    long.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def was_given(parameter: str) -> bool:
    """Return whether the user passed this option of the running verb explicitly."""
    source = click.get_current_context().get_parameter_source(parameter)
    return source is not ParameterSource.DEFAULT


def refuse_unused(why: str, *parameters: str) -> None:
    """Raise a usage error if a parameter was passed that changes nothing in the running verb.

    Args:
        why: Reason, such as `without --out`.
        *parameters: Names of the parameters.
    """
    context = click.get_current_context()
    for option in context.command.params:
        if option.name in parameters and was_given(option.name):
            name = option.human_readable_name
            if isinstance(option, click.Option):
                name = option.opts[0]
            raise click.UsageError(f"{name} changes nothing {why}; leave it out", context)


def pixel_size(
    context: click.Context, parameter: click.Parameter, value: str | None
) -> tuple[int, int] | None:
    """Parse `WxH` to (width, height); None stays."""
    if value is None:
        return None
    match = re.fullmatch(r"(\d+)x(\d+)", value.strip(), re.IGNORECASE)
    if match is None:
        raise click.BadParameter(
            f"expected width x height such as 480x270, found {value!r}", context, parameter
        )
    return int(match[1]), int(match[2])


def _frame_range(
    context: click.Context, parameter: click.Parameter, value: str | None
) -> range | None:
    """Parse `FIRST..LAST`, or one number; None stays."""
    if value is None:
        return None
    match = re.fullmatch(r"(\d+)(?:\.\.(\d+))?", value.strip())
    if match is None or int(match[1]) > int(match[2] or match[1]):
        raise click.BadParameter(
            f"expected frame numbers such as 20..40, found {value!r}", context, parameter
        )
    return range(int(match[1]), int(match[2] or match[1]) + 1)


frame_range_parameter = click.option(
    "--frame-range",
    "frames",
    callback=_frame_range,
    metavar="FIRST..LAST",
    help="Only these frames of a scenario, counted from 1.",
)
"""An option for `frames`: a range of frame numbers, or None."""
