"""`save_safety_report`: an HTML page of a release's accidents, with figures and replays."""

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
"""Number of replay pages by default."""
# Columns of the tables: seconds of warning.
_LEAD_COLUMNS_S: Final = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0)
_WARNED: Final = {
    "ego": "the ego is warned and brakes",
    "both": "both are warned and brake",
    "first": "the first is warned and brakes",
    "second": "the second is warned and brakes",
}
# Largest number of rows of the tables of the largest gaps and of the nearest pairs.
_MAX_ROWS: Final = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class _Figure:
    """A figure of the report.

    Attributes:
        name: Name of its file.
        caption: What it shows.
        alt: The same for readers that cannot see it.
        draw: Function that draws it.
    """

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
    **engine: Unpack[Engine],
) -> list[Path]:
    """Write the page `report.html` into a folder, with its tables, figures and replay pages.

    `accidents.csv` and `safety.json` have the page's rows, `figures/*.png` its figures, and
    `replays/*.html` the pages that it links to, one for each accident (`render_replay`). Files of
    an earlier report there are replaced; each file is complete or missing, and the page comes last.

    Args:
        report: Report of `safety_report`.
        folder: Output folder; it is created if it does not exist.
        dataset: The release, for replay pages; None for none.
        replays: Number of accidents with a replay page, by the largest delta-v; None for all. A
            page takes some seconds and up to 15 MB if there are images.
        **engine: `workers`, `executor` and `progress` of the replay pages; see `parallel.Engine`.
            The folder must be visible to an executor.

    Returns:
        The files written, the page last.

    Raises:
        ConfigError: `folder` cannot be written to, or is not a folder.
        OutputFolderError: Its `figures` or `replays` is a link.
        ChoiceError: `replays` is negative.
        ChoiceError, WorkerError: See `parallel.Engine`.
    """
    if replays is not None and replays < 0:
        raise ChoiceError(f"replays: expected 0 or more, or None for all, found {replays}")
    folder = writable_folder(folder)
    written = report.to_csv(folder)
    written.append(folder / "safety.json")
    write_bytes(written[-1], report.to_json().encode())
    figures = list(figures_of(report))
    figures_folder = place_in(folder, "figures", opened=True)
    figure_paths = [
        write_report_figure(figure.draw(), figures_folder / f"{figure.name}.png")
        for figure in figures
    ]
    pages: dict[str, str] = {}
    failed: dict[str, str] = {}
    if dataset is not None:
        scenarios = [row.scenario for row in by_severity(report.rows)][:replays]
        names = replay_names(scenarios)
        failed = _make_replays(dataset, folder.absolute(), names, **engine)
        pages = {scenario: name for scenario, name in names.items() if scenario not in failed}
    pictures = list(zip(figures, figure_paths, strict=True))
    page = safety_report_html(report, pictures, pages, sorted(failed.items()))
    write_bytes(folder / SAFETY_REPORT_FILE, page.encode())
    return [
        *written,
        *figure_paths,
        *(folder / name for name in pages.values()),
        folder / SAFETY_REPORT_FILE,
    ]


def safety_report_html(
    report: SafetyReport,
    figures: Sequence[tuple[_Figure, Path]],
    pages: Mapping[str, str],
    failed: Sequence[tuple[str, str]],
) -> str:
    """Return the complete page.

    Args:
        report: Report of `safety_report`.
        figures: Figures and their PNG files, which become part of the page.
        pages: Scenario → path of its replay page, relative to the report.
        failed: Scenarios without a replay page because of an error, and the reasons.
    """
    ledger, avoidability = report.ledger, report.avoidability
    means = zip(PARTNERS, ledger.mean_gains, ledger.mean_losses, ledger.mean_shapley, strict=True)
    partners = [
        [short_name(name), gain.text, loss.text, shapley.text]
        for name, gain, loss, shapley in means
    ]
    sets = [
        [", ".join(map(short_name, members)), mean.text, f"{mean.accidents:,}"]
        for members, mean in zip(COALITIONS, ledger.mean_leads, strict=True)
    ]
    largest = sorted(avoidability.margins.items(), key=lambda item: -item[1])[:_MAX_ROWS]
    torn_twins = [
        [twins.scenarios[0], twins.splits[0], twins.scenarios[1], twins.splits[1]]
        for twins in report.twins.torn
    ]
    failed_replays = [(scenario, "replay pages", reason) for scenario, reason in failed]
    pictures = [(read_bytes(path, "image"), figure.alt, figure.caption) for figure, path in figures]
    return document(
        "safety_report.html",
        style=page_style(),
        script=bundled(part, "sorting"),
        report=report,
        header=_header(report),
        shares=list(_share_tables(report)),
        caveat=CAVEAT,
        partners=partners,
        sets=sets,
        gaps=[[name, f"{count:,}"] for name, count in avoidability.margin_counts.items()],
        largest=[[name, number_text(gap, 3)] for name, gap in largest],
        nearest=list(_nearest_rows(report))[:_MAX_ROWS],
        torn_twins=torn_twins,
        left_out=[*report.left_out, *failed_replays],
        pictures=pictures,
        rows=by_severity(report.rows),
        pages={scenario: quote(name) for scenario, name in pages.items()},
        agents=AGENTS,
        decelerations=DECELERATIONS,
        critical_ttc=CRITICAL_TTC,
    )


