"""Recordings of accidents and of their twins with the scores of a predictor, counted for the
warning protocols.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from deepaccident_devkit.evaluation.warning import CleanWarnings, FieldWarnings, WarningEvaluator

Scores = Callable[[bool, np.ndarray], np.ndarray]
"""Whether the recording is an accident, and seconds to its end at each sample → scores; NaN for no
alarm.
"""
EGO = (("ego_vehicle", "ego_involved"),)


def evaluated(
    scores: Scores,
    protocol: str | CleanWarnings | FieldWarnings = "clean",
    pairs: int = 16,
    *,
    right: bool = True,
    agents: Sequence[tuple[str, str | None]] = EGO,
) -> WarningEvaluator:
    """Accident recordings of 6 s and twins of 9 s, two samples a second; alarms are right before
    accidents, or not.
    """
    evaluator, endings = WarningEvaluator(protocol), (("accident", 61), ("normal", 91))
    for number, (ending, last), (agent, involvement) in itertools.product(
        range(pairs), endings, agents
    ):
        crash, frames = ending == "accident", np.arange(1, last + 1, 5)
        recording = f"type1_subtype1_{ending}/s{number}/{agent}"
        for frame, score in zip(
            frames.tolist(), scores(crash, (last - frames) / 10).tolist(), strict=True
        ):
            counts: dict[str, Any] = {
                "recording": recording,
                "frame": frame,
                "kind": "accident" if crash else "twins",
                "involvement": involvement,
                "ahead": 61 - frame if crash else None,
                "to_end": 61 - frame,
                "alarms": [] if math.isnan(score) else [[score, int(crash and right)]],
                "unjudged": [],
                "beyond": 0,
                "references": [],
            }
            evaluator.add(f"{recording}/{frame:03d}", counts)
    return evaluator


def always(_crash: bool, ahead: np.ndarray) -> np.ndarray:
    return np.ones(len(ahead))


def never(_crash: bool, ahead: np.ndarray) -> np.ndarray:
    return np.full(len(ahead), np.nan)
