"""The few samples of a sanity check: those that show most, spread over all."""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import partial
from itertools import pairwise
from typing import Final

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.taxonomy import FRAME_PERIOD

_GOLDEN: Final = 0.618
_LOOKED_AT: Final = 25
"""Neighbours among which the most useful one is taken."""


def telling_samples(
    dataset: Dataset,
    tokens: Collection[str],
    count: int,
    horizon: float,
    says_something: Callable[[str], bool] = lambda _: True,
    *,
    varied: bool = False,
) -> list[str]:
    """At most `count` samples, one of each of as many parts of equal length of all tokens, sorted.

    Of a part that is taken which shows most: an accident to come within the horizon, then the longest future within
    it, then the most boxes; or, with `varied`, one as long before the accident and the next as short. Nothing is
    random.

    Args:
        dataset: the release.
        tokens: of the samples.
        count: how many.
        horizon: seconds.
        says_something: whether a sample's prediction does; of samples with an accident to come those that do are taken
            first.
        varied: whether samples are to be at various times before the accident, and not to show most.

    Raises:
        TokenError: there is no such sample.
    """
    ordered = sorted(tokens)
    count = min(count, len(ordered))
    bounds = [round(number * len(ordered) / count) for number in range(count + 1)] if count else []
    parts = [_spread(ordered[first:last]) for first, last in pairwise(bounds)]
    telling = partial(_telling, dataset, horizon=horizon, says_something=says_something)
    if not varied:
        return [max(part, key=telling) for part in parts]
    starts = [int(number * _GOLDEN % 1 * len(part)) for number, part in enumerate(parts)]
    turned = [[*part[start:], *part[:start]] for start, part in zip(starts, parts, strict=True)]
    return [max(part, key=lambda token: telling(token)[:2]) for part in turned]


def _spread(tokens: list[str]) -> list[str]:
    return tokens[:: max(1, len(tokens) // _LOOKED_AT)]


def _telling(
    dataset: Dataset, token: str, *, horizon: float, says_something: Callable[[str], bool]
) -> tuple[bool, bool, float, int]:
    sample = dataset.get("sample", token)
    to_impact = sample["time_to_impact"]
    comes = to_impact is not None and to_impact <= horizon + FRAME_PERIOD / 2
    return comes, comes and says_something(token), min(sample["time_to_end"], horizon), sample["num_annotations"]
