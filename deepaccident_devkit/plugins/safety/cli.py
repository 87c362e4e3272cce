"""`deepaccident safety`: what the labels of a release show about its accidents."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import click

from deepaccident_devkit.cli.options import (
    engine_of,
    figure_style_parameter,
    json_parameter,
    refuse_unused,
    release_parameters,
    say_report,
    where_parameter,
    write_report,
)
from deepaccident_devkit.cli.verbs import WordChoice, field_option, verb
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.descriptions import ObservationRule, stories
from deepaccident_devkit.plugins.safety import (
    avoidability_report,
    lead_time_ledger,
    safety_report,
    twin_report,
)
from deepaccident_devkit.plugins.safety.avoidability_report import ACCIDENT_GROUPS
from deepaccident_devkit.plugins.safety.figures import (
    AVOIDABILITY_SIZE,
    COLUMN_HEIGHT,
    LEAD_TIME_SIZE,
    render_avoidability,
    render_lead_times,
)
from deepaccident_devkit.plugins.safety.page import REPLAYS, save_safety_report
from deepaccident_devkit.render.figures import report_figure, write_report_figure
from deepaccident_devkit.support.files import writable_folder, write_bytes
from deepaccident_devkit.support.text import counted

# Scenarios that a verb is about; None for all.
_Scenarios = Sequence[Any] | None
# Name of a file in a folder → function that writes it at a path, and returns the path.
Files = dict[str, Callable[[Path], Path]]


def _replay_count(context: click.Context, parameter: click.Parameter, value: str) -> int | None:
    """Parse a number, `none` (0) or `all` (None)."""
    word = value.strip().lower()
    if word == "all":
        return None
    if word != "none" and not word.isdecimal():
        raise click.BadParameter(
            f"expected a number, all or none, found {value!r}", context, parameter
        )
    if word == "none":
        return 0
    return int(word)


def _figure_writer(
    render: Callable[..., Any], size: tuple[float, float], *arguments: Any
) -> Callable[[Path], Path]:
    """Return a function that renders a figure of this size into a file."""

    def write(path: Path) -> Path:
        fig = report_figure(size, column=COLUMN_HEIGHT)
        return write_report_figure(render(*arguments, fig=fig), path)

    return write


def _lead_time(
    dataset: DeepAccident, scenarios: _Scenarios, *, kind: Any, **engine: Any
) -> tuple[Any, Files]:
    ledger = lead_time_ledger(dataset, scenarios, ObservationRule(kind=kind), **engine)
    if not ledger.accidents:
        return ledger, {}
    return ledger, {"lead_times.png": _figure_writer(render_lead_times, LEAD_TIME_SIZE, ledger)}


def _avoidability(dataset: DeepAccident, scenarios: _Scenarios, **engine: Any) -> tuple[Any, Files]:
    report = avoidability_report(dataset, scenarios, **engine)
    files: Files = {}
    for group in ACCIDENT_GROUPS:
        if report.members(group):
            name = f"avoidability_{group.replace('-', '_')}.png"
            files[name] = _figure_writer(render_avoidability, AVOIDABILITY_SIZE, report, group)
    return report, files


def _twins(dataset: DeepAccident, scenarios: _Scenarios, **engine: Any) -> tuple[Any, Files]:
    return twin_report(dataset, scenarios, **engine), {}


# Topic → function that makes its report and further files, and the report's JSON file.
_TABLES: Final[dict[str, tuple[Callable[..., tuple[Any, Files]], str]]] = {
    "lead-time": (_lead_time, "lead_times.json"),
    "avoidability": (_avoidability, "avoidability.json"),
    "twins": (_twins, "twins.json"),
}
# Parameter → the topics that take it.
_TOPICS_BY_PARAMETER: Final = {
    "kind": ("lead-time",),
    "scenario": ("describe",),
    "replays": ("report",),
    "as_json": ("describe", *_TABLES),
}


@verb()
@click.argument("topic", metavar="TOPIC", type=WordChoice(["report", "describe", *_TABLES]))
@release_parameters
@click.argument("scenario", required=False)
@where_parameter
@field_option(
    ObservationRule,
    "kind",
    "--seen",
    "kind",
    help="Of lead-time: what an observation is. points: the agent's label counts at least "
    f"{ObservationRule().least_points} LiDAR points in the actor's box. "
    "released: the visibility rule of the released code. annotated: the label has the actor, "
    "hidden or not.",
)
@click.option(
    "--replays",
    default=str(REPLAYS),
    show_default=True,
    callback=_replay_count,
    metavar="N|all|none",
    help="Of report: how many accidents have a replay page, the hardest first. With images, a page "
    "takes up to 15 MB.",
)
@click.option(
    "--out",
    type=click.Path(),
    metavar="DIR",
    help="Folder to write into: the page with its files, or tables (JSON, CSV) and figures. Of "
    "describe: a JSON Lines file, with the facts and the text of each scenario.",
)
@figure_style_parameter
@json_parameter
def safety(
    topic: str, where: tuple[str, ...], out: str | None, as_json: bool, **options: Any
) -> None:
    """Look into the accidents in DATAROOT. TOPIC says what is asked of them:

    \b
    report        All of it as one HTML page, a row an accident, with links to replays; needs --out.
    describe      What happens in each scenario, in sentences and as facts.
    lead-time     How long before the impact agents observe both colliders, and how partners share the gain.
    avoidability  Until when braking of either collider, or of both, would have avoided the accident.
    twins         When accidents and their normal twins part, and who acts differently.

    SCENARIO, a token of the form TYPE/NAME, makes `describe` tell of this one alone. All is
    computed from labels and meta. What cannot be told is named with its reason, or left out.
    docs/safety.md says what numbers mean.
    """  # noqa: D301, D415, E501 - \b is click's mark of lines that are not wrapped
    for name, topics in _TOPICS_BY_PARAMETER.items():
        if topic not in topics:
            refuse_unused(f"with {topic}", name)
    scenario, kind, replays = (options.pop(name) for name in ("scenario", "kind", "replays"))
    if scenario is not None:
        refuse_unused("with a scenario", "where")
    if topic == "report" and out is None:
        raise click.UsageError("Missing option '--out': the folder of the page.")
    target = _target_path(topic, out)
    dataset, engine = DeepAccident(**options), engine_of(options)
    scenarios: _Scenarios = dataset.find(*where) if where else None
    if topic in _TABLES:
        if topic in _TOPICS_BY_PARAMETER["kind"]:
            engine["kind"] = kind
        _write_tables(topic, dataset, scenarios, target, as_json=as_json, **engine)
    elif topic == "describe":
        described = scenarios if scenario is None else [scenario]
        _describe(dataset, described, target, as_json=as_json, **engine)
    elif target is not None:
        _report(dataset, scenarios, target, replays, **engine)


def _target_path(topic: str, out: str | None) -> Path | None:
    """Return the path of `--out`: a file for `describe`, otherwise a folder; None without it."""
    if out is None:
        return None
    if topic != "describe":
        return writable_folder(out)
    if Path(out).is_dir():
        raise click.BadParameter(
            f"--out: {out} is a folder; give a file, such as {out}/stories.jsonl"
        )
    return Path(out)


def _write_tables(
    topic: str,
    dataset: DeepAccident,
    scenarios: _Scenarios,
    target: Path | None,
    *,
    as_json: bool,
    **arguments: Any,
) -> None:
    make_report, name = _TABLES[topic]
    report, files = make_report(dataset, scenarios, **arguments)
    written = write_report(report, target, name)
    if target is not None:
        written += [write(target / file) for file, write in files.items()]
    say_report(report, written, target, as_json=as_json)


def _describe(
    dataset: DeepAccident, scenarios: _Scenarios, out: Path | None, *, as_json: bool, **engine: Any
) -> None:
    described = stories(dataset, scenarios, **engine)
    lines = [
        json.dumps({**story.facts, "text": story.text}, allow_nan=False) for story in described
    ]
    if out is not None:
        write_bytes(out, "".join(f"{line}\n" for line in lines).encode())
    for line, story in zip(lines, described, strict=True):
        if as_json:
            click.echo(line)
            continue
        click.echo(f"{story.facts['scenario']}\n  {story.text}")
        for reason in story.facts["unknown"]:
            click.echo(f"  not known: {reason}")
    if out is not None:
        click.echo(f"written: {counted(len(lines), 'scenario')} in {out}", err=as_json)


def _report(
    dataset: DeepAccident, scenarios: _Scenarios, folder: Path, replays: int | None, **engine: Any
) -> None:
    if scenarios is not None and not scenarios:
        raise click.UsageError(
            "no scenario matches --where, so there is nothing to write; change it"
        )
    report = safety_report(dataset, scenarios, progress=True, **engine)
    written = save_safety_report(
        report, folder, dataset=dataset, replays=replays, progress=True, **engine
    )
    summary = f"{counted(len(report.rows), 'accident')} of {counted(report.scenarios, 'scenario')}"
    if report.left_out:
        summary += f"; {len(report.left_out)} reasons for what is left out are in the page"
    click.echo(summary)
    click.echo(
        f"written: {counted(len(written), 'file')} in {folder}; open {written[-1]} in a browser"
    )
