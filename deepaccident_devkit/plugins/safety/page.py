"""`save_safety_report`: writes an HTML page on a release's accidents, with figures and replays."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import quote

from deepaccident_devkit.collisions.outcomes import OUTCOMES, Braking
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.plugins.safety import (
    COALITIONS,
    AccidentRow,
    OutcomeShares,
    SafetyReport,
)
from deepaccident_devkit.plugins.safety.avoidability_report import ACCIDENT_GROUPS
from deepaccident_devkit.plugins.safety.figures import render_avoidability, render_lead_times
from deepaccident_devkit.plugins.safety.lead_times import CAVEAT, partner_rows
from deepaccident_devkit.plugins.safety.report import CRITICAL_TTC, DECELERATIONS, actor_name
from deepaccident_devkit.render.figures import write_report_figure
from deepaccident_devkit.render.replay import tried_replay
from deepaccident_devkit.render.styles import page_style
from deepaccident_devkit.support.files import place_in, plain_names, writable_folder, write_bytes
from deepaccident_devkit.support.pages import document, part
from deepaccident_devkit.support.parallel import Engine, Places, run_batch
from deepaccident_devkit.support.reading import read_bytes
from deepaccident_devkit.support.scripts import bundled
from deepaccident_devkit.support.text import PathType, counted, number_text
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.taxonomy import AGENTS, FRAME_PERIOD, short_name

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from typing_extensions import Unpack

SAFETY_REPORT_FILE: Final = "report.html"
REPLAYS: Final = 10
"""Default number of replay pages."""
# Warning times in seconds that are the columns of the tables.
_LEAD_COLUMNS_S = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0)
_WARNED = {
    "ego": "ego is warned and brakes",
    "both": "both drivers are warned and brake",
    "first": "the first collider is warned and brakes",
    "second": "the second collider is warned and brakes",
}
# Warning times and braking of the summary at the top.
_SUMMARY_LEADS_S = (2.0, 3.0)
_SUMMARY_BRAKING = Braking(reaction=1.0, deceleration=6.0)
# Maximum number of rows in the tables of the largest margins and of the nearest pairs.
_MAX_ROWS = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class _Figure:
    """A figure of the report.

    Attributes:
        name: Name of its file.
        caption: Text below the figure, for all readers.
        alt: Alternative text for readers who cannot see the figure.
        draw: Function that draws the figure.
    """

    name: str
    caption: str
    alt: str
    draw: Callable[[], Figure]


def save_safety_report(
    report: SafetyReport,
    folder: PathType,
    *,
    dataset: Dataset | None = None,
    replays: int | None = REPLAYS,
    **engine: Unpack[Engine],
) -> list[Path]:
    """Write the page `report.html` into a folder, with its tables, figures and replay pages.

    `accidents.csv` and `safety.json` contain the page's rows. `figures/*.png` are its figures.
    `replays/*.html` are the pages that it links to, one per replayed accident (`render_replay`).
    Files of an earlier report in the folder are replaced. The page is written last; no file is ever
    left half-written.

    Args:
        report: Report returned by `safety_report`.
        folder: Output folder; it is created if it does not exist.
        dataset: The release, from which replay pages are rendered; None for no replay pages.
        replays: Number of accidents with a replay page, largest delta-v first; None for all. Each
            page takes a few seconds, and up to 15 MB if it contains images.
        **engine: `workers`, `executor` and `progress` of the replay pages; see `parallel.Engine`.
            The folder must be visible to an executor.

    Returns:
        Paths of the files written, the page last.

    Raises:
        ConfigError: If `folder` is not a folder, or cannot be written to.
        OutputFolderError: If the folder `figures` or `replays` is a link.
        ChoiceError: If `replays` is negative.
        ChoiceError, WorkerError: For the reasons given in `parallel.Engine`.
    """
    if replays is not None and replays < 0:
        raise ChoiceError(f"replays: expected 0 or more, or None for all, found {replays}")
    folder = writable_folder(folder)
    written = report.to_csv(folder)
    written.append(folder / "safety.json")
    write_bytes(written[-1], report.to_json().encode())
    figures_folder = place_in(folder, "figures", opened=True)
    pictures = []
    for figure in figures_of(report):
        path = write_report_figure(figure.draw, figures_folder / f"{figure.name}.png")
        written.append(path)
        pictures.append((figure, path))
    pages: dict[str, str] = {}
    failed: dict[str, str] = {}
    if dataset is not None:
        scenarios = [row.scenario for row in by_severity(report.rows)]
        names = replay_names(scenarios[:replays])
        failed = _make_replays(dataset, folder.absolute(), names, **engine)
        pages = {scenario: name for scenario, name in names.items() if scenario not in failed}
    written += [folder / name for name in pages.values()]
    page = safety_report_html(report, pictures, pages, sorted(failed.items()))
    written.append(folder / SAFETY_REPORT_FILE)
    write_bytes(written[-1], page.encode())
    return written


def safety_report_html(
    report: SafetyReport,
    figures: Sequence[tuple[_Figure, Path]],
    pages: Mapping[str, str],
    failed: Sequence[tuple[str, str]],
) -> str:
    """Render the complete page as HTML.

    Args:
        report: Report returned by `safety_report`.
        figures: Figures, each with its PNG file, which is embedded in the page.
        pages: Scenario → path of its replay page, relative to the report.
        failed: Scenarios whose replay page could not be written, each with the reason.
    """
    ledger = report.ledger
    avoidability = report.avoidability
    sets = [
        [", ".join(map(short_name, members)), mean.text, f"{mean.accidents:,}"]
        for members, mean in zip(COALITIONS, ledger.mean_leads, strict=True)
    ]
    largest = sorted(avoidability.margins.items(), key=lambda item: -item[1])[:_MAX_ROWS]
    torn_twins = []
    for twins in report.twins.torn:
        scenario, twin = twins.scenarios
        split, twin_split = twins.splits
        torn_twins.append([scenario, split, twin, twin_split])
    failed_replays = [(scenario, "replay pages", reason) for scenario, reason in failed]
    pictures = [(read_bytes(path, "image"), figure.alt, figure.caption) for figure, path in figures]
    return document(
        "safety_report.html",
        style=page_style(),
        script=bundled(part, "sorting"),
        report=report,
        header=_header(report),
        message=list(_message(report)),
        shares=list(_share_tables(report)),
        caveat=CAVEAT,
        partners=partner_rows(ledger),
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
    """Sort accidents by the larger delta-v, largest first."""
    by_scenario = sorted(rows, key=lambda row: row.scenario)
    return sorted(by_scenario, key=lambda row: -row.severity)


def _header(report: SafetyReport) -> dict[str, str]:
    """Return the page's header, name → text: what was examined, and how much of it."""
    avoidability = report.avoidability
    return {
        "release": f"{report.version}, {report.dataroot}",
        "scenarios": f"{report.scenarios:,}, {report.ledger.without_accident:,} without an "
        "accident",
        "accidents": f"{len(report.rows):,}, {len(avoidability.accidents):,} of them replayed",
        "excluded": _excluded_text(report),
        "observed": report.ledger.rule.text,
        "devkit": __version__,
    }


