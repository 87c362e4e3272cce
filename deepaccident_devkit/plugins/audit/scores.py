"""Audit of scores of accidents: do they tell more than how long a clip is, or where it lies?"""

from __future__ import annotations

import math
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, cast

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import MOST_TOLD, ResultsError, shortened
from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.evaluation.intervals import LEAST_CLUSTERS
from deepaccident_devkit.evaluation.results import read_results
from deepaccident_devkit.evaluation.warning.clean import roc_area
from deepaccident_devkit.plugins.audit.report import AuditFinding, AuditReport
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, IntArray, as_floats
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.support.reading import fault_text, read_bytes
from deepaccident_devkit.support.reports import Row
from deepaccident_devkit.support.text import counted, number_of, path_of

_RESAMPLES: Final = 400
# Scores follow an attribute if the low ends of their rank correlations are beyond these: of all scenarios, and among
# those that end alike, where an attribute cannot stand for the truth.
FOLLOWED: Final = (0.8, 0.5)
# Attribute → what scores are that fall, or rise, with it.
_IS: Final[Mapping[str, tuple[str, str]]] = {
    "length": ("a detector of short clips", "a detector of long clips"),
    "folder": ("a detector of the folder `normal`", "a detector of the folder `accident`"),
    "name": ("a detector of small numbers in names", "a detector of large numbers in names"),
    "town": ("a detector of towns", "a detector of towns"),
    "weather": ("a detector of weather", "a detector of weather"),
    "actors": ("a detector of few actors", "a detector of many actors"),
    "frame": ("a detector of early frames", "a detector of late frames"),
}
_NOTES: Final = (
    "Truth: meta names a collision. A scenario's score is its samples' highest; the frame is compared by samples.",
    """AUC of an attribute: in the direction that fits; of town and weather, by the share of collisions among the other
scenarios of the same word, without the twin.""",
    """`with the scores`: Spearman's rank correlation, of town and weather by the mean score of the word. `among alike`:
of ranks within the collisions and within the others, where no attribute can stand for the truth (of the frame, without
collisions alone).""",
    f"From, to: 95 % of {_RESAMPLES} resamples of scenarios, twins together; −1 to 1 for fewer than {LEAST_CLUSTERS}.",
)
_HEADING: Final = ("attribute", "AUC", "with the scores", "from", "to", "among alike", "from", "to")
# A token and its score in a table, perhaps behind the number of the row.
_LINE: Final = re.compile(
    r"""(?:"?\d*"?[,;\t|])?\s*"?(?P<token>[^\s,;|"]+/[^\s,;|"]+)"?\s*[,;\t|]\s*"?(?P<score>[^\s;|"]+)"?\s*"""
)
_REMEDY: Final = (
    "give results of the task accident, a JSON object of token and score, or a .csv of lines `token,score`, with a "
    "comma, a semicolon, a tab or a bar"
)
_ALIKE: Final = "scenarios that end alike hardly differ in it, so scores that go by it cannot be told apart from the truth here."
_FEW: Final = f"nothing can be found: all are equal, or fewer than {LEAST_CLUSTERS} scenarios (twins are one) have one."


