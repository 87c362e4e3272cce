"""`save_study`: writes the results of a study to files, with an HTML page."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from deepaccident_devkit.plugins.study.figures import curves_figure, rows_figure, series_keys
from deepaccident_devkit.plugins.study.numbers import NUMBERS, verdict
from deepaccident_devkit.plugins.study.summary import (
    ALL,
    Counted,
    StudyReport,
    Summary,
    difference_text,
    known_numbers,
    main_numbers,
    number_with_interval,
    write_counts,
)
from deepaccident_devkit.render.figures import write_report_figure
from deepaccident_devkit.render.styles import page_style
from deepaccident_devkit.support.files import place_in, writable_folder, write_bytes
from deepaccident_devkit.support.pages import document
from deepaccident_devkit.support.reading import read_bytes
from deepaccident_devkit.support.text import PathType

PAGE_FILE = "index.html"
_FIGURE_NOTE = (
    "95 % confidence intervals over pairs of an accident and its twin; the tables have the numbers."
)


def save_study(report: StudyReport, counted: Counted, folder: PathType) -> Path:
    """Write the results of a study into a folder, and return the path of its page.

    `study.json` contains all numbers; `counts.json.gz` the counts behind them (`read_counts`);
    `tables/*.csv` one line per number; `figures/*.png` the figures. Files of an earlier run are
    overwritten, each atomically. The page is written last.

    Raises:
        ConfigError: If `folder` is not a folder, or cannot be written to.
        OutputFolderError: If the folder `figures` or `tables` is a link.
    """
    folder = writable_folder(folder)
    summary = report.summary
    write_counts(counted, folder / "counts.json.gz")
    report.to_csv(place_in(folder, "tables", opened=True))
    picture_folder = place_in(folder, "figures", opened=True)
    path = write_report_figure(partial(rows_figure, summary), picture_folder / "rows.png")
    figures = [(path, "The rows.")]
    for key in series_keys(summary):
        draw = partial(curves_figure, summary, key)
        path = write_report_figure(draw, picture_folder / f"over_{key}.png")
        figures.append((path, f"Over {key}."))
    write_bytes(folder / "study.json", (report.to_json() + "\n").encode())
    write_bytes(folder / PAGE_FILE, study_html(summary, figures).encode())
    return folder / PAGE_FILE


def study_html(summary: Summary, figures: Sequence[tuple[Path, str]]) -> str:
    """Render the complete page as HTML.

    Args:
        summary: The report's summary.
        figures: PNG files, which are embedded in the page, each with its caption.
    """
    numbers = known_numbers(summary)
    groups = [group for group in summary["groups"] if group != ALL]
    pictures = []
    for path, caption in figures:
        text = f"{caption} {_FIGURE_NOTE}"
        pictures.append((read_bytes(path, "image"), text, text))
    rows = []
    for name, row in summary["rows"].items():
        estimates = row["groups"][ALL]
        rows.append([name, *(_cell_texts(estimates[number], number) for number in numbers)])
    tables_by_group = {}
    for number in main_numbers(summary):
        table = []
        for name, row in summary["rows"].items():
            estimates = [row["groups"][group][number] for group in groups]
            table.append([name, *(_cell_texts(estimate, number) for estimate in estimates)])
        tables_by_group[NUMBERS[number][2]] = table
    cells = []
    for cell in summary["cells"]:
        fingerprint = str(cell.get("fingerprint") or "")
        name = f"{cell['kind']}: {cell['name']}"
        cells.append([name, cell["key"][:12], fingerprint, f"{cell['seconds']:,.0f}"])
    return document(
        "study.html",
        style=page_style(),
        summary=summary,
        header=_header(summary),
        pictures=pictures,
        numbers=[NUMBERS[number][2] for number in numbers],
        rows=rows,
        comparisons=_comparison_rows(summary),
        grouped=tables_by_group,
        groups=[f"{group} ({summary['groups'][group]['pairs']} pairs)" for group in groups],
        cells=cells,
    )


def _header(summary: Summary) -> dict[str, str]:
    """Return the facts at the top of the page, name → text."""
    test_group = summary["groups"][ALL]
    test = (
        f"{test_group['samples']:,} samples of {test_group['pairs']:,} pairs of an accident and "
        "its twin"
    )
    if summary["recipe"]["test"]["includes_training"]:
        test += ", which the training may have shown"
    hours = sum(cell["seconds"] for cell in summary["cells"]) / 3600
    machines = sorted({cell["machine"] for cell in summary["cells"]})
    return {
        "question": summary["question"],
        "test": test,
        "recipe": summary["recipe"]["name"],
        "devkit": summary["devkit"],
        "hours of one process": f"{hours:.2f}",
        "made on": "; ".join(machines),
    }


def _comparison_rows(summary: Summary) -> list[list[Any]]:
    """Return a row per compared pair, group and main number."""
    main = main_numbers(summary)
    rows = []
    for comparison in summary["comparisons"]:
        pair = f"{comparison['row']} − {comparison['less']}"
        for group, differences in comparison["groups"].items():
            for number, difference in differences.items():
                if number in main:
                    _, seeds_text = _cell_texts(difference, number)
                    text = difference_text(difference, number)
                    name = NUMBERS[number][2]
                    rows.append([pair, group, name, (text, seeds_text), verdict(difference)])
    return rows


def _cell_texts(estimate: Summary, number: str) -> tuple[str, str]:
    """Format a number with its interval, and the values of its single seeds."""
    seed_texts = []
    for value in estimate["seeds"].values():
        seed_texts.append(number_with_interval({"value": value, "low": None}, number))
    return number_with_interval(estimate, number), ", ".join(seed_texts)
