"""`save_study`: the files of a study's results, and their HTML page."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from deepaccident_devkit.plugins.study.figures import curves_figure, rows_figure, series_keys
from deepaccident_devkit.plugins.study.numbers import NUMBERS, verdict
from deepaccident_devkit.plugins.study.summary import (
    ALL,
    Counted,
    StudyReport,
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

PAGE_FILE: Final = "index.html"
_FIGURE_NOTE: Final = (
    "Intervals of 95 %, over pairs of an accident and its twin; the tables have the numbers."
)


def save_study(report: StudyReport, counted: Counted, folder: str | os.PathLike[str]) -> Path:
    """Write the results of a study into a folder; return the path of its page.

    `study.json` has all numbers, `counts.json.gz` the counts that they are computed from
    (`read_counts`), `tables/*.csv` a line for each number, `figures/*.png` pictures. Files of an
    earlier run are overwritten, each of them atomically; the page is written at the end.

    Raises:
        ConfigError: `folder` cannot be written to, or is not a folder.
        OutputFolderError: Its `figures` or `tables` is a link.
    """
    folder = writable_folder(folder)
    summary = report.summary
    write_counts(counted, folder / "counts.json.gz")
    report.to_csv(place_in(folder, "tables", opened=True))
    picture_folder = place_in(folder, "figures", opened=True)
    path = write_report_figure(rows_figure(summary), picture_folder / "rows.png")
    figures = [(path, "The rows.")]
    for key in series_keys(summary):
        figure = curves_figure(summary, key)
        path = write_report_figure(figure, picture_folder / f"over_{key}.png")
        figures.append((path, f"Over {key}."))
    write_bytes(folder / "study.json", (report.to_json() + "\n").encode())
    write_bytes(folder / PAGE_FILE, study_html(summary, figures).encode())
    return folder / PAGE_FILE


def study_html(summary: Mapping[str, Any], figures: Sequence[tuple[Path, str]]) -> str:
    """Return the complete page; `figures` are PNG files, which are embedded, with captions."""
    numbers = known_numbers(summary)
    groups = [group for group in summary["groups"] if group != ALL]
    pictures = []
    for path, caption in figures:
        text = f"{caption} {_FIGURE_NOTE}"
        pictures.append((read_bytes(path, "image"), text, text))
    return document(
        "study.html",
        style=page_style(),
        summary=summary,
        header=_header(summary),
        pictures=pictures,
        numbers=[NUMBERS[number][2] for number in numbers],
        rows=[
            [name, *(_cell(row["groups"][ALL][number], number) for number in numbers)]
            for name, row in summary["rows"].items()
        ],
        comparisons=_comparison_rows(summary),
        grouped={
            NUMBERS[number][2]: [
                [name, *(_cell(row["groups"][group][number], number) for group in groups)]
                for name, row in summary["rows"].items()
            ]
            for number in main_numbers(summary)
        },
        groups=[f"{group} ({summary['groups'][group]['pairs']} pairs)" for group in groups],
        cells=[
            [
                f"{cell['kind']}: {cell['name']}",
                cell["key"][:12],
                str(cell.get("fingerprint") or ""),
                f"{cell['seconds']:,.0f}",
            ]
            for cell in summary["cells"]
        ],
    )


def _header(summary: Mapping[str, Any]) -> dict[str, str]:
    """Return the facts at the top of the page, by their names."""
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


def _comparison_rows(summary: Mapping[str, Any]) -> list[list[Any]]:
    """Return a row for each main number of each compared pair of rows in each group."""
    main = main_numbers(summary)
    rows = []
    for comparison in summary["comparisons"]:
        pair = f"{comparison['row']} − {comparison['less']}"
        for group, differences in comparison["groups"].items():
            for number, difference in differences.items():
                if number in main:
                    seeds_text = _cell(difference, number)[1]
                    text = difference_text(difference, number)
                    name = NUMBERS[number][2]
                    rows.append([pair, group, name, (text, seeds_text), verdict(difference)])
    return rows


def _cell(estimate: Mapping[str, Any], number: str) -> tuple[str, str]:
    """Return the text of a number with its interval, and the text of its single seeds."""
    seed_texts = []
    for value in estimate["seeds"].values():
        seed_texts.append(number_with_interval({"value": value, "low": None}, number))
    return number_with_interval(estimate, number), ", ".join(seed_texts)
