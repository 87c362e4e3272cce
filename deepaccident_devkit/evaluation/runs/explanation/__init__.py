"""What each choice of the rules does to the numbers: by protocol, and one named choice at a time."""

from deepaccident_devkit.evaluation.runs.explanation.explain import ExplainedNumber, Explanation, explain

__all__ = ["ExplainedNumber", "Explanation", "explain"]
