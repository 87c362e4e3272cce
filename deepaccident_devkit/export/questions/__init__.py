"""Questions for language models on what happens next, and their answers as results files.

    from deepaccident_devkit import DeepAccident
    from deepaccident_devkit.export.bulk import export_release
    from deepaccident_devkit.export.questions import Questions, WindowRules, results_of_answers

    da = DeepAccident(dataroot="data/DeepAccident")
    export_release(da, "data/questions", Questions(split="val", observers="+infrastructure"))
    results_of_answers("answers.jsonl", "data/questions/truth.jsonl", "results/accident.json")

docs/exports.md describes what a question shows, and what it does not.
"""

from deepaccident_devkit.export.questions.answers import Answers, read_answers, results_of_answers
from deepaccident_devkit.export.questions.observed import WindowRules
from deepaccident_devkit.export.questions.questions import Questions

__all__ = ["Answers", "Questions", "WindowRules", "read_answers", "results_of_answers"]