def _excluded_text(report: SafetyReport) -> str:
    """Say how many scenarios are excluded, and why; without reasons that exclude none."""
    counts = {
        "without a contact in the recording": len(report.avoidability.dropped),
        "without metadata or labels": len(report.avoidability.skipped),
        "broken": len(report.broken),
    }
    texts = [f"{count:,} {reason}" for reason, count in counts.items() if count]
    return ", ".join(texts) or "none"


def _message(report: SafetyReport) -> Iterator[str]:
    """Yield the sentences at the top of the page: who sees it when, and what braking avoids."""
    ledger = report.ledger
    if ledger.accidents:
        yield (
            f"On average, ego alone sees both colliders {ledger.mean_leads[0].mean:.1f} s before "
            f"the impact; all agents together see them {ledger.mean_together.mean:.1f} s before it."
        )
    indices = {lead: round(lead / FRAME_PERIOD) for lead in _SUMMARY_LEADS_S}
    for shares in report.avoidability.shares:
        is_known = max(indices.values()) < len(shares.leads) and _SUMMARY_BRAKING in shares.brakings
        if shares.warned != "both" or not is_known:
            continue
        column = shares.brakings.index(_SUMMARY_BRAKING)
        texts = []
        for lead, index in indices.items():
            avoided, _ = _share_cell(shares, index, column)
            texts.append(f"{avoided} with a warning {lead:g} s before the end")
        yield (
            f"Accidents avoided ({shares.group}), if both drivers brake with "
            f"{_SUMMARY_BRAKING.deceleration:g} m/s² after {_SUMMARY_BRAKING.reaction:g} s: "
            f"{' and '.join(texts)}."
        )


