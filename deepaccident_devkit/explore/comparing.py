"""Two evaluated models beside each other: which differences are real, and at which samples they differ most."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.evaluation.runs import compare_bundles
from deepaccident_devkit.explore.background import Job
from deepaccident_devkit.explore.evaluations import evaluated
from deepaccident_devkit.explore.models import Score, scores_of, standings

if TYPE_CHECKING:
    from deepaccident_devkit.evaluation.runs import Bundle
    from deepaccident_devkit.explore.explorer import Explorer
    from deepaccident_devkit.explore.models import Model

Better = Literal["", "a", "b"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedSample:
    """A sample that two models are evaluated at.

    Attributes:
        token: of the sample.
        a: main number of the first.
        b: of the second.
        difference: b − a of their `standings`, where None is as good as can be: nothing is false or missed.
        better: which of them is; empty if they are equally good.
    """

    token: str
    a: Score
    b: Score
    difference: float
    better: Better


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedSamples:
    """All samples that two models are evaluated at.

    Attributes:
        number: name of the main number.
        samples: those with the largest differences first.
        left_out: samples that only one of them has.
    """

    number: str
    samples: tuple[ComparedSample, ...]
    left_out: int

    def chosen(self, better: str) -> Sequence[ComparedSample]:
        """Those where `a` or `b` is better; all for any other text."""
        return [each for each in self.samples if each.better == better] if better in ("a", "b") else self.samples


def bundle_of(model: Model) -> Bundle:
    """A model's bundle; raises NotAvailableError if it has none."""
    if model.bundle is None:
        raise NotAvailableError(f"{model.name}: these are results without an evaluation; only evaluations are compared")
    return model.bundle


def comparison_job(explorer: Explorer, a: Model, b: Model, *, common: bool) -> Job:
    """The work that gives the `Comparison` of two models, at the samples that both have if `common`."""
    first, second = bundle_of(a).folder, bundle_of(b).folder
    name = f"compare {(a.name, b.name, common)}"
    title = f"which differences of {a.name} and {b.name} are real"
    return explorer.jobs.ask(name, title, lambda: compare_bundles(first, second, common=common))


def differences_job(explorer: Explorer, a: Model, b: Model) -> Job:
    """The work that gives the `ComparedSamples` of two models, after that which gives their scores."""
    for model in (a, b):
        _ = model.job  # which comes first
    title = f"at which samples {a.name} and {b.name} differ"
    return explorer.jobs.ask(f"differences {(a.name, b.name)}", title, lambda: _compared(a, b))


def _compared(a: Model, b: Model) -> ComparedSamples:
    first, second = scores_of(a), scores_of(b)
    main = evaluated(bundle_of(a)).main
    best = 0.0 if not first.higher_is_better else 1.0 if main is None else main.limit
    ranked = [
        {token: best if value is None else value for token, value in standings(model).items()} for model in (a, b)
    ]
    shared = sorted(ranked[0].keys() & ranked[1].keys())
    samples = []
    for token in shared:
        difference = ranked[1][token] - ranked[0][token]
        is_better = (difference > 0) == first.higher_is_better
        better: Better = "" if not difference else "b" if is_better else "a"
        scores = {"a": first.samples[token], "b": second.samples[token]}
        samples.append(ComparedSample(token=token, **scores, difference=difference, better=better))
    samples.sort(key=lambda each: -abs(each.difference))
    left_out = len(first.samples) + len(second.samples) - 2 * len(shared)
    return ComparedSamples(number=first.name, samples=tuple(samples), left_out=left_out)