def read_scores(path: str | os.PathLike[str]) -> dict[str, float]:
    """Return the score of each token of a sample or of a scenario; the higher, the surer of an accident.

    Args:
        path: results of the task `accident` (a sample's score is that of its surest accident, 0 without one); JSON, an
            object of token and score or a list of objects with `token` and `score`; or a table (a .csv file), in
            whose lines a score follows a token (which has a `/`); lines without a token do not count.

    Raises:
        ResultsError: it cannot be read, is something else, or a score is no finite number.
    """
    file = path_of(path, error=ResultsError)
    try:
        content = read_bytes(file, "results")
        if file.suffix.lower() in (".csv", ".tsv", ".txt"):
            given: dict[str, Any] = dict(_pairs_of_table(content.decode("utf-8-sig")))
        elif isinstance(document := parsed_json(content), list):
            given = {entry["token"]: entry["score"] for entry in document}
        else:
            given = dict(document)
    except (TypeError, LookupError) as error:
        raise ResultsError(
            f"{file}: expected an object of token and score, or a list of these; {_REMEDY}"
        ) from error
    except (OSError, ValueError) as error:
        raise ResultsError(
            f"{file}: {shortened(fault_text(error), MOST_TOLD)}; {_REMEDY}"
        ) from error
    if not given:
        raise ResultsError(f"{file}: has no token with a score; {_REMEDY}")
    if "results" in given and (results := read_results(file)).task == "accident":
        given = {
            token: max(
                (accident.score for accident in cast("Any", results.prediction(token))), default=0.0
            )
            for token in results.tokens
        }
    for token, score in given.items():
        if type(score) not in (int, float) or not abs(score) < 1e300:
            found = f"{shortened(str(token))}: {shortened(repr(score))}"
            raise ResultsError(f"{file}: expected a score, found {found}; {_REMEDY}")
    return given


def _pairs_of_table(text: str) -> Iterator[tuple[str, float | None]]:
    for number, line in enumerate(text.splitlines(), start=1):
        if "/" in line:
            found = _LINE.fullmatch(line)
            if found is None:
                raise ValueError(
                    f"line {number}: expected a token and then its score, found {shortened(line)}"
                )
            yield found["token"], number_of(found["score"].replace(",", "."))


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
    view, of_sample = dataset.columns("scenario"), dataset.columns("sample")["scenario_row"]
    tokens = [record["token"] for record in dataset.scenario[:]]
    cases = [
        (of_sample[dataset.getind("sample", token)], int(token.rpartition("/")[2]), score)
        if token.count("/") > 1
        else (dataset.getind("scenario", token), 0, score)
        for token, score in scores.items()
    ]
    chosen = [*dataset.split_scenarios(split)] if split else tokens
    counts = np.isin(tokens, chosen) & np.array(view["weather"].is_valid())
    rows, frame, score = (
        np.array([case for case in cases if counts[case[0]]], dtype=float).reshape(-1, 3).T
    )
    if not len(rows):
        raise ResultsError(
            "no scenario with meta has a score; give scores of a split whose meta is published"
        )
    scenario, of = np.unique(rows.astype(int), return_inverse=True)
    highest = np.full(len(scenario), -np.inf)
    np.maximum.at(highest, of, score)
    truth = np.array(view["collision"].is_valid())[scenario]
    cluster = np.unique([cluster_of(tokens[row]) for row in scenario], return_inverse=True)[1]
    words = [np.array(view[name])[scenario].astype(str) for name in ("town", "weather")]
    columns: list[AnyArray] = [
        view["num_frames"][scenario],
        view["designed_accident"][scenario],
        np.array([int(re.sub(r".*?(\d*)$", r"0\1", tokens[row])) for row in scenario]),
        *(_means(values, highest) for values in words),
        np.bincount(dataset.columns("instance")["scenario_row"], minlength=len(tokens))[scenario],
    ]
    correlations = [
        *_correlations([*columns, highest], truth * 1, cluster),
        *_correlations([frame, score], truth[of] * -1, cluster[of]),
    ]
    areas = [_area(values, truth) for values in columns]
    areas[3:5] = [_area(_means(values, truth, cluster), truth) for values in words]
    areas.append(_area(frame, truth[of]))
    own = _area(highest, truth)
    columns[3:] = *words, columns[5], frame
    untold, table, findings = list[str](), list[Row](), list[AuditFinding]()
    for name, values, area, (whole, alike) in zip(_IS, columns, areas, correlations, strict=True):
        # of shares of others an AUC below a half is no fit: leaving one out pushes it there
        fitting = max(area, 0.5 if name in ("town", "weather") else round(1 - area, 3))
        table.append((name, fitting, *whole.tolist(), *alike.tolist()))
        ends = truth[of] if name == "frame" else truth
        numbers = sorted(Counter(zip(values, ends, strict=True)).values())
        if sum(numbers[: -len({*ends})]) < 2:  # beside the usual value of each end
            untold.append(name)
        rises = bool(whole[0] > 0)
        low, low_alike = (whole[1], alike[1]) if rises else (-whole[2], -alike[2])
        is_followed = low_alike > FOLLOWED[1]
        if name == "folder":  # those that end otherwise are too few for an interval
            goes_by_folder = ((highest > highest.mean()) == (values == rises))[values != truth]
            is_followed |= goes_by_folder.sum() > max(1, FOLLOWED[0] * len(goes_by_folder))
        if low > FOLLOWED[0] and is_followed:
            what = (
                f"these scores are those of {_IS[name][rises]}: their rank correlation with `{name}` is {whole[0]}, "
                f"and {alike[0]} among scenarios that end alike. Alone, it has an AUC of {fitting}, they of {own}."
            )
            remedy = "Cut all clips alike, or compare moments of equal time to the end: deepaccident evaluate warning."
            findings.append(AuditFinding(kind=name, what=what, remedy=remedy, number=len(truth)))
    is_few = len({*cluster}) < LEAST_CLUSTERS or len({*highest}) == 1
    return AuditReport(
        compared={"attributes with the scores": 0 if is_few else len(_IS) - len(untold)},
        cannot_say=(*[_FEW] * is_few, *[f"{', '.join(untold)}: {_ALIKE}"] * bool(untold)),
        findings=tuple(findings),
        tables={"scores": [_HEADING, ("the scores", own, *[None] * 6), *table]},
        notes=(
            f"{counted(len(truth), 'scenario')} with meta and a score, {truth.sum()} with a collision.",
            *_NOTES,
        ),
    )


