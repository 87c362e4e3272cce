"""The arguments that every verb on a release takes, the same for all verbs."""

import functools
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

import click
from click.core import ParameterSource

from deepaccident_devkit.files import write_bytes
from deepaccident_devkit.parallel import cluster_executor
from deepaccident_devkit.taxonomy import AGENTS, VERSIONS
from deepaccident_devkit.text import choice, meant_text
from deepaccident_devkit.v2x import AGENT_SETS, AVAILABLE, Link

_ALL = ("all", AVAILABLE)
Verb = TypeVar("Verb", bound=Callable[..., Any])
if TYPE_CHECKING:
    _Choice = click.Choice[str]
else:
    _Choice = click.Choice  # click 8.1 has no `Choice[str]`


class WordChoice(_Choice):
    """One of some words in any case of letters; the error of another one names the word that was probably meant."""

    def __init__(self, words: Iterable[str]) -> None:
        """Take the words."""
        super().__init__(tuple(words), case_sensitive=False)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The word in its own spelling."""
        try:
            return super().convert(value, param, ctx)
        except click.BadParameter as error:
            self.fail(f"{error.message.removesuffix('.')}{meant_text(value, self.choices)}", param, ctx)


class DatarootParameter(click.Path):
    """A release on the command line: a path, or a URL, which stays a text."""

    def convert(
        self, value: str | os.PathLike[str], param: click.Parameter | None, ctx: click.Context | None
    ) -> str | bytes | os.PathLike[str]:
        """The path, or the URL as it is."""
        return value if isinstance(value, str) and "://" in value else super().convert(value, param, ctx)


DATAROOT = DatarootParameter(path_type=Path)
"""The type of what names a release."""
on_error_parameter = click.option(
    "--on-error",
    type=WordChoice(["raise", "skip"]),
    default="raise",
    show_default=True,
    help="raise: list broken scenarios and stop. skip: leave them out.",
)


def _tell_unused(_context: click.Context, parameter: click.Parameter, value: str | None) -> None:
    if value is not None:
        click.echo(f"{parameter.opts[0]} changes nothing here: the command reads the files, not the index", err=True)


_DATAROOT = click.argument("dataroot", type=DATAROOT)
_VERSION = click.option(
    "--version", type=WordChoice(VERSIONS), default="v1", show_default=True, help="Version of the release."
)
_WORKERS = click.option("--workers", type=click.IntRange(min=1), help="Number of processes to use.")
_ENGINE = (
    _WORKERS,
    click.option(
        "--scheduler",
        metavar="ADDRESS",
        help="Run on this dask scheduler; or mpi: on all ranks (docs/clusters.md).",
    ),
    click.option(
        "--scheduler-file",
        type=click.Path(path_type=Path),
        help="File that a dask scheduler wrote its address into, in place of --scheduler.",
    ),
)
_INDEX_DIR = click.option("--index-dir", type=click.Path(path_type=Path), help="Folder of the index.")
_UNUSED = tuple(
    click.option(name, hidden=True, expose_value=False, callback=_tell_unused) for name in ("--index-dir", "--on-error")
)


LINK_OPTIONS = ("latency", "pose_noise", "packet_loss", "seed")
"""Their names as parameters of a verb."""
_LINK = (
    click.option(
        "--latency", default=0.0, show_default=True, help="Delay of the partners' data, in seconds, in steps of 0.1."
    ),
    click.option(
        "--pose-noise",
        default=0.0,
        show_default=True,
        help="Mean position error of the partners' poses, in metres.",
    ),
    click.option(
        "--packet-loss", default=0.0, show_default=True, help="Probability that a partner's data do not arrive."
    ),
    click.option("--seed", default=0, show_default=True, help="Seed of all that is drawn."),
)


def release_parameters(verb: Verb) -> Verb:
    """Give a verb DATAROOT, --version, --index-dir, --on-error and what `engine_parameters` gives."""
    return _DATAROOT(_VERSION(_INDEX_DIR(engine_parameters(on_error_parameter(verb)))))


def reader_parameters(verb: Verb) -> Verb:
    """Give a verb that runs in one process DATAROOT, --version, --index-dir, --workers and --on-error."""
    return _DATAROOT(_VERSION(_INDEX_DIR(_WORKERS(on_error_parameter(verb)))))


def engine_parameters(verb: Verb) -> Verb:
    """Give a verb `workers`, and as `executor` that of --scheduler or --scheduler-file, which is open while it runs."""

    @functools.wraps(verb)
    def run(*arguments: Any, scheduler: str | None, scheduler_file: Path | None, **options: Any) -> Any:
        if scheduler is not None and scheduler_file is not None:
            raise click.UsageError("--scheduler and --scheduler-file name the same; give one of them")
        if scheduler or scheduler_file:
            refuse_unused("with a scheduler, which has workers of its own", "workers")
        with cluster_executor(scheduler, scheduler_file) as executor:
            if executor is not None:  # workers have working folders of their own
                options = {name: each.absolute() if isinstance(each, Path) else each for name, each in options.items()}
            return verb(*arguments, executor=executor, **options)

    for option in reversed(_ENGINE):
        run = option(run)
    return cast("Verb", run)


def engine_of(options: Mapping[str, Any]) -> dict[str, Any]:
    """Of a verb's options, those that say what it runs on."""
    return {name: options[name] for name in ("workers", "executor")}


def write_report(report: Any, folder: Path | None, name: str) -> list[Path]:
    """Write a report's tables, and all of it as JSON into a file `name`; the files written, none without a folder."""
    if folder is None:
        return []
    written = [*report.to_csv(folder), folder / name]
    write_bytes(written[-1], report.to_json().encode())
    return written


