"""Whether predictions are wrong as a whole: mirrored, turned, shifted in time, scaled, in another frame."""

from deepaccident_devkit.evaluation.runs.sanity.check import check_sanity
from deepaccident_devkit.evaluation.runs.sanity.probes import Candidate
from deepaccident_devkit.evaluation.runs.sanity.report import SanityReport

__all__ = ["Candidate", "SanityReport", "check_sanity"]
