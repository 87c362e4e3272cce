"""How good a model is at single samples: those at which it is worst first."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.explore.background import Job, Jobs
from deepaccident_devkit.explore.evaluations import finite

if TYPE_CHECKING:
    from deepaccident_devkit.explore.models import Model, Scores


def standings_job(jobs: Jobs, model: Model) -> Job:
    """The work that gives the `standings` of a model that has a bundle, after that which gives its scores."""
    _ = model.job  # which comes first
    return jobs.ask(f"order {model.name}", f"the worst samples of {model.name}", lambda: standings(model))


def standings(model: Model) -> dict[str, float | None]:
    """Sample → its main number, the worst first.

    Some protocols have no such number of a sample where there is nothing to find. It counts as 0 if something is
    predicted there, so that false alarms are among the worst; a sample with nothing at all has None, and is last.

    Raises:
        EvaluationError: the model has no scores.
    """
    scores = scores_of(model)
    found = {token: score.value for token, score in scores.samples.items()}
    for token, value in found.items():
        if value is None and _is_false(model.rows.get(token, {})):
            found[token] = 0.0
    sign = 1 if scores.higher_is_better else -1
    return dict(sorted(found.items(), key=lambda item: (item[1] is None, sign * (item[1] or 0.0), item[0])))


def scores_of(model: Model) -> Scores:
    """A model's scores; raises EvaluationError if it has none."""
    scores = model.scores
    if scores is None:
        raise EvaluationError(f"{model.name}: has no scores ({model.job.error or 'it has no evaluation'})")
    return scores


def _is_false(row: Mapping[str, Any]) -> bool:
    """Whether something is predicted at a sample where nothing is to be found."""
    return any((finite(row[name]) or 0) > 0 for name in row if name.startswith("fp_") or name == "detections")