def _area(values: FloatArray, truth: BoolArray) -> float:
    """The area under the ROC curve, of three decimals; 0.5 where all end alike."""
    area = roc_area(np.unique(values, return_inverse=True)[1], truth, np.ones(len(truth)))
    return 0.5 if math.isnan(area) else round(area, 3)


def _means(words: AnyArray, values: AnyArray, cluster: IntArray | None = None) -> FloatArray:
    """(N,) mean value of each one's word, over all of the word or those of other clusters alone; 0 of none."""
    others = (words[:, None] == words) & (True if cluster is None else cluster[:, None] != cluster)
    return as_floats(others @ values.astype(float) / np.maximum(others.sum(axis=1), 1))


def _correlations(columns: Sequence[Any], alike: IntArray, cluster: IntArray) -> FloatArray:
    """(A, 2, 3) rank correlations of A columns with the last one, over all rows and within those that end alike.

    With the ends of their intervals. `alike` is 0 or 1, below for rows that do not count there; 0 where nothing varies.
    """
    from scipy.stats import rankdata

    table = np.column_stack(columns).astype(float)

    def of(rows: IntArray) -> FloatArray:
        groups = [rows, *(rows[alike[rows] == each] for each in (0, 1))]
        ranks = [rankdata(table[each], axis=0) - (len(each) + 1) / 2 for each in groups]
        products = [each.T @ each for each in (ranks[0], np.concatenate(ranks[1:]))]
        return np.stack(
            [
                each[:-1, -1] / np.sqrt(np.diag(each)[:-1] * each[-1, -1] + 1e-9)
                for each in products
            ],
            axis=-1,
        )

    parts = [np.flatnonzero(cluster == each) for each in np.unique(cluster)]
    draws = np.random.default_rng(0).integers(len(parts), size=(_RESAMPLES, len(parts)))
    drawn = [of(np.concatenate([parts[part] for part in draw])) for draw in draws]
    ends = (
        np.quantile(drawn, (0.025, 0.975), axis=0)
        if len(parts) >= LEAST_CLUSTERS
        else [[[-1]], [[1]]] + 0 * drawn[0]
    )
    return np.stack([of(np.arange(len(table))), *ends], axis=-1).round(3)
