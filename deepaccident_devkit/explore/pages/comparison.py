"""Two evaluated models side by side: their numbers, where they differ most, and both at the same moment."""

from __future__ import annotations

from functools import partial
from typing import Any, Final
from urllib.parse import urlencode

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from deepaccident_devkit.evaluation.metrics.numbers import value_text
from deepaccident_devkit.evaluation.runs import ComparedNumber, Comparison
from deepaccident_devkit.explore.comparing import (
    ComparedSample,
    ComparedSamples,
    bundle_of,
    comparison_job,
    differences_job,
)
from deepaccident_devkit.explore.evaluations import Evaluated, evaluated
from deepaccident_devkit.explore.models import Model
from deepaccident_devkit.explore.pages.answers import explorer_of, page, with_slash
from deepaccident_devkit.explore.pages.model_addresses import (
    SAMPLE,
    beside_in_time,
    known_sample,
    model_of,
    sample_path,
    titles,
)
from deepaccident_devkit.explore.pages.release_tabs import part_of
from deepaccident_devkit.explore.pages.samples import PAGE, asked_ahead, place_in, sample_context
from deepaccident_devkit.explore.predicted import frames_ahead
from deepaccident_devkit.explore.verdicts import verdict

_BETTER: Final = ("a", "b")
_OTHER: Final = {"a": "b", "b": "a"}


def routes() -> list[Route]:
    """The addresses: `better=a|b` chooses samples, `common=1` compares only the samples that both have."""
    return [
        Route("/compare/{a}/{b}", with_slash),
        Route("/compare/{a}/{b}/", _comparison),
        Route(f"/compare/{{a}}/{{b}}/sample/{SAMPLE}", _sample),
    ]


def _pair(request: Request) -> tuple[Model, Model]:
    """Both models; raises NotAvailableError if there is no such one, or one has no bundle."""
    a, b = model_of(request, "a"), model_of(request, "b")
    bundle_of(a), bundle_of(b)
    return a, b


def _comparison(request: Request) -> Response:
    explorer, (a, b) = explorer_of(request), _pair(request)
    common = request.query_params.get("common") == "1"
    differences = differences_job(explorer, a, b) if a.setup.task == b.setup.task else None
    tests = comparison_job(explorer, a, b, common=common)  # after the differences, since it takes longer
    work = [tests] if differences is None else [differences, tests]
    waits = titles(work)  # before their results are read: what comes later is not missed
    found: ComparedSamples | None = None if differences is None else differences.result
    compared: Comparison | None = tests.result
    better = _asked_better(request)
    part = part_of(request, () if found is None else found.chosen(better), PAGE)
    told = evaluated(bundle_of(a)), evaluated(bundle_of(b))
    return page(
        request,
        "compare.html",
        a=a,
        b=b,
        marks=[(name, each.mark) for name, each in zip(_BETTER, told, strict=True) if each.mark],
        tests=tests,
        comparison=compared,
        numbers=_sides(*told) if compared is None else [_tested(each) for each in _headlines(compared)],
        partly=not common and a.rows.keys() != b.rows.keys(),
        found=found,
        fault="" if differences is None else differences.error,
        counts={"": len(found.samples), **{each: len(found.chosen(each)) for each in _BETTER}} if found else {},
        better=better,
        address=partial(_address, better=better, common="1" if common else ""),
        swapped=_address(better=_OTHER.get(better, ""), common="1" if common else ""),
        part=part,
        rows=[_row(a, b, each) for each in part.entries],
        waits=waits,
    )


def _asked_better(request: Request) -> str:
    given = request.query_params.get("better", "")
    return given if given in _BETTER else ""


def _address(**chosen: object) -> str:
    """The parameters of the address with these choices; those that are empty are left out."""
    given = {name: value for name, value in chosen.items() if value}
    return f"?{urlencode(given)}" if given else ""


def _headlines(comparison: Comparison) -> list[ComparedNumber]:
    return [each for each in comparison.numbers if each.headline is not None]


def _tested(number: ComparedNumber) -> dict[str, str]:
    """A headline number of both, and whether its difference is real."""
    unit: Any = number.unit
    interval = "" if number.low is None or number.high is None else f"{number.low:+.3f} to {number.high:+.3f}"
    return {
        "name": str(number.headline),
        "a": value_text(number.a, unit),
        "b": value_text(number.b, unit),
        "difference": value_text(number.difference, unit, signed=True),
        "interval": interval,
        "p": "–" if number.adjusted_p is None else f"{number.adjusted_p:.3f}",
        "decision": number.decision,
    }


def _sides(a: Evaluated, b: Evaluated) -> list[dict[str, str]]:
    """The headline numbers of both, without tests."""
    values = [{each.name: each.text for each in told.headlines} for told in (a, b)]
    names = list(dict.fromkeys(name for each in values for name in each))
    return [
        {"name": name, **{side: each.get(name, "–") for side, each in zip(_BETTER, values, strict=True)}}
        for name in names
    ]


def _row(a: Model, b: Model, each: ComparedSample) -> dict[str, Any]:
    words = [verdict(model.setup.task, model.rows.get(each.token, {})) for model in (a, b)]
    return {"sample": each, "path": sample_path(each.token), "a": words[0], "b": words[1]}


def _sample(request: Request) -> Response:
    explorer, (a, b) = explorer_of(request), _pair(request)
    token = known_sample(request, a, b)
    shared = a.rows.keys() & b.rows.keys()
    before, after = beside_in_time(shared, token)
    job = differences_job(explorer, a, b)
    better = _asked_better(request)
    waits = titles([job])
    found: ComparedSamples | None = job.result
    ranked = () if found is None else tuple(each.token for each in found.chosen(better))
    return page(
        request,
        "compare_sample.html",
        a=a,
        b=b,
        token=token,
        path=sample_path(token),
        sides=[sample_context(explorer, model, token) for model in (a, b)],
        before=before,
        after=after,
        place=place_in(ranked, token),
        better=better,
        address=partial(_address, better=better),
        swapped=_address(better=_OTHER.get(better, "")),
        ahead=asked_ahead(request),
        aheads=frames_ahead(explorer, a, token) and frames_ahead(explorer, b, token),
        waits=waits,
        sample_path=sample_path,
    )
