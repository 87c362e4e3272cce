"""`save_study`: the files of a study's results, and a page on them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from deepaccident_devkit.plugins.study.figures import curves_figure, curves_of, rows_figure
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


def save_study(report: StudyReport, counted: Counted, folder: str | os.PathLike[str]) -> Path:
    """Write what came out of a study into a folder, over what an earlier run wrote there; returns the page's path.

    `study.json` has all numbers, `counts.json.gz` what they follow from (`read_counts`), `tables/*.csv` a line for each
    number, `figures/*.png` pictures. Each file is whole or not there, and the page comes last.

    Raises:
        ConfigError: `folder` cannot be written to, or is not one.
        OutputFolderError: its `figures` or `tables` is a link.
    """
    folder, summary = writable_folder(folder), report.summary
    write_counts(counted, folder / "counts.json.gz")
    report.to_csv(place_in(folder, "tables", opened=True))
    pictures = place_in(folder, "figures", opened=True)
    drawn = [(write_report_figure(rows_figure(summary), pictures / "rows.png"), "The rows.")]
    for key in curves_of(summary):
        path = pictures / f"over_{key}.png"
        drawn.append((write_report_figure(curves_figure(summary, key), path), f"Over {key}."))
    write_bytes(folder / "study.json", (report.to_json() + "\n").encode())
    write_bytes(folder / PAGE_FILE, study_html(summary, drawn).encode())
    return folder / PAGE_FILE


def study_html(summary: Mapping[str, Any], figures: Sequence[tuple[Path, str]]) -> str:
    """The complete page; `figures` are PNG files, which become part of it, with what they show."""
    words = (
        "Intervals of 95 %, over pairs of an accident and its twin; the tables have the numbers."
    )
    tested, groups = summary["groups"][ALL], [group for group in summary["groups"] if group != ALL]
    return document(
        "study.html",
        style=page_style(),
        summary=summary,
        header={
            "question": summary["question"],
            "test": f"{tested['samples']:,} samples of {tested['pairs']:,} pairs of an accident and its twin"
            + ", which the training may have shown"
            * summary["recipe"]["test"]["includes_training"],
            "recipe": summary["recipe"]["name"],
            "devkit": summary["devkit"],
            "hours of one process": f"{sum(each['seconds'] for each in summary['cells']) / 3600:.2f}",
            "made on": "; ".join(sorted({each["machine"] for each in summary["cells"]})),
        },
        pictures=[
            (read_bytes(path, "image"), f"{said} {words}", f"{said} {words}")
            for path, said in figures
        ],
        numbers=[NUMBERS[number][2] for number in known_numbers(summary)],
        rows=[
            [
                name,
                *(_cell(each["groups"][ALL][number], number) for number in known_numbers(summary)),
            ]
            for name, each in summary["rows"].items()
        ],
        comparisons=[
            [
                f"{each['row']} − {each['less']}",
                group,
                NUMBERS[number][2],
                (difference_text(found, number), _cell(found, number)[1]),
                verdict(found),
            ]
            for each in summary["comparisons"]
            for group, numbers in each["groups"].items()
            for number, found in numbers.items()
            if number in main_numbers(summary)
        ],
        grouped={
            NUMBERS[number][2]: [
                [name, *(_cell(each["groups"][group][number], number) for group in groups)]
                for name, each in summary["rows"].items()
            ]
            for number in main_numbers(summary)
        },
        groups=[f"{group} ({summary['groups'][group]['pairs']} pairs)" for group in groups],
        cells=[
            [
                f"{each['kind']}: {each['name']}",
                each["key"][:12],
                str(each.get("fingerprint") or ""),
                f"{each['seconds']:,.0f}",
            ]
            for each in summary["cells"]
        ],
    )


def _cell(found: Mapping[str, Any], number: str) -> tuple[str, str]:
    """A number with its interval, and below it those of single seeds."""
    alone = (
        number_with_interval({"value": each, "low": None}, number)
        for each in found["seeds"].values()
    )
    return number_with_interval(found, number), ", ".join(alone)
