"""Recordings of accidents and their twins, with the scores of a predictor, for warnings."""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from deepaccident_devkit.evaluation.warning import CleanWarnings, FieldWarnings, WarningEvaluator

# Whether the recording is an accident, and seconds to its end at each sample → scores; NaN for no
# alarm.
ScoreFunction = Callable[[bool, np.ndarray], np.ndarray]
EGO_AGENTS = (("ego_vehicle", "ego_involved"),)
IMPACT_FRAME = 61


def evaluate_scores(
    scores: ScoreFunction,
    protocol: str | CleanWarnings | FieldWarnings = "clean",
    pairs: int = 16,
    *,
    right: bool = True,
    agents: Sequence[tuple[str, str | None]] = EGO_AGENTS,
) -> WarningEvaluator:
    """Evaluate accidents of 6 s and twins of 9 s, with two samples a second.

    Args:
        scores: Scores of each recording.
        protocol: Protocol of the evaluator.
        pairs: Number of accidents, each with a twin.
        right: Whether alarms before accidents are right.
        agents: Agents, each with its involvement.
    """
    evaluator = WarningEvaluator(protocol)
    recordings = itertools.product(range(pairs), (True, False), agents)
    for number, is_accident, (agent, involvement) in recordings:
        ending, last_frame = ("accident", 61) if is_accident else ("normal", 91)
        recording = f"type1_subtype1_{ending}/s{number}/{agent}"
        frames = np.arange(1, last_frame + 1, 5)
        values = scores(is_accident, (last_frame - frames) / 10)
        for frame, score in zip(frames.tolist(), values.tolist(), strict=True):
            is_right = int(is_accident and right)
            counts: dict[str, Any] = {
                "recording": recording,
                "frame": frame,
                "kind": "accident" if is_accident else "twins",
                "involvement": involvement,
                "ahead": IMPACT_FRAME - frame if is_accident else None,
                "to_end": IMPACT_FRAME - frame,
                "alarms": [] if math.isnan(score) else [[score, is_right]],
                "unjudged": [],
                "beyond": 0,
                "references": [],
            }
            evaluator.add(f"{recording}/{frame:03d}", counts)
    return evaluator


def always_alarm(_is_accident: bool, seconds: np.ndarray) -> np.ndarray:
    return np.ones(len(seconds))


def never_alarm(_is_accident: bool, seconds: np.ndarray) -> np.ndarray:
    return np.full(len(seconds), np.nan)