def by_severity(rows: Iterable[AccidentRow]) -> list[AccidentRow]:
    """Return the accidents, the largest delta-v first."""
    return sorted(rows, key=lambda row: (-row.severity, row.scenario))


def _header(report: SafetyReport) -> dict[str, str]:
    """Return what was examined, and how much of it."""
    avoidability = report.avoidability
    return {
        "release": f"{report.version}, {report.dataroot}",
        "scenarios": f"{report.scenarios:,}, {report.ledger.without_accident:,} without an "
        "accident",
        "accidents": f"{len(report.rows):,}, {len(avoidability.accidents):,} of them replayed",
        "left out": f"{len(avoidability.dropped):,} not shown by their recording, "
        f"{len(avoidability.skipped):,} without meta or labels, {len(report.broken):,} broken",
        "observed": report.ledger.rule.text,
        "devkit": __version__,
    }


def _share_tables(report: SafetyReport) -> Iterator[dict[str, Any]]:
    """Yield a table of the shares that braking avoids for each group and way to warn drivers.

    Columns are seconds of warning.
    """
    tables = report.avoidability.shares
    groups, warned = [shares.group for shares in tables], list(_WARNED)

    def order(shares: OutcomeShares) -> tuple[int, int]:
        return groups.index(shares.group), warned.index(shares.warned)

    for shares in sorted(tables, key=order):
        indices = [(lead, round(lead * 10)) for lead in _LEAD_COLUMNS_S]
        leads = [(lead, index) for lead, index in indices if index < len(shares.leads)]
        rows = []
        for column, braking in enumerate(shares.brakings):
            cells = [_share_cell(shares, index, column) for _, index in leads]
            label = f"reaction {braking.reaction:g} s, {braking.deceleration:g} m/s²"
            rows.append([label, *cells])
        counts = [f"{shares.accidents[index]:,}" for _, index in leads]
        accidents = f"({shares.accidents.max():,} accidents)"
        yield {
            "title": f"{shares.group}: {_WARNED[shares.warned]} {accidents}",
            "open": shares.group == tables[0].group and shares.warned in ("ego", "both"),
            "heading": ["warned before the end (s)", *(f"{lead:g}" for lead, _ in leads)],
            "rows": [*rows, ["accidents recorded for so long", *counts]],
        }


def _share_cell(shares: OutcomeShares, index: int, column: int) -> tuple[str, str]:
    """Return the share avoided, and for the line below it the share that is hit only later."""
    avoided = shares.shares[index, column, OUTCOMES.index("avoided")]
    later = shares.extrapolated[index, column]
    return f"{100 * avoided:.0f} %", f"{100 * later:.0f} % later" if later else ""


def _nearest_rows(report: SafetyReport) -> Iterator[list[str]]:
    """Yield the normal recordings in which two actors come near a collision, the nearest first."""
    for story in report.normal:
        nearest = story.facts["nearest"]
        if nearest is not None:
            yield [
                story.facts["scenario"],
                number_text(nearest["min_ttc"], 2),
                number_text(nearest["min_gap"], 2),
                " and ".join(map(actor_name, nearest["pair"])),
            ]


def replay_names(scenarios: Iterable[str]) -> dict[str, str]:
    """Return scenario → path of its replay page, relative to the report.

    Paths only have letters, digits, `_`, `-` and `.`.
    """
    return {scenario: f"replays/{name}.html" for scenario, name in plain_names(scenarios).items()}


def _make_replays(
    dataset: Dataset, folder: Path, names: Mapping[str, str], **engine: Unpack[Engine]
) -> dict[str, str]:
    """Write the replay pages; return scenario → reason for pages that cannot be made."""
    places = Places(reads=dataset.places, writes=(folder,))
    work = partial(_make_replay, dataset, folder)
    items = list(names.items())
    reasons = run_batch(work, items, label="replay pages", places=places, **engine)
    return {
        scenario: reason
        for scenario, reason in zip(names, reasons, strict=True)
        if reason is not None
    }


def _make_replay(dataset: Dataset, folder: Path, item: tuple[str, str]) -> str | None:
    scenario, name = item
    return tried_replay(dataset, scenario, place_in(folder, name))


def figures_of(report: SafetyReport) -> Iterator[_Figure]:
    """Yield the page's figures: one of lead times, and one of each group of accidents."""
    if report.ledger.accidents:
        yield _Figure(
            name="lead_times",
            caption="Mean lead times of sets of agents with the ego, and what each partner adds.",
            alt="Mean lead times by set of agents and Shapley values of the partners; the tables "
            "have the numbers.",
            draw=partial(_draw_lead_times, report),
        )
    for group in ACCIDENT_GROUPS:
        if report.avoidability.members(group):
            yield _Figure(
                name=f"avoidability_{group.replace('-', '_')}",
                caption=f"{group}: share avoided, and speed at the contact, over the seconds of "
                "warning.",
                alt=f"{group}: share of accidents avoided over the seconds of warning; the tables "
                "have the numbers.",
                draw=partial(_draw_avoidability, report, group),
            )


def _draw_lead_times(report: SafetyReport) -> Figure:
    fig = report_figure(LEAD_TIME_SIZE, column=COLUMN_HEIGHT)
    return render_lead_times(report.ledger, fig=fig)


def _draw_avoidability(report: SafetyReport, group: str) -> Figure:
    fig = report_figure(AVOIDABILITY_SIZE, column=COLUMN_HEIGHT)
    return render_avoidability(report.avoidability, group, fig=fig)
