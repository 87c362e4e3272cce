"""What each choice of the rules does to the numbers: by protocol, and one named choice at a time."""

from deepaccident_devkit.evaluation.explanation.explain import explain
from deepaccident_devkit.evaluation.explanation.result import ExplainedNumber, Explanation

__all__ = ["ExplainedNumber", "Explanation", "explain"]
