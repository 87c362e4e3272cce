"""Studies: what a recipe trains and compares, cell by cell, with tables, figures and a page (docs/studies.md).

`recipe` (what is asked), `cells` (what is made once, and kept), `predict` (what a row predicts), `numbers` (of rows and
their differences), `summary` (all of them, from counts), `figures`, `page`, and `run`, which does all of it.
"""

from deepaccident_devkit.plugins.study.recipe import Recipe, read_recipe
from deepaccident_devkit.plugins.study.run import run_study
from deepaccident_devkit.plugins.study.summary import Counted, StudyReport, read_counts, summarised

__all__ = [
    "Counted",
    "Recipe",
    "StudyReport",
    "read_counts",
    "read_recipe",
    "run_study",
    "summarised",
]