def say_report(report: Any, written: Sequence[Path], folder: Path | None, *, as_json: bool) -> None:
    """Print a report, and how many files were written into a folder before: nothing written depends on the print."""
    click.echo(report.to_json() if as_json else report.to_text())
    if folder is not None:
        click.echo(f"written: {len(written)} files in {folder}", err=as_json)


def files_parameters(verb: Verb) -> Verb:
    """Give a verb that reads files and not the index DATAROOT, --version and what `engine_parameters` gives.

    It takes the other options of a release too, as all verbs do, but does not offer them.
    """
    for parameter in _UNUSED:
        verb = parameter(verb)
    return _DATAROOT(_VERSION(engine_parameters(verb)))


def where_parameter(verb: Verb) -> Verb:
    """Give a verb `where`, the texts of repeated --where (`deepaccident_devkit.selection` says what they may be)."""
    option = click.option(
        "--where",
        multiple=True,
        metavar="FILTER",
        help="Only scenarios that match, such as town=Town03,Town05, weather!=Clear, length=40..60 or collision=true. "
        "If you repeat this option, all filters must match.",
    )
    return option(verb)


def agents_parameter(verb: Verb) -> Verb:
    """Give a verb `agents`, the texts of repeated --agents (`agent_names` reads them)."""
    option = click.option(
        "--agents",
        multiple=True,
        metavar="NAME[,NAME…]",
        help="Only samples of these agents; it does not choose who cooperates.  [default: all]",
    )
    return option(verb)


def agent_names(given: tuple[str, ...]) -> tuple[str, ...]:
    """The agents of repeated --agents, each text one name or several with commas; no text means all.

    `all` and `available` do too: this only chooses among the samples that are there.
    """
    names = [choice("--agents", name, (*AGENTS, *_ALL)) for text in given for name in text.split(",")]
    return AGENTS if not names or set(names) & set(_ALL) else tuple(names)


def cooperating_parameter(whose: str, default: str) -> Callable[[Verb], Verb]:
    """An option --agents for agents that cooperate (`names_or_configuration` reads it)."""
    return click.option(
        "--agents",
        multiple=True,
        metavar="NAME[,NAME…]",
        help=f"{whose}: names, or one of {', '.join(AGENT_SETS)} (those that are there).  [default: {default}]",
    )


def model_parameters(verb: Verb) -> Verb:
    """Give a verb that runs the model `device` and `images_cache`."""
    options = (
        click.option(
            "--device", default="auto", show_default=True, help="cpu, cuda, …; auto takes a GPU where there is one."
        ),
        click.option(
            "--images-cache", type=click.Path(path_type=Path), help="Folder of `deepaccident cache` with the images."
        ),
    )
    for option in reversed(options):
        verb = option(verb)
    return verb


def use_threads_sparingly() -> None:
    """Let threads that have nothing to do sleep, unless the environment says otherwise; before torch is imported.

    By default they spin, and on a machine with other work each step then takes several times as long.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def link_parameters(verb: Verb) -> Verb:
    """Give a verb `latency`, `pose_noise`, `packet_loss` and `seed` (`link_of` reads them)."""
    for option in reversed(_LINK):
        verb = option(verb)
    return verb


def link_of(options: dict[str, Any]) -> Link | None:
    """Take the link's options out of a verb's; None if nothing happens to the partners' data."""
    latency, noise, loss, seed = (options.pop(name) for name in LINK_OPTIONS)
    if not (latency or noise or loss):
        return None
    return Link(latency=latency, pose_noise=noise or None, packet_loss=loss, seed=seed)


def names_or_configuration(given: tuple[str, ...]) -> str | list[str] | None:
    """Repeated --agents for agents that cooperate: one configuration, names, or None if it was not given."""
    names = [name for text in given for name in text.split(",")]
    if len(names) != 1:
        return names or None
    alone = choice("--agents", names[0], (*AGENT_SETS, *AGENTS))
    return names if alone in AGENTS else alone


def was_given(parameter: str) -> bool:
    """Whether the call of the verb that runs has this option, be it with its default."""
    return click.get_current_context().get_parameter_source(parameter) is not ParameterSource.DEFAULT


def refuse_unused(why: str, *parameters: str) -> None:
    """End with a usage error if one of these options of the verb that runs was given, because it changes nothing."""
    context = click.get_current_context()
    for option in context.command.params:
        if option.name in parameters and was_given(option.name):
            raise click.UsageError(f"{option.opts[0]} changes nothing {why}; leave it out", context)


def pixel_size(context: click.Context, parameter: click.Parameter, value: str | None) -> tuple[int, int] | None:
    """Parse `WxH` to (width, height); None stays."""
    if value is None:
        return None
    match = re.fullmatch(r"(\d+)x(\d+)", value.strip(), re.IGNORECASE)
    if match is None:
        raise click.BadParameter(f"expected width x height such as 480x270, found {value!r}", context, parameter)
    return int(match[1]), int(match[2])


def frame_range_parameter(verb: Verb) -> Verb:
    """Give a verb `frames`, the numbers that --frame-range stands for, or None."""
    option = click.option(
        "--frame-range",
        "frames",
        callback=_frame_range,
        metavar="FIRST..LAST",
        help="Only these frames of a scenario, counted from 1.",
    )
    return option(verb)


def _frame_range(context: click.Context, parameter: click.Parameter, value: str | None) -> range | None:
    """Parse `FIRST..LAST`, or one number; None stays."""
    if value is None:
        return None
    match = re.fullmatch(r"(\d+)(?:\.\.(\d+))?", value.strip())
    if match is None or int(match[1]) > int(match[2] or match[1]):
        raise click.BadParameter(f"expected frame numbers such as 20..40, found {value!r}", context, parameter)
    return range(int(match[1]), int(match[2] or match[1]) + 1)
