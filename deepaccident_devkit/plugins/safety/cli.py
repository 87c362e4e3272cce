"""`deepaccident safety`: what the labels of a release show about its accidents."""

import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import click

from deepaccident_devkit.cli.options import (
    engine_options,
    figure_style_parameter,
    json_parameter,
    print_written_report,
    refuse_unused,
    release_parameters,
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
from deepaccident_devkit.plugins.safety.figures import render_avoidability, render_lead_times
from deepaccident_devkit.plugins.safety.page import REPLAYS, save_safety_report
from deepaccident_devkit.render.figures import write_report_figure
from deepaccident_devkit.support.files import writable_folder, write_bytes
from deepaccident_devkit.support.text import counted

# Scenarios to examine; None for all.
_Scenarios = Sequence[Any] | None
# File name → function that writes the file to a path, and returns the path.
Files = dict[str, Callable[[Path], Path]]
# A report, and the further files that belong to it.
_ReportFiles = tuple[Any, Files]


def _replay_count(context: click.Context, parameter: click.Parameter, value: str) -> int | None:
    """Convert the value of `--replays` to a number: 0 for `none`, None for `all`."""
    word = value.strip().lower()
    if word == "all":
        return None
    if word == "none":
        return 0
    if not word.isdecimal():
        raise click.BadParameter(
            f"expected a number, all or none, found {value!r}", context, parameter
        )
    return int(word)


def _make_lead_times(
    dataset: DeepAccident, scenarios: _Scenarios, *, kind: Any, **engine: Any
) -> _ReportFiles:
    """Compute the report on lead times, and return it with the writer of its figure."""
    ledger = lead_time_ledger(dataset, scenarios, ObservationRule(kind=kind), **engine)
    if not ledger.accidents:
        return ledger, {}
    draw = partial(render_lead_times, ledger)
    return ledger, {"lead_times.png": partial(write_report_figure, draw)}


def _make_avoidability(dataset: DeepAccident, scenarios: _Scenarios, **engine: Any) -> _ReportFiles:
    """Compute the report on avoidability, and return it with the writers of its figures."""
    report = avoidability_report(dataset, scenarios, **engine)
    files: Files = {}
    for group in ACCIDENT_GROUPS:
        if report.members(group):
            name = f"avoidability_{group.replace('-', '_')}.png"
            files[name] = partial(write_report_figure, partial(render_avoidability, report, group))
    return report, files


def _make_twins(dataset: DeepAccident, scenarios: _Scenarios, **engine: Any) -> _ReportFiles:
    """Compute the report on twins, which has no figures."""
    return twin_report(dataset, scenarios, **engine), {}


# Topic → function that makes its report and further files, and the name of the JSON file.
_TABLES: dict[str, tuple[Callable[..., _ReportFiles], str]] = {
    "lead-time": (_make_lead_times, "lead_times.json"),
    "avoidability": (_make_avoidability, "avoidability.json"),
    "twins": (_make_twins, "twins.json"),
}
# Parameter → topics that accept it.
_TOPICS_BY_PARAMETER = {
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
    help="For lead-time: what counts as an observation. points: the agent's label counts at least "
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
    help="For report: how many accidents get a replay page, the most severe first. With images, a "
    "page takes up to 15 MB.",
)
@click.option(
    "--out",
    type=click.Path(),
    metavar="DIR",
    help="Folder for the page with its files, or for tables (JSON, CSV) and figures. For describe: "
    "a JSON Lines file with the facts and the text of each scenario.",
)
@figure_style_parameter
@json_parameter
def safety(
    topic: str, where: tuple[str, ...], out: str | None, as_json: bool, **options: Any
) -> None:
    """Examine the accidents in DATAROOT. TOPIC is one of:

    \b
    report        Everything on one HTML page, with a row for each accident and links to replays; needs --out.
    describe      What happens in each scenario, in sentences and as facts.
    lead-time     How long before the impact agents observe both colliders, and how much each partner adds.
    avoidability  How late either collider, or both, could have braked and still avoided the accident.
    twins         When accidents and their normal twins begin to differ, and which actors behave differently.

    SCENARIO, a token of the form TYPE/NAME, limits `describe` to one scenario. Everything is
    computed from labels and meta files. Whatever is unknown is listed with the reason, or left out.
    docs/safety.md explains the numbers.
    """  # noqa: D301, D415, E501 - \b is click's mark of lines that are not wrapped
    for name, topics in _TOPICS_BY_PARAMETER.items():
        if topic not in topics:
            refuse_unused(f"with {topic}", name)
    scenario = options.pop("scenario")
    kind = options.pop("kind")
    replays = options.pop("replays")
    if scenario is not None:
        refuse_unused("with a scenario", "where")
    if topic == "report" and out is None:
        raise click.UsageError("Missing option '--out': the folder of the page.")
    target = _target_path(topic, out)
    dataset = DeepAccident(**options)
    engine = engine_options(options)
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
    """Return the path passed with `--out`: a file for `describe`, otherwise a folder; or None."""
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
    """Print the report of a topic that has tables, and write its files."""
    make_report, name = _TABLES[topic]
    report, files = make_report(dataset, scenarios, **arguments)
    written = write_report(report, target, name)
    if target is not None:
        written += [write(target / file) for file, write in files.items()]
    print_written_report(report, written, target, as_json=as_json)


def _describe(
    dataset: DeepAccident, scenarios: _Scenarios, out: Path | None, *, as_json: bool, **engine: Any
) -> None:
    """Print what happens in scenarios, and write the facts to the file `out` unless it is None."""
    described = stories(dataset, scenarios, **engine)
    lines = []
    for story in described:
        facts = {**story.facts, "text": story.text}
        lines.append(json.dumps(facts, allow_nan=False))
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
        click.echo(f"wrote {out} ({counted(len(lines), 'scenario')})", err=as_json)


def _report(
    dataset: DeepAccident, scenarios: _Scenarios, folder: Path, replays: int | None, **engine: Any
) -> None:
    """Write the HTML page of a release, and print which files were written."""
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
        summary += (
            f"; the page says what is left out and why ({counted(len(report.left_out), 'reason')})"
        )
    click.echo(summary)
    click.echo(
        f"wrote {counted(len(written), 'file')} to {folder}; open {written[-1]} in a browser"
    )
