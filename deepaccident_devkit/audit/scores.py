"""Audit of scores of accidents: do they tell more than how long a clip is, or where it lies?"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from deepaccident_devkit.audit.report import AuditFinding, AuditReport
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ResultsError, shortened
from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.evaluation.intervals import LEAST_CLUSTERS
from deepaccident_devkit.evaluation.results import read_results
from deepaccident_devkit.reports import Row
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, IntArray
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.support.reading import fault_text, read_bytes
from deepaccident_devkit.support.text import counted, number_of, path_of

RESAMPLES: Final = 400
FOLLOWED: Final = (0.8, 0.5)
"""Low ends of rank correlations with the scores from which on these follow an attribute: of all scenarios, and among
those that end alike, where an attribute cannot stand for the truth; both have to be reached."""
_IS: Final[Mapping[str, tuple[str, str]]] = {
    "length": ("a detector of short clips", "a detector of long clips"),
    "folder": ("a detector of the folder `normal`", "a detector of the folder `accident`"),
    "name": ("a detector of small numbers in names", "a detector of large numbers in names"),
    "town": ("a detector of towns without accidents", "a detector of towns with accidents"),
    "weather": ("a detector of weather without accidents", "a detector of weather with accidents"),
    "actors": ("a detector of empty streets", "a detector of full streets"),
    "frame": ("a detector of early frames", "a detector of late frames"),
}
"""Attribute → what scores are that fall, or rise, with it."""
_HEADING: Final = ("attribute", "AUC", "with the scores", "from", "to", "among those that end alike", "from", "to")
_NOTES: Final = (
    """The truth is whether meta names a collision; a scenario's score is the highest of its samples. AUC of an attribute:
in the direction that fits. Town and weather count by the share of collisions among the other scenarios of the same
word, without the twin. With the scores: Spearman's rank correlation, and likewise of the ranks within the collisions
and within the others, where an attribute cannot stand for the truth; of the frame, without collisions alone.""",
    f"Intervals hold 95 % of {RESAMPLES} resamples of scenarios, twins together; of fewer than {LEAST_CLUSTERS} there is "
    "none, and no verdict.",
)
_CUT: Final = "Cut all clips alike, or compare moments: deepaccident evaluate warning counts those before the impact."
_REMEDY: Final = "give results of the task accident, a JSON object of token and score, or lines `token,score` in a .csv"


def read_scores(path: str | os.PathLike[str]) -> dict[str, float]:
    """Tokens of samples or scenarios with a score, the higher the surer of an accident.

    Args:
        path: results of the task `accident` (a sample's score is that of its surest accident, 0 without one), a JSON
            object of token and score, or a .csv file of `token,score` in a line, with or without a heading.

    Raises:
        ResultsError: it cannot be read, is something else, or a score is no finite number.
    """
    file = path_of(path, error=ResultsError)
    try:
        content = read_bytes(file, "results")
        if file.suffix == ".csv":
            lines = [re.split(r"[,;\t]", line.replace('"', "")) for line in content.decode("utf-8-sig").splitlines()]
            given: dict[str, Any] = {words[0].strip(): number_of(words[-1].strip()) for words in lines if words != [""]}
            given = {token: score for token, score in given.items() if "/" in token or score is not None}
        else:
            given = dict(parsed_json(content))
    except (OSError, TypeError, ValueError) as error:
        raise ResultsError(f"{file}: {shortened(fault_text(error))}; {_REMEDY}") from error
    if "results" in given and (results := read_results(file)).task == "accident":
        accidents: Mapping[str, Any] = {token: results.prediction(token) for token in results.tokens}
        given = {token: max((each.score for each in found), default=0.0) for token, found in accidents.items()}
    for token, score in given.items():
        if type(score) not in (int, float) or not math.isfinite(score):
            raise ResultsError(
                f"{file}: {shortened(token)}: expected a score, found {shortened(repr(score))}; {_REMEDY}"
            )
    return given


def audit_scores(
    dataset: Dataset, scores: Mapping[str, float], split: str | os.PathLike[str] | None = None
) -> AuditReport:
    """Compare scores of accidents with the truth, and with what a detector should not go by.

    Args:
        dataset: the release.
        scores: token of a sample or of a scenario → its score, as `read_scores` gives them.
        split: only its scenarios: `train`, `val`, … or a split file; None for all that have a score.

    Raises:
        TokenError: a token is neither a sample's nor a scenario's.
        ResultsError: no scenario with meta has a score.
    """
    cases = [(token.split("/"), score) for token, score in scores.items()]
    for token in scores:
        dataset.getind("sample" if token.count("/") > 1 else "scenario", token)
    chosen = {"/".join(words[:2]) for words, _ in cases}
    chosen &= chosen if split is None else dataset.split_scenarios(split)
    records = [each for each in map(dataset.scenario.get, sorted(chosen)) if each["weather"] is not None]
    if not records:
        raise ResultsError("no scenario with meta has a score; give scores of a split whose meta is published")
    row = {each["token"]: number for number, each in enumerate(records)}
    rows = [(row.get("/".join(words[:2]), -1), int(words[3]) if words[2:] else 0, score) for words, score in cases]
    of, frame, score = np.array([each for each in rows if each[0] >= 0], dtype=float).T
    of, highest = of.astype(int), np.full(len(records), -math.inf)
    np.maximum.at(highest, of, score)
    truth = np.array([each["collision"] is not None for each in records])
    cluster = np.unique([cluster_of(each["token"]) for each in records], return_inverse=True)[1]
    actors = np.bincount(dataset.columns("instance")["scenario_row"], minlength=len(dataset.scenario))
    columns = [
        [each["num_frames"] for each in records],
        [each["designed_accident"] for each in records],
        [int(re.sub(r".*?(\d*)$", r"0\1", each["name"])) for each in records],
        _shares([each["town"] for each in records], truth, cluster),
        _shares([each["weather"] for each in records], truth, cluster),
        [actors[dataset.getind("scenario", each["token"])] for each in records],
        highest,
    ]
    table, of_frame = np.column_stack(columns).astype(float), np.column_stack([frame, score])
    found = np.concatenate(
        [_correlations(table, truth * 1, cluster), _correlations(of_frame, -truth[of] * 1, cluster[of])]
    )
    areas = [*(_area(each, truth) for each in table.T[:-1]), _area(frame, truth[of])]
    told: list[Row] = [_HEADING, ("the scores", _area(highest, truth), *[None] * 6)]
    findings = []
    for name, area, numbers in zip(_IS, areas, found.round(3), strict=True):
        told.append((name, max(area, round(1 - area, 3)), *numbers.flat))
        rises = numbers[0, 0] > 0
        if ((numbers[:, 1] if rises else -numbers[:, 2]) > FOLLOWED).all():
            what = (
                f"these scores are those of {_IS[name][rises]}: their rank correlation with `{name}` is {numbers[0, 0]}, and "
                f"{numbers[1, 0]} among scenarios that end alike. `{name}` alone has an AUC of {told[-1][1]}, they of {told[1][1]}."
            )
            findings.append(AuditFinding(kind=name, what=what, remedy=_CUT, number=len(records)))
    note = f"{counted(len(records), 'scenario')} with meta and a score, {truth.sum()} with a collision."
    return AuditReport(findings=tuple(findings), tables={"scores": told}, notes=(note, *_NOTES))


def _area(values: FloatArray, truth: BoolArray) -> float:
    """The area under the ROC curve; 0.5 where all end alike."""
    from scipy.stats import rankdata

    hits, others = int(truth.sum()), int((~truth).sum())
    above = float(rankdata(values)[truth].sum()) - hits * (hits + 1) / 2
    return round(above / (hits * others), 3) if hits * others else 0.5


def _shares(words: Sequence[Any], truth: BoolArray, cluster: IntArray) -> FloatArray:
    """(N,) share of collisions among the other scenarios of each one's word, without its cluster; 0 of none."""
    others = (np.array(words)[:, None] == np.array(words)) & (cluster[:, None] != cluster)
    return others @ truth.astype(float) / np.maximum(others.sum(axis=1), 1)


def _correlations(table: FloatArray, alike: IntArray, cluster: IntArray) -> FloatArray:
    """(A, 2, 3) rank correlations of A columns with the last one, over all rows and within those that end alike.

    With the ends of their intervals. `alike` is 0 or 1, below for rows that do not count there; 0 where nothing varies.
    """
    from scipy.stats import rankdata

    def of(rows: IntArray) -> FloatArray:
        parts = [table[rows], *(table[rows[alike[rows] == each]] for each in (0, 1))]
        ranks = [rankdata(each, axis=0) - (len(each) + 1) / 2 for each in parts]
        products = [each.T @ each for each in (ranks[0], np.concatenate(ranks[1:]))]
        return np.stack(
            [each[:-1, -1] / np.sqrt(np.diag(each)[:-1] * each[-1, -1] + 1e-9) for each in products], axis=-1
        )

    parts = [np.flatnonzero(cluster == each) for each in np.unique(cluster)]
    draws = np.random.default_rng(0).integers(len(parts), size=(RESAMPLES, len(parts)))
    drawn = [of(np.concatenate([parts[part] for part in draw])) for draw in draws]
    ends = np.quantile(drawn, (0.025, 0.975), axis=0)
    ends = ends if len(parts) >= LEAST_CLUSTERS else np.sign(ends + [[[-9]], [[9]]])
    return np.stack([of(np.arange(len(table))), *ends], axis=-1)
