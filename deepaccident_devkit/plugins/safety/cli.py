"""`deepaccident safety`: what is to be learnt from the accidents of a release, from its labels alone."""

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

# Those that a verb is about; None for all.
_Scenarios = Sequence[Any] | None
# Name of a file in a folder → what writes it at a path, and gives the path back.
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
    return 0 if word == "none" else int(word)


def _picture(
    render: Callable[..., Any], size: tuple[float, float], *what: Any
) -> Callable[[Path], Path]:
    """What renders a figure of this size into a file."""
    return lambda path: write_report_figure(
        render(*what, fig=report_figure(size, column=COLUMN_HEIGHT)), path
    )


def _lead_time(
    dataset: DeepAccident, chosen: _Scenarios, *, kind: Any, **engine: Any
) -> tuple[Any, Files]:
    ledger = lead_time_ledger(dataset, chosen, ObservationRule(kind=kind), **engine)
    return ledger, {
        "lead_times.png": _picture(render_lead_times, LEAD_TIME_SIZE, ledger)
    } if ledger.accidents else {}


def _avoidability(dataset: DeepAccident, chosen: _Scenarios, **engine: Any) -> tuple[Any, Files]:
    report = avoidability_report(dataset, chosen, **engine)
    return report, {
        f"avoidability_{group.replace('-', '_')}.png": _picture(
            render_avoidability, AVOIDABILITY_SIZE, report, group
        )
        for group in ACCIDENT_GROUPS
        if report.members(group)
    }


def _twins(dataset: DeepAccident, chosen: _Scenarios, **engine: Any) -> tuple[Any, Files]:
    return twin_report(dataset, chosen, **engine), {}


# Topic → what makes its report and further files, and the report's JSON file.
_TABLES: Final[dict[str, tuple[Callable[..., tuple[Any, Files]], str]]] = {
    "lead-time": (_lead_time, "lead_times.json"),
    "avoidability": (_avoidability, "avoidability.json"),
    "twins": (_twins, "twins.json"),
}
# Parameter → the topics that take it.
_OF_TOPIC: Final = {
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
    "released: the visibility rule of the released code. annotated: the label has the actor, hidden or not.",
)
@click.option(
    "--replays",
    default=str(REPLAYS),
    show_default=True,
    callback=_replay_count,
    metavar="N|all|none",
    help="Of report: how many accidents have a replay page, the hardest first. With images, a page takes up to 15 MB.",
)
@click.option(
    "--out",
    type=click.Path(),
    metavar="DIR",
    help="Folder to write into: the page with its files, or tables (JSON, CSV) and figures. Of describe: a JSON Lines "
    "file, with the facts and the text of each scenario.",
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

    SCENARIO, a token of the form TYPE/NAME, makes `describe` tell of this one alone. All is computed from labels and
    meta. What cannot be told is named with its reason, or left out. docs/safety.md says what numbers mean.
    """  # noqa: D301, D415 - \b is click's mark of lines that are not wrapped
    for name, topics in _OF_TOPIC.items():
        if topic not in topics:
            refuse_unused(f"with {topic}", name)
    scenario, kind, replays = (options.pop(name) for name in ("scenario", "kind", "replays"))
    if scenario is not None:
        refuse_unused("with a scenario", "where")
    if topic == "report" and out is None:
        raise click.UsageError("Missing option '--out': the folder of the page.")
    if topic == "describe" and out is not None and Path(out).is_dir():
        raise click.BadParameter(
            f"--out: {out} is a folder; give a file, such as {out}/stories.jsonl"
        )
    target = None if out is None else Path(out) if topic == "describe" else writable_folder(out)
    dataset, engine = DeepAccident(**options), engine_of(options)
    chosen = dataset.find(*where) if where else None
    if topic in _TABLES:
        make, name = _TABLES[topic]
        own = {"kind": kind} if topic in _OF_TOPIC["kind"] else {}
        report, files = make(dataset, chosen, **own, **engine)
        written = write_report(report, target, name)
        if target is not None:
            written += [write(target / file) for file, write in files.items()]
        say_report(report, written, target, as_json=as_json)
    elif topic == "describe":
        _describe(
            dataset, chosen if scenario is None else [scenario], target, as_json=as_json, **engine
        )
    elif target is not None:
        _report(dataset, chosen, target, replays, **engine)


def _describe(
    dataset: DeepAccident, chosen: _Scenarios, out: Path | None, *, as_json: bool, **engine: Any
) -> None:
    told = stories(dataset, chosen, **engine)
    lines = [json.dumps({**each.facts, "text": each.text}, allow_nan=False) for each in told]
    if out is not None:
        write_bytes(out, "".join(f"{line}\n" for line in lines).encode())
    for line, each in zip(lines, told, strict=True):
        click.echo(line if as_json else f"{each.facts['scenario']}\n  {each.text}")
        for reason in () if as_json else each.facts["unknown"]:
            click.echo(f"  not known: {reason}")
    if out is not None:
        click.echo(f"written: {counted(len(lines), 'scenario')} in {out}", err=as_json)


def _report(
    dataset: DeepAccident, chosen: _Scenarios, folder: Path, replays: int | None, **engine: Any
) -> None:
    if chosen is not None and not chosen:
        raise click.UsageError(
            "no scenario matches --where, so there is nothing to write; change it"
        )
    found = safety_report(dataset, chosen, progress=True, **engine)
    written = save_safety_report(
        found, folder, dataset=dataset, replays=replays, progress=True, **engine
    )
    left_out = (
        f"; {len(found.left_out)} reasons for what is left out are in the page"
        if found.left_out
        else ""
    )
    click.echo(
        f"{counted(len(found.rows), 'accident')} of {counted(found.scenarios, 'scenario')}{left_out}"
    )
    click.echo(
        f"written: {counted(len(written), 'file')} in {folder}; open {written[-1]} in a browser"
    )
