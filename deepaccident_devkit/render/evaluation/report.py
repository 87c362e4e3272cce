"""`save_report`: one HTML file with the whole evaluation, and its figures as PNG files."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.runs import EvaluationRun
from deepaccident_devkit.files import path_of, place_in, write_bytes
from deepaccident_devkit.pages import document
from deepaccident_devkit.reading import read_bytes
from deepaccident_devkit.render.evaluation.figures import RunFigure, run_figures, save_figure
from deepaccident_devkit.render.evaluation.samples import sample_figures
from deepaccident_devkit.render.evaluation.sections import report_context
from deepaccident_devkit.render.theme import page_style

REPORT_FILE: Final = "report.html"
FIGURES_FOLDER: Final = "figures"


def save_report(
    run: EvaluationRun,
    folder: str | os.PathLike[str],
    *,
    dataset: Dataset | None = None,
    results: Results | None = None,
) -> Path:
    """Write `report.html` and `figures/*.png` into a folder; the same run makes the same bytes.

    The report needs no other file: it can be sent as it is. In a partial run each section and each figure says that it
    is partial.

    Args:
        run: of `evaluate_results`.
        folder: where; it is made if it is not there, and files of an earlier report there are replaced.
        dataset: the release; with it and `results` the report also shows the worst and the best samples.
        results: the predictions that were evaluated.

    Returns:
        The report's path.

    Raises:
        ConfigError: the folder is a file.
        OutputFolderError: its `figures` is a link.
    """
    target = path_of(folder)
    if target.exists() and not target.is_dir():
        raise ConfigError(f"{target}: is a file; give a folder")
    drawn = [*run_figures(run)]
    if dataset is not None and results is not None:
        drawn += sample_figures(run, dataset, results)
    pictures = place_in(target, FIGURES_FOLDER, opened=True)
    figures = [(each, save_figure(run, each, pictures)) for each in drawn]
    write_bytes(target / REPORT_FILE, report_html(run, figures).encode())
    return target / REPORT_FILE


def report_html(run: EvaluationRun, figures: Sequence[tuple[RunFigure, Path]]) -> str:
    """The complete page.

    Args:
        run: of `evaluate_results`.
        figures: with their PNG files, which become part of the page.
    """
    pictures = [(read_bytes(path, "image"), each.alt, each.caption) for each, path in figures]
    return document("evaluation_report.html", style=page_style(), pictures=pictures, **report_context(run))
