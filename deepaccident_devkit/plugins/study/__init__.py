"""Studies: a recipe trains and compares models cell by cell, with tables, figures and a page.

docs/studies.md explains them. The modules are `recipe` (what a study asks for), `cells` (what is
made once and stored), `predict` (the predictions of a row), `numbers` (of rows and their
differences), `summary` (all numbers, from counts), `figures`, `page`, and `run`, which runs a
study.
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
