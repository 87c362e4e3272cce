"""`compare_bundles`: two evaluations side by side, with a paired bootstrap that says which differences are real.

Scenarios are drawn, not samples, since those of a scenario show the same few seconds; and both runs get the same draws,
so that what makes a scenario hard for both does not blur their difference.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.metrics.breakdowns import Bootstrap, middle, numbers_of, resampled
from deepaccident_devkit.evaluation.metrics.evaluator import Evaluator
from deepaccident_devkit.evaluation.metrics.headlines import Headline, headlines
from deepaccident_devkit.evaluation.runs.bundles import COUNTS_FILE, Bundle, read_bundle
from deepaccident_devkit.evaluation.runs.comparison import ComparedNumber, Comparison
from deepaccident_devkit.evaluation.runs.differences import differing
from deepaccident_devkit.evaluation.runs.selection import scenario_of

_LEAST_KNOWN: Final = 0.8
"""Share of the resamples that must have a number. If a single scenario has it, 63 to 75 % do: always with the same
difference, which says nothing of other scenarios. Of two scenarios 86 % and more do."""
_Two = tuple[Mapping[str, float], Mapping[str, float]]
"""The numbers of both."""


def compare_bundles(
    a: str | os.PathLike[str],
    b: str | os.PathLike[str],
    bootstrap: Bootstrap | None = None,
    *,
    common: bool = False,
) -> Comparison:
    """Compare two bundles' numbers; the release and the results are not needed.

    Args:
        a: folder of the first, as `save_run` writes it.
        b: folder of the second.
        bootstrap: how resamples are drawn; None for the defaults.
        common: whether to compare the samples that both have where one has others, too.

    Raises:
        ResultsError: one of them is no bundle.
        EvaluationError: they differ in task, rules, labels or samples, or were made by another devkit.
    """
    chosen = bootstrap or Bootstrap()
    pair = comparable_pair(Path(a).expanduser(), Path(b).expanduser(), common=common)
    setup = pair.bundles[0].setup
    results = [evaluator.compute(pair.tokens) for evaluator in pair.evaluators]
    known = {each.path: each for result in results for each in headlines(setup.task, result)}
    first, second = (numbers_of(result) for result in results)
    drawn = _draws(pair, chosen)
    names = dict.fromkeys([*(name for name in known if name in {**first, **second}), *first, *second])
    partial = [bundle.summary.get("partial") for bundle in pair.bundles]
    return Comparison(
        a=pair.bundles[0].folder,
        b=pair.bundles[1].folder,
        task=setup.task,
        protocol=setup.protocol,
        samples=len(pair.tokens),
        scenarios=len(pair.scenarios),
        left_out=pair.left_out,
        partial=tuple(f"{name}: {mark['mark']}" for name, mark in zip("ab", partial, strict=True) if mark),
        bootstrap=chosen,
        numbers=tuple(_compared(name, (first, second), drawn, known.get(name), chosen.confidence) for name in names),
    )


def _draws(pair: ComparablePair, bootstrap: Bootstrap) -> list[_Two]:
    """The numbers of both in each resample; none of a single scenario, which says nothing of how others would do."""
    if len(pair.scenarios) < 2:
        return []
    first, second = (
        resampled(
            evaluator,
            [[evaluator.counts[token] for token in tokens] for tokens in pair.scenarios.values()],
            bootstrap,
        )
        for evaluator in pair.evaluators
    )
    return list(zip(first, second, strict=True))


def _compared(
    name: str, values: _Two, drawn: list[_Two], headline: Headline | None, confidence: float
) -> ComparedNumber:
    a, b = (each.get(name, math.nan) for each in values)
    differences = [two.get(name, math.nan) - one.get(name, math.nan) for one, two in drawn]
    known = [each for each in differences if math.isfinite(each) and math.isfinite(b - a)]
    low, high = middle(known, confidence)
    real = (low > 0 or high < 0) and len(known) >= _LEAST_KNOWN * len(drawn)
    return ComparedNumber(
        number=name,
        headline=None if headline is None else headline.name,
        unit=None if headline is None else headline.unit,
        a=_finite(a),
        b=_finite(b),
        difference=_finite(b - a),
        low=_finite(low),
        high=_finite(high),
        reversed=sum(each * (b - a) < 0 for each in known) / len(known) if known else None,
        real=real,
        better=_better(b - a, headline) if real else None,
    )


def _better(difference: float, headline: Headline | None) -> str | None:
    if headline is None or headline.higher_is_better is None:
        return None
    return "b" if (difference > 0) == headline.higher_is_better else "a"


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


_SETUP: Final = ("task", "protocol", "switches", "horizon", "settings")
_SHOWN: Final = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ComparablePair:
    """Two evaluations of the same samples by the same rules.

    Attributes:
        bundles: the two.
        evaluators: of each, with the counts of all its samples.
        scenarios: scenario → tokens of its samples that both have; in order.
        left_out: samples that only one of them has.
    """

    bundles: tuple[Bundle, Bundle]
    evaluators: tuple[Evaluator[Any], Evaluator[Any]]
    scenarios: Mapping[str, tuple[str, ...]]
    left_out: int

    @property
    def tokens(self) -> list[str]:
        """All samples that both have, in order."""
        return [token for tokens in self.scenarios.values() for token in tokens]


def comparable_pair(first: Path, second: Path, *, common: bool = False) -> ComparablePair:
    """Open two bundles and check that their numbers can be compared.

    Args:
        first: folder of one.
        second: of the other.
        common: whether to compare the samples that both have where they have others, too.

    Raises:
        ResultsError: one of them is no bundle.
        EvaluationError: they differ in task, rules, truth, or, without `common`, in samples; or counts cannot be read.
    """
    one, other = read_bundle(first), read_bundle(second)
    _check_rules(one, other)
    evaluators = _counted(one), _counted(other)
    tokens = _shared_tokens((one, other), evaluators, common=common)
    scenarios: dict[str, list[str]] = {}
    for token in tokens:
        scenarios.setdefault(scenario_of(token), []).append(token)
    _check_truth(one, other, scenarios)
    return ComparablePair(
        bundles=(one, other),
        evaluators=evaluators,
        scenarios={name: tuple(those) for name, those in scenarios.items()},
        left_out=len(evaluators[0].tokens ^ evaluators[1].tokens),
    )


def _check_rules(one: Bundle, other: Bundle) -> None:
    stated = [{name: bundle.summary.get(name) for name in _SETUP} for bundle in (one, other)]
    unlike = list(differing(*stated))
    if unlike:
        told = "; ".join(f"{where} {first!r} and {second!r}" for where, first, second in unlike[:_SHOWN])
        more = f", and {len(unlike) - _SHOWN} more" if len(unlike) > _SHOWN else ""
        raise EvaluationError(
            f"{one.folder} and {other.folder}: were evaluated by other rules: {told}{more}; evaluate both results alike"
        )


def _check_truth(one: Bundle, other: Bundle, scenarios: Mapping[str, object]) -> None:
    hashes = [bundle.scenarios() for bundle in (one, other)]
    changed = [name for name in scenarios if hashes[0].get(name) != hashes[1].get(name)]
    if changed:
        raise EvaluationError(
            f"{one.folder} and {other.folder}: the label, meta or calib files of {len(changed)} scenarios are not the "
            f"same ({', '.join(_first(changed))}); evaluate both results with the same release"
        )


def _counted(bundle: Bundle) -> Evaluator[Any]:
    return bundle.setup.evaluator().resume(bundle.folder / COUNTS_FILE)


def _shared_tokens(
    bundles: tuple[Bundle, Bundle], evaluators: tuple[Evaluator[Any], Evaluator[Any]], *, common: bool
) -> list[str]:
    mine, theirs = (each.tokens for each in evaluators)
    if mine != theirs and not common:
        counted = "; ".join(
            f"{len(alone)} samples only in {bundle.folder} ({', '.join(_first(sorted(alone)))})"
            for bundle, alone in zip(bundles, (mine - theirs, theirs - mine), strict=True)
            if alone
        )
        raise EvaluationError(
            f"{counted}; evaluate both at the same samples, or compare those that both have with common=True (--common)"
        )
    shared = sorted(mine & theirs)
    if not shared:
        raise EvaluationError(f"{bundles[0].folder} and {bundles[1].folder}: have no sample in common")
    return shared


def _first(names: list[str]) -> Iterator[str]:
    yield from names[:_SHOWN]
    if len(names) > _SHOWN:
        yield "…"
