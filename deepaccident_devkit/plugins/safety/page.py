"""`save_safety_report`: one HTML page of a release's accidents, its figures and tables as files, and replay pages."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import quote

from deepaccident_devkit.collisions import OUTCOMES
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.plugins.safety import (
    COALITIONS,
    PARTNERS,
    AccidentRow,
    OutcomeShares,
    SafetyReport,
)
from deepaccident_devkit.plugins.safety.avoidability_report import ACCIDENT_GROUPS
from deepaccident_devkit.plugins.safety.figures import (
    AVOIDABILITY_SIZE,
    COLUMN_HEIGHT,
    LEAD_TIME_SIZE,
    render_avoidability,
    render_lead_times,
)
from deepaccident_devkit.plugins.safety.lead_times import CAVEAT
from deepaccident_devkit.plugins.safety.report import CRITICAL_TTC, DECELERATIONS, actor_name
from deepaccident_devkit.render.figures import report_figure, write_report_figure
from deepaccident_devkit.render.replay import tried_replay
from deepaccident_devkit.render.styles import page_style
from deepaccident_devkit.support.files import place_in, plain_names, writable_folder, write_bytes
from deepaccident_devkit.support.pages import document, part
from deepaccident_devkit.support.parallel import Engine, Places, run_batch
from deepaccident_devkit.support.reading import read_bytes
from deepaccident_devkit.support.scripts import bundled
from deepaccident_devkit.support.text import number_text
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.taxonomy import AGENTS, short_name

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from typing_extensions import Unpack

SAFETY_REPORT_FILE: Final = "report.html"
REPLAYS: Final = 10
"""Replay pages that are made if nobody says how many."""
# Seconds of warning that the tables have columns for.
_LEADS: Final = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0)
_WARNED: Final = {
    "ego": "the ego is warned and brakes",
    "both": "both are warned and brake",
    "first": "the first is warned and brakes",
    "second": "the second is warned and brakes",
}
# Rows of the tables of the largest and the least.
_LISTED: Final = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class _Drawn:
    """A figure of the report: the name of its file, what it shows, the same for who cannot see it, and its maker."""

    name: str
    caption: str
    alt: str
    draw: Callable[[], Figure]


def save_safety_report(
    report: SafetyReport,
    folder: str | os.PathLike[str],
    *,
    dataset: Dataset | None = None,
    replays: int | None = REPLAYS,
    **how: Unpack[Engine],
) -> list[Path]:
    """Write the page `report.html` into a folder, beside it tables, figures and replay pages.

    `accidents.csv` and `safety.json` have the page's rows, `figures/*.png` its figures, and `replays/*.html` the pages
    that it links to, a page an accident (`render_replay`). Files of an earlier report there are replaced; each file is
    whole or not there, and the page comes last.

    Args:
        report: of `safety_report`.
        folder: where; it is made if it is not there.
        dataset: the release, for replay pages; None for none.
        replays: how many accidents have a replay page, those with the largest delta-v; None for all. A page takes some
            seconds and up to 15 MB if there are images.
        **how: `workers`, `executor` and `progress` of the replay pages, as `parallel.Engine` says; an executor must see
            the folder.

    Returns:
        The files written, the page last.

    Raises:
        ConfigError: `folder` cannot be written to, or is not one.
        OutputFolderError: its `figures` or `replays` is a link.
        ChoiceError: `replays` is negative.
        ChoiceError, WorkerError: as `parallel.Engine` says.
    """
    if replays is not None and replays < 0:
        raise ChoiceError(f"replays: expected 0 or more, or None for all, found {replays}")
    folder = writable_folder(folder)
    written = report.to_csv(folder)
    written.append(folder / "safety.json")
    write_bytes(written[-1], report.to_json().encode())
    drawn, pictures = list(figures_of(report)), place_in(folder, "figures", opened=True)
    figures = [
        (each, write_report_figure(each.draw(), pictures / f"{each.name}.png")) for each in drawn
    ]
    names = (
        {}
        if dataset is None
        else replay_names([row.scenario for row in by_severity(report.rows)][:replays])
    )
    failed = {} if dataset is None else _make_replays(dataset, folder.absolute(), names, **how)
    pages = {scenario: name for scenario, name in names.items() if scenario not in failed}
    write_bytes(
        folder / SAFETY_REPORT_FILE,
        safety_report_html(report, figures, pages, sorted(failed.items())).encode(),
    )
    return [
        *written,
        *(path for _, path in figures),
        *(folder / name for name in pages.values()),
        folder / SAFETY_REPORT_FILE,
    ]


def safety_report_html(
    report: SafetyReport,
    figures: Sequence[tuple[_Drawn, Path]],
    pages: Mapping[str, str],
    failed: Sequence[tuple[str, str]],
) -> str:
    """The complete page.

    Args:
        report: of `safety_report`.
        figures: with their PNG files, which become part of the page.
        pages: scenario → path of its replay page, relative to the report.
        failed: scenarios of which no replay page could be made, and why.
    """
    largest = sorted(report.avoidability.margins.items(), key=lambda each: -each[1])[:_LISTED]
    return document(
        "safety_report.html",
        style=page_style(),
        script=bundled(part, "sorting"),
        report=report,
        header=_header(report),
        shares=list(_shares(report)),
        caveat=CAVEAT,
        partners=[
            [short_name(name), *(mean.text for mean in means)]
            for name, *means in zip(
                PARTNERS,
                report.ledger.mean_gains,
                report.ledger.mean_losses,
                report.ledger.mean_shapley,
                strict=True,
            )
        ],
        sets=[
            [", ".join(map(short_name, members)), mean.text, f"{mean.accidents:,}"]
            for members, mean in zip(COALITIONS, report.ledger.mean_leads, strict=True)
        ],
        gaps=[[name, f"{count:,}"] for name, count in report.avoidability.margin_counts.items()],
        largest=[[name, number_text(gap, 3)] for name, gap in largest],
        nearest=list(_nearest(report))[:_LISTED],
        torn_twins=[
            [each.scenarios[0], each.splits[0], each.scenarios[1], each.splits[1]]
            for each in report.twins.torn
        ],
        left_out=[
            *report.left_out,
            *((scenario, "replay pages", reason) for scenario, reason in failed),
        ],
        pictures=[(read_bytes(path, "image"), each.alt, each.caption) for each, path in figures],
        rows=by_severity(report.rows),
        pages={scenario: quote(name) for scenario, name in pages.items()},
        agents=AGENTS,
        decelerations=DECELERATIONS,
        critical_ttc=CRITICAL_TTC,
    )


def by_severity(rows: Iterable[AccidentRow]) -> list[AccidentRow]:
    """The accidents with the largest delta-v first."""
    return sorted(rows, key=lambda row: (-row.severity, row.scenario))


def _header(report: SafetyReport) -> dict[str, str]:
    """What was looked at, and how much of it."""
    avoidability = report.avoidability
    return {
        "release": f"{report.version}, {report.dataroot}",
        "scenarios": f"{report.scenarios:,}, {report.ledger.without_accident:,} without an accident",
        "accidents": f"{len(report.rows):,}, {len(avoidability.accidents):,} of them replayed",
        "left out": f"{len(avoidability.dropped):,} not shown by their recording, {len(avoidability.skipped):,} "
        f"without meta or labels, {len(report.broken):,} broken",
        "observed": report.ledger.rule.text,
        "devkit": __version__,
    }


def _shares(report: SafetyReport) -> Iterator[dict[str, Any]]:
    """A table of the shares that braking avoids, by the seconds of warning, for each group and for who is warned."""
    shares = report.avoidability.shares
    order = [each.group for each in shares], list(_WARNED)
    for each in sorted(
        shares, key=lambda each: (order[0].index(each.group), order[1].index(each.warned))
    ):
        leads = [(lead, round(lead * 10)) for lead in _LEADS if round(lead * 10) < len(each.leads)]
        rows = [
            [
                f"reaction {way.reaction:g} s, {way.deceleration:g} m/s²",
                *(_share(each, at, column) for _, at in leads),
            ]
            for column, way in enumerate(each.brakings)
        ]
        counts = ["accidents recorded for so long", *(f"{each.accidents[at]:,}" for _, at in leads)]
        yield {
            "title": f"{each.group}: {_WARNED[each.warned]} ({each.accidents.max():,} accidents)",
            "open": each.group == shares[0].group and each.warned in ("ego", "both"),
            "heading": ["warned before the end (s)", *(f"{lead:g}" for lead, _ in leads)],
            "rows": [*rows, counts],
        }


def _share(shares: OutcomeShares, at: int, column: int) -> tuple[str, str]:
    """The share avoided, and below it the share that is hit only later."""
    share, later = (
        shares.shares[at, column, OUTCOMES.index("avoided")],
        shares.extrapolated[at, column],
    )
    return f"{100 * share:.0f} %", f"{100 * later:.0f} % later" if later else ""


def _nearest(report: SafetyReport) -> Iterator[list[str]]:
    """The normal recordings in which two come near a collision, the nearest first."""
    for story in report.normal:
        if (nearest := story.facts["nearest"]) is not None:
            numbers = (number_text(nearest[name], 2) for name in ("min_ttc", "min_gap"))
            yield [
                story.facts["scenario"],
                *numbers,
                " and ".join(map(actor_name, nearest["pair"])),
            ]


def replay_names(scenarios: Iterable[str]) -> dict[str, str]:
    """Scenario → path of its replay page, relative to the report: letters, digits, `_`, `-` and `.` alone."""
    return {scenario: f"replays/{name}.html" for scenario, name in plain_names(scenarios).items()}


def _make_replays(
    dataset: Dataset, folder: Path, names: Mapping[str, str], **how: Unpack[Engine]
) -> dict[str, str]:
    """Write the replay pages; scenario → why it has none, of those where a file cannot be read."""
    places = Places(reads=dataset.places, writes=(folder,))
    work = partial(_make_replay, dataset, folder)
    reasons = run_batch(work, list(names.items()), label="replay pages", places=places, **how)
    return {
        scenario: reason
        for scenario, reason in zip(names, reasons, strict=True)
        if reason is not None
    }


def _make_replay(dataset: Dataset, folder: Path, named: tuple[str, str]) -> str | None:
    scenario, name = named
    return tried_replay(dataset, scenario, place_in(folder, name))


def figures_of(report: SafetyReport) -> Iterator[_Drawn]:
    """The page's figures: one of each group of accidents, and lead times."""
    if report.ledger.accidents:
        yield _Drawn(
            name="lead_times",
            caption="Mean lead times of sets of agents with the ego, and what each partner adds.",
            alt="Mean lead times by set of agents and Shapley values of the partners; the tables have the numbers.",
            draw=lambda: render_lead_times(
                report.ledger, fig=report_figure(LEAD_TIME_SIZE, column=COLUMN_HEIGHT)
            ),
        )
    for group in ACCIDENT_GROUPS:
        if report.avoidability.members(group):
            yield _Drawn(
                name=f"avoidability_{group.replace('-', '_')}",
                caption=f"{group}: share avoided, and speed at the contact, over the seconds of warning.",
                alt=f"{group}: share of accidents avoided over the seconds of warning; the tables have the numbers.",
                draw=partial(_draw_avoidability, report, group),
            )


def _draw_avoidability(report: SafetyReport, group: str) -> Figure:
    return render_avoidability(
        report.avoidability, group, fig=report_figure(AVOIDABILITY_SIZE, column=COLUMN_HEIGHT)
    )
