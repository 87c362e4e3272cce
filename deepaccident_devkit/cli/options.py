"""Parameters that several subcommands share, and functions that read their values."""

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
from deepaccident_devkit.support.text import PathType, counted
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues
from deepaccident_devkit.taxonomy import VERSIONS, StyleName

_BOOLEAN_WORDS = {"yes": "true", "no": "false"}


class DatarootParameter(click.Path):
    """A release on the command line: a path, or a URL, which remains a string."""

    def convert(
        self,
        value: PathType,
        param: click.Parameter | None,
        ctx: click.Context | None,
    ) -> str | bytes | os.PathLike[str]:
        """Return the path, or the URL unchanged."""
        if isinstance(value, str) and "://" in value:
            return value
        return super().convert(value, param, ctx)


DATAROOT = DatarootParameter(path_type=Path)
"""Type of the arguments that name a release."""
PATH = click.Path(path_type=Path)
dataroot_argument = click.argument("dataroot", type=DATAROOT)
# Key of the context's `meta` for the options of the figures' style.
_STYLE_KEY = f"{__name__}.style"
_SCHEDULER = advanced(
    "--scheduler",
    metavar="ADDRESS|FILE.json",
    help="Run on the dask scheduler with this address or scheduler file, or, with mpi, on all MPI "
    "ranks (docs/clusters.md).",
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
index_dir_parameter = advanced("--index-dir", type=PATH, help="Folder to keep the index in.")
on_error_parameter = advanced(
    "--on-error",
    type=WordChoice(["raise", "skip"]),
    default="raise",
    show_default=True,
    help="raise: list broken scenarios and archives, and stop. skip: exclude them.",
)
reader_parameters = together(
    dataroot_argument, version_parameter, workers_parameter, index_dir_parameter, on_error_parameter
)
"""DATAROOT, --version, --index-dir, --workers and --on-error, for single-process subcommands."""


def _enter_style(context: click.Context, parameter: click.Parameter, value: Any) -> None:
    """Use a style for all figures that the command draws, once both of its options are known."""
    chosen = context.meta.setdefault(_STYLE_KEY, {})
    chosen[parameter.name] = value
    if len(chosen) == 2 and any(chosen.values()):
        from deepaccident_devkit.render.styles import style

        context.with_resource(style(chosen["style"], title=not chosen["no_title"]))


no_title_option = functools.partial(
    click.option, "--no-title", is_flag=True, help="Draw no titles, for figures with captions."
)
"""Function that makes the option --no-title."""
figure_style_parameter = together(
    click.option(
        "--style",
        type=WordChoice(get_args(StyleName)),
        expose_value=False,
        callback=_enter_style,
        help="Draw the figures as wide as a paper's column or page, or for a slide. Figures of a "
        "folder or a report are then written as PDF files, too.",
    ),
    no_title_option(expose_value=False, callback=_enter_style),
)
"""--style and --no-title, for subcommands that write figures."""
where_parameter = click.option(
    "--where",
    multiple=True,
    metavar="FILTER",
    help="Use only scenarios that match, such as town=Town03,Town05, weather!=Clear, length=40..60 "
    "or collision=true. If you repeat this option, all filters must match.",
)
channels_parameter = click.option(
    "--channels",
    multiple=True,
    metavar="NAME[,NAME…]",
    help="Use only these sensors, such as Camera_Front,Camera_Back.  [default: all]",
)
model_parameters = together(
    click.option(
        "--device",
        default="auto",
        show_default=True,
        help="Device of the model: cpu, cuda, …; auto uses a GPU if there is one.",
    ),
    click.option("--images-cache", type=PATH, help="Folder with images from `deepaccident cache`."),
)
json_parameter = click.option(
    "--json", "as_json", is_flag=True, help="Print one JSON object, for programs."
)


def engine_parameters(run_verb: Function) -> Function:
    """Add --workers and --scheduler to a subcommand.

    The subcommand receives `workers`, and the scheduler's `executor`, which is open while it runs.
    """

    @functools.wraps(run_verb)
    def run(*arguments: Any, scheduler: str | None, **options: Any) -> Any:
        if scheduler is None:
            return run_verb(*arguments, executor=None, **options)
        # imported here because most subcommands do not need it
        from deepaccident_devkit.support.parallel import cluster_executor

        refuse_unused("with a scheduler, which has its own workers", "workers")
        for name, value in options.items():
            if isinstance(value, Path):  # workers have other working directories
                options[name] = value.absolute()
        is_file = scheduler.endswith(".json")
        address = None if is_file else scheduler
        file = Path(scheduler) if is_file else None
        with cluster_executor(address, file) as executor:
            return run_verb(*arguments, executor=executor, **options)

    return cast("Function", workers_parameter(_SCHEDULER(run)))


release_options = together(
    version_parameter, engine_parameters, index_dir_parameter, on_error_parameter
)
"""--version, --index-dir, --on-error and the options of `engine_parameters`."""
release_parameters = together(dataroot_argument, release_options)
"""DATAROOT and the release's options, for a subcommand that works on a release."""


def engine_options(options: ReadOnlyValues) -> NamedValues:
    """Return the options of a subcommand that configure its workers."""
    return {name: options[name] for name in ("workers", "executor")}


def open_release(dataroot: Any, *, index_dir: Path | None = None, **options: Any) -> DeepAccident:
    """Open the release to work on; plug-ins open other datasets, such as nuScenes."""
    opener = _find_opener(dataroot, own=True)
    if opener is None:
        try:
            return DeepAccident(dataroot=dataroot, index_dir=index_dir, **options)
        except DatarootError:  # a third-party plug-in may be able to open it
            opener = _find_opener(dataroot, own=False)
            if opener is None:
                raise
    return opener.open_release(dataroot, index_dir)


def _find_opener(dataroot: Any, *, own: bool) -> Opener | None:
    """Return the plug-in opener that accepts a dataroot; None for a URL, or if none does."""
    if not isinstance(dataroot, Path):
        return None
    openers = offers(lambda plugin: plugin.openers, own=own).by_name.values()
    return next((opener for opener in openers if opener.recognizes(dataroot)), None)


def release_of(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a subcommand that say which release to open, and how."""
    return {name: options[name] for name in ("dataroot", "version", "index_dir", "on_error")}


def parse_switches(texts: Sequence[str]) -> NamedValues:
    """Return name → value from repeated --switch NAME=VALUE.

    A value that is not yes, no or valid JSON remains a string.
    """
    switches: NamedValues = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (name and equals):
            raise click.BadParameter(f"--switch: expected NAME=VALUE, found {text!r}")
        json_text = _BOOLEAN_WORDS.get(value.lower(), value)
        try:
            switches[name] = parsed_json(json_text.encode())
        except ValueError:
            switches[name] = value
    return switches


def write_report(report: Any, folder: Path | None, name: str) -> list[Path]:
    """Write a report's tables, and all its values as JSON to a file called `name`.

    Returns:
        Paths of the written files; empty without a folder.
    """
    if folder is None:
        return []
    json_path = folder / name
    write_bytes(json_path, report.to_json().encode())
    return [*report.to_csv(folder), json_path]


def print_written_report(
    report: Any, written: Sequence[Path], folder: Path | None, *, as_json: bool
) -> None:
    """Print a report, and how many files were written into a folder.

    The files are written beforehand, so that they do not depend on whether printing succeeds.
    """
    print_report(report, as_json=as_json)
    if folder is not None:
        click.echo(f"wrote {counted(len(written), 'file')} to {folder}", err=as_json)


def print_report(report: Any, *, as_json: bool) -> None:
    """Print a report, as one JSON object or as text."""
    click.echo(report.to_json() if as_json else report.to_text())


def split_words(texts: Sequence[str]) -> list[str]:
    """Return the words passed with a repeated option, each text split at commas."""
    words = []
    for text in texts:
        words += text.split(",")
    return words


seed_parameter = click.option(
    "--seed", default=0, show_default=True, help="Seed of all random numbers."
)


def use_threads_sparingly() -> None:
    """Let idle threads sleep, unless the environment sets another policy; call before torch.

    By default they spin. Each step then takes several times as long on a machine that has other
    work.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def was_given(parameter: str) -> bool:
    """Return whether the user passed this option of the running subcommand explicitly."""
    source = click.get_current_context().get_parameter_source(parameter)
    return source is not ParameterSource.DEFAULT


def refuse_unused(why: str, *parameters: str) -> None:
    """Raise a usage error if the user passed a parameter that has no effect in this call.

    Args:
        why: The reason, such as `without --out`.
        *parameters: Names of the parameters that have no effect.
    """
    context = click.get_current_context()
    for option in context.command.params:
        if option.name in parameters and was_given(option.name):
            name = option.human_readable_name
            if isinstance(option, click.Option):
                name = option.opts[0]
            raise click.UsageError(f"{name} has no effect {why}; leave it out", context)


def pixel_size(
    context: click.Context, parameter: click.Parameter, value: str | None
) -> tuple[int, int] | None:
    """Parse `WxH` as (width, height); None stays None."""
    if value is None:
        return None
    match = re.fullmatch(r"(\d+)x(\d+)", value.strip(), re.IGNORECASE)
    if match is None:
        raise click.BadParameter(
            f"expected WIDTHxHEIGHT, such as 480x270, found {value!r}", context, parameter
        )
    return int(match[1]), int(match[2])


def _parse_frame_range(
    context: click.Context, parameter: click.Parameter, value: str | None
) -> range | None:
    """Parse `FIRST..LAST`, or one number, as a range of frame numbers; None stays None."""
    if value is None:
        return None
    match = re.fullmatch(r"(\d+)(?:\.\.(\d+))?", value.strip())
    if match is not None:
        first = int(match[1])
        last = int(match[2] or match[1])
        if first <= last:
            return range(first, last + 1)
    raise click.BadParameter(
        f"expected frame numbers, such as 20..40, found {value!r}", context, parameter
    )


frame_range_parameter = click.option(
    "--frame-range",
    "frames",
    callback=_parse_frame_range,
    metavar="FIRST..LAST",
    help="Use only these frames of a scenario, counted from 1.",
)
"""Option `frames`: a range of frame numbers, or None."""