def _share_tables(report: SafetyReport) -> Iterator[NamedValues]:
    """Yield one table per group of accidents and choice of drivers: the share that braking avoids.

    The columns are warning times in seconds.
    """
    tables = report.avoidability.shares
    warned = list(_WARNED)
    groups = [shares.group for shares in tables]
    for shares in sorted(
        tables, key=lambda shares: (groups.index(shares.group), warned.index(shares.warned))
    ):
        index_by_lead = {}
        for lead in _LEAD_COLUMNS_S:
            index = round(lead / FRAME_PERIOD)
            if index < len(shares.leads):
                index_by_lead[f"{lead:g}"] = index
        rows = []
        for column, braking in enumerate(shares.brakings):
            cells = [_share_cell(shares, index, column) for index in index_by_lead.values()]
            label = f"reaction {braking.reaction:g} s, {braking.deceleration:g} m/s²"
            rows.append([label, *cells])
        counts = [f"{shares.accidents[index]:,}" for index in index_by_lead.values()]
        accidents = counted(shares.accidents.max(), "accident")
        yield {
            "title": f"{shares.group}: {_WARNED[shares.warned]} ({accidents})",
            "open": shares.group == tables[0].group and shares.warned in ("ego", "both"),
            "heading": ["warning time before the end (s)", *index_by_lead],
            "rows": [*rows, ["accidents with a long enough recording", *counts]],
        }


def _share_cell(shares: OutcomeShares, index: int, column: int) -> tuple[str, str]:
    """Return the share avoided; as a second line, the share with contact after the recording."""
    avoided = shares.shares[index, column, OUTCOMES.index("avoided")]
    hit_later = shares.extrapolated[index, column]
    second_line = ""
    if hit_later:
        second_line = f"{100 * hit_later:.0f} % later"
    return f"{100 * avoided:.0f} %", second_line


def _nearest_rows(report: SafetyReport) -> Iterator[list[str]]:
    """Yield a row for each accident-free recording with a near miss, the most critical first."""
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
    """Map each scenario to the path of its replay page, relative to the report.

    Paths consist of letters, digits, `_`, `-`, `.` and `/` only.
    """
    names = plain_names(scenarios)
    return {scenario: f"replays/{name}.html" for scenario, name in names.items()}


def _make_replays(
    dataset: Dataset, folder: Path, names: Mapping[str, str], **engine: Unpack[Engine]
) -> dict[str, str]:
    """Write the replay pages; return scenario → reason for the ones that failed."""
    places = Places(reads=dataset.places, writes=(folder,))
    work = partial(_make_replay, dataset, folder)
    items = list(names.items())
    reasons = run_batch(work, items, label="Writing replay pages", places=places, **engine)
    failed = {}
    for scenario, reason in zip(names, reasons, strict=True):
        if reason is not None:
            failed[scenario] = reason
    return failed


def _make_replay(dataset: Dataset, folder: Path, item: tuple[str, str]) -> str | None:
    """Write the replay page of a scenario; return the reason on failure, otherwise None."""
    scenario, name = item
    return tried_replay(dataset, scenario, place_in(folder, name))


def figures_of(report: SafetyReport) -> Iterator[_Figure]:
    """Yield the page's figures: the lead times, and one figure per group of accidents."""
    if report.ledger.accidents:
        yield _Figure(
            name="lead_times",
            caption="Mean lead times of ego with sets of partners, and what each partner adds.",
            alt="Mean lead times by set of agents and Shapley values of the partners; the tables "
            "have the numbers.",
            draw=partial(render_lead_times, report.ledger),
        )
    for group in ACCIDENT_GROUPS:
        if report.avoidability.members(group):
            yield _Figure(
                name=f"avoidability_{group.replace('-', '_')}",
                caption=f"{group}: share of the accidents avoided, and speed at the contact, by "
                "warning time.",
                alt=f"{group}: share of the accidents avoided by warning time; the tables have the "
                "numbers.",
                draw=partial(render_avoidability, report.avoidability, group),
            )
