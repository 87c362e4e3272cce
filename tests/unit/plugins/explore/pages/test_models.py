"""Pages of models, asked as a browser asks: what they list, where each bar leads, what they refuse
to open.
"""

import html
import json
import re
import shlex
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode, urljoin, urlsplit

import numpy as np
import pytest
from asgi import Answer, get
from evaluation_runs import BREAKDOWNS, stored_run
from wording import holding, lacking

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import Accident, Resampling, ResultsWriter
from deepaccident_devkit.evaluation.runs import (
    EvaluationRun,
    default_selection,
    evaluate_results,
    save_run,
)
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.plugins.explore import Explorer, make_app
from deepaccident_devkit.plugins.explore.evaluations import verdict_text
from deepaccident_devkit.plugins.explore.pages.samples import sample_path
from deepaccident_devkit.render.outcomes.above import count_words

pytestmark = pytest.mark.slow

BOXES = EvaluationSetup(task="accident", protocol="boxes")
HOSTILE = """<img src=x onerror=alert(1)> "a" & 'b' ..%2e%2e?#;"""
ELSEWHERE = (Accident(positions=np.full((2, 2), 30.0), time=0.5, score=0.9),)


@dataclass
class Site:
    """The pages of an explorer, and the runs behind its bundles."""

    explorer: Explorer
    runs: dict[str, EvaluationRun] = field(default_factory=dict)
    folder: Path = Path()

    def __post_init__(self) -> None:
        self.app = make_app(self.explorer)

    def get(self, address: str) -> Answer:
        return get(self.app, address)

    def page(self, address: str) -> str:
        """The page when no more is waited for."""
        for _ in range(3):
            answer = self.get(address)
            assert answer.status == 200, answer.text
            if "data-titles" not in answer.text:
                return answer.text
            assert self.explorer.jobs.wait(60)
        raise AssertionError(f"{address}: waits and waits")

    def samples(self, address: str) -> list[str]:
        """The samples of all pages of a list, in order."""
        page = self.page(address)
        found = [sample_of(urljoin(address, each)) for each in hrefs(page, "entry")]
        return found + [
            token
            for each in hrefs(page, rel="next")
            for token in self.samples(urljoin(address, each))
        ]

    def rows(self, name: str) -> Any:
        return self.explorer.models[name].rows


def hrefs(page: str, kind: str = "", rel: str = "") -> list[str]:
    """Addresses of the links of a class or relation, or of all links in the content."""
    tags = re.findall(r"<a [^>]*>", page.partition('<main id="content">')[2])
    wanted = [
        each
        for each in tags
        if (f'class="{kind}"' in each or not kind) and (f'rel="{rel}"' in each or not rel)
    ]
    return [html.unescape(re.findall(r'href="([^"]*)"', each)[0]) for each in wanted]


def images(page: str) -> list[str]:
    return [html.unescape(each) for each in re.findall(r'<img src="([^"]+)"', page)]


def sample_of(address: str) -> str:
    """The token of a sample's address."""
    *scenario, agent, frame = urlsplit(address).path.split("/sample/")[1].split("/")
    return f"{'/'.join(scenario)}/{agent}/{int(frame):03d}"


def of(kind: str, name: str, *parts: str, **query: str) -> str:
    """An address below a model."""
    return f"/{kind}/{quote(name, safe='')}/{'/'.join(parts)}" + (
        f"?{urlencode(query)}" if query else ""
    )


def written(path: Path, foreseen: Sequence[Accident], tokens: Sequence[str]) -> Path:
    """Results that foresee the same at all samples."""
    with ResultsWriter(path, "accident", meta={"method": path.stem}) as writer:
        for token in tokens:
            writer.add(token, [*foreseen])
    return path


def make_hostile(summary: dict[str, Any]) -> None:
    method = {"method": "<script>alert(1)</script>"}
    summary["results"] |= {"meta": method, "path": "<b onclick=x>", "fingerprint": "5e"}
    summary["breakdowns"]["town"] = summary["breakdowns"]["agent"]
    summary["breakdowns"]["town"]["groups"][0]["value"] = '"><svg onload=alert(1)>'


def edit_summary(folder: Path, edit: Callable[[dict[str, Any]], object]) -> None:
    path = folder / "metrics_summary.json"
    summary = json.loads(path.read_text())
    edit(summary)
    path.write_text(json.dumps(summary))


def bundle(
    da: DeepAccident, folder: Path, path: Path, setup: EvaluationSetup = BOXES, **how: Any
) -> EvaluationRun:
    run = evaluate_results(
        da, path, setup, default_selection(setup, "train"), workers=1, allow_partial=True
    )
    run = run.broken_down(BREAKDOWNS, Resampling(resamples=20))
    save_run(run, folder, **how)
    return run


@pytest.fixture(scope="module")
def site(da_motion: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """Evaluations of accidents (with and without a copy, by another protocol, partial, with a
    hostile name), of motion and of boxes; and results alone."""
    folder, da = tmp_path_factory.mktemp("models"), da_motion
    tokens = default_selection(BOXES, "train").tokens(da)
    runs = {"first": stored_run(da, BOXES, folder / "first.json")[0]}
    save_run(runs["first"], folder / "first", include_results=True)
    quiet = written(folder / "quiet.json", (), tokens)
    runs["second"] = bundle(da, folder / "second", quiet)
    runs["paper"] = bundle(da, folder / "paper", quiet, replace(BOXES, protocol="paper"))
    runs["part"] = bundle(
        da,
        folder / "part",
        written(folder / "few.json", ELSEWHERE, tokens[::2]),
        include_results=True,
    )
    shutil.copytree(folder / "second", folder / HOSTILE)
    edit_summary(folder / HOSTILE, make_hostile)
    for task in ("motion", "detection", "warning", "forecasting"):
        clean = task in ("warning", "forecasting")
        setup = EvaluationSetup(task=task, protocol="clean" if clean else "released")
        runs[task], _ = stored_run(
            da, setup, folder / ("maps" if task == "motion" else f"{task}.json")
        )
        save_run(runs[task], folder / task, include_results=True)
    alone = written(folder / "alone.json", ELSEWHERE, tokens)
    explorer = Explorer(
        da, bundles=[folder / name for name in (*runs, HOSTILE)], results=[alone], workers=1
    )
    explorer.begin()
    yield Site(explorer, runs, folder)
    explorer.jobs.end()


@pytest.fixture
def opened(da_motion: DeepAccident, request: pytest.FixtureRequest) -> Callable[..., Site]:
    """Further explorers of bundles and results, which end with the test."""

    def other(dataset: DeepAccident = da_motion, **models: Any) -> Site:
        explorer = Explorer(dataset, workers=1, **models)
        request.addfinalizer(explorer.jobs.end)
        return Site(explorer)

    return other


def a_sample(site: Site, name: str = "first") -> str:
    return max(site.runs[name].evaluator.tokens)


# lists and bars


@pytest.mark.parametrize("name", ["first", "second", "part", "motion", "detection"])
@pytest.mark.parametrize("order", ["worst", "best"])
def test_the_worst_samples_come_first(site: Site, name: str, order: str) -> None:
    shown, run = site.samples(of("model", name, "samples", order=order)), site.runs[name]
    assert sorted(shown) == sorted(run.evaluator.tokens)
    values = [main_number(run, token) for token in shown]
    known = [each for each in values if each is not None]
    assert values == sorted(known, reverse=order == "best") + [None] * (len(values) - len(known))
    assert len(set(known)) > 1 or name not in ("first", "motion")


def main_number(run: EvaluationRun, token: str) -> float | None:
    """A sample's number, as the evaluator computes it; 0 where something is false and nothing is to
    be found.
    """
    result = run.evaluator.compute([token])
    false = run.setup.task == "accident" and bool(result.within[15.0].fp)
    value: float = {
        "accident": lambda: result.apa,
        "motion": lambda: result.ranges["100x100"].pq,
        "detection": lambda: result.mean_average_precision,
    }[run.setup.task]()
    return value if not np.isnan(value) else 0.0 if false else None


def test_a_scenario_and_a_group_can_be_chosen_together(site: Site) -> None:
    tokens = site.runs["detection"].attributes
    scenario = min(each.scenario for each in tokens.values())
    found = site.samples(
        of("model", "detection", "samples", by="agent", value="infrastructure", scenario=scenario)
    )
    assert sorted(found) == sorted(
        each for each in tokens if each.startswith(f"{scenario}/infrastructure/")
    )
    for nothing in ("scenario=no/such", "by=agent&value=nobody"):
        assert not site.samples(f"/model/detection/samples?{nothing}")


def test_warnings_are_listed_in_time_sixty_a_page(site: Site) -> None:
    """Single samples of recordings have no numbers."""
    address, tokens = "/model/warning/samples", site.runs["warning"].evaluator.tokens
    assert site.samples(address) == sorted(tokens)
    assert "worst" not in site.page(address)
    assert [len(hrefs(site.page(f"{address}?page={page}"), "entry")) for page in (1, 2)] == [
        60,
        len(tokens) - 60,
    ]
    assert all(
        hrefs(site.page(f"{address}?page={page}"), "entry")
        for page in ("-1", "0", "x", "99999999999")
    )


# verdicts


def test_accident_verdicts_are_those_of_the_evaluator(site: Site) -> None:
    for name, token in (
        (each, token) for each in ("first", "second", "part") for token in site.rows(each)
    ):
        within, row = site.runs[name].evaluator.compute([token]).within, site.rows(name)[token]
        whole = ", ".join(
            f"{distance:g} m: {count_words(each)}" for distance, each in within.items()
        )
        assert verdict_text("accident", row).split(",")[0] == count_words(within[15.0])
        assert verdict_text("accident", row, in_full=True).startswith(whole)
    page = site.page(of("model", "first", "sample", sample_path(a_sample(site))))
    assert verdict_text(
        "accident", site.rows("first")[a_sample(site)], in_full=True
    ) in html.unescape(page)


@pytest.mark.parametrize(
    "task", ["accident", "motion", "detection", "warning", "planning", "forecasting"]
)
def test_verdicts_of_a_strange_row_are_no_error(task: str) -> None:
    row = {
        "tp_5m": "<b>",
        "tp_..m": 1,
        "pq_1x1": "x",
        "pq_..x.": None,
        "iou_1x1": True,
        "truths": 1e400,
        "tp_.": [1],
    }
    for whole in (False, True):
        assert {type(verdict_text(task, each, in_full=whole)) for each in (row, {})} == {str}


# a sample


@pytest.mark.parametrize("name", ["first", "motion", "detection", "warning", "alone"])
def test_a_sample_shows_the_prediction_from_above_and_in_cameras(site: Site, name: str) -> None:
    address = of("model", name, "sample", sample_path(min(site.explorer.models[name].tokens)))
    answers = [site.get(urljoin(address, each)) for each in images(site.page(address))]
    told = [(each.status, each.headers["content-type"], each.body[:4]) for each in answers]
    assert told == [(200, "image/png", b"\x89PNG")] * 2


def test_motion_is_shown_frame_by_frame(site: Site) -> None:
    def ahead(token: str) -> list[str]:
        page = site.page(of("model", "motion", "sample", sample_path(token)))
        return [each for each in hrefs(page) if each.endswith("#ahead")]

    tokens = site.runs["motion"].evaluator.tokens
    first, last = (len(ahead(each(tokens))) for each in (min, max))
    assert last < first == 5  # from now to 2 s; the recording ends
    pictures = f"{of('model', 'motion', 'sample', sample_path(min(tokens)))}/cameras.png?ahead="
    assert [site.get(f"{pictures}{wrong}").status for wrong in ("5", "-1", "x", "999")] == [404] * 4


def test_a_sample_leads_to_the_ones_before_and_after(site: Site) -> None:
    """In time those of the same agent, in the list those of the group."""
    choices = {"by": "time_to_impact", "value": "1 s"}
    worse, token, better, *_ = site.samples(of("model", "first", "samples", **choices))
    address = of("model", "first", "sample", sample_path(token), **choices)
    page, (scenario, agent, frame) = site.page(address), token.rsplit("/", 2)
    same = sorted(each for each in site.rows("first") if each.startswith(f"{scenario}/{agent}/"))
    at = same.index(token)
    links = [*hrefs(page, rel="prev"), *hrefs(page, rel="next")]
    links += [re.findall(f'<a id="{name}" href="([^"]+)"', page)[0] for name in ("worse", "better")]
    expected = [*same[at - 1 : at], *same[at + 1 : at + 2], worse, better]
    assert [sample_of(urljoin(address, each)) for each in links] == expected
    assert f"/scenario/{scenario}/?frame={int(frame)}&model=first" in [
        urljoin(address, each) for each in hrefs(page)
    ]


def test_a_sample_that_is_not_evaluated_is_a_sentence(site: Site) -> None:
    missed = max(site.runs["first"].evaluator.tokens - site.runs["part"].evaluator.tokens)
    address = of("model", "part", "sample", sample_path(missed))
    page = site.page(address)
    assert not lacking(page, "predicts nothing for this sample", "is not in the evaluation")
    assert (images(page), site.get(f"{address}/above.png").status) == ([], 404)


# results that are not given, and what is not opened


def test_the_results_that_a_bundle_names_are_not_opened(
    site: Site, opened: Callable[..., Site]
) -> None:
    """They are there, and the release has all samples; yet a bundle may come from anywhere."""
    path = site.explorer.models["second"].bundle.summary["results"]["path"]  # type: ignore[union-attr]
    assert Path(path).is_file()
    address = of("model", "second", "sample", sample_path(a_sample(site, "second")))
    names: set[str] = set()
    watching = [True]  # a hook cannot be taken away again
    sys.addaudithook(
        lambda event, told: watching and event == "open" and names.add(Path(str(told[0])).name)
    )
    other = opened(bundles=[site.folder / "second"])
    page, of_model, _ = (
        other.page(each) for each in (address, "/model/second/", "/model/second/samples")
    )
    assert other.get(f"{address}/above.png").status == 404
    watching.clear()
    assert ("samples.parquet" in names, Path(path).name in names) == (True, False)
    assert not lacking(page, "--results PATH", html.escape(path))
    assert (images(page), "--results PATH" in of_model) == ([], True)


def test_given_results_join_their_bundle(site: Site, opened: Callable[..., Site]) -> None:
    other = opened(bundles=[site.folder / "second"], results=[site.folder / "quiet.json"])
    assert [*other.explorer.models] == ["second"]
    assert images(
        other.page(of("model", "second", "sample", sample_path(a_sample(site, "second"))))
    )


# the command


def test_results_without_an_evaluation_show_how_to_make_one(
    site: Site, da_motion: DeepAccident
) -> None:
    (shown,) = re.findall(r'<pre class="wide" id="command">(.*?)</pre>', site.page("/model/alone/"))
    words = ["deepaccident", "evaluate", "accident", str(da_motion.dataroot), "--version", "v1"]
    words += [
        "--results",
        str(site.folder / "alone.json"),
        "--protocol",
        "boxes",
        "--out",
        "alone_bundle",
    ]
    assert shlex.split(html.unescape(shown)) == words


# names and addresses of strangers


def test_names_are_escaped_and_lead_to_their_pages(site: Site) -> None:
    address = urljoin(
        "/models/",
        next(each for each in hrefs(site.page("/models/"), "entry") if "onerror" in each),
    )
    own, listed = site.page(address), site.page(urljoin(address, "samples"))
    sample = site.page(urljoin(urljoin(address, "samples"), hrefs(listed, "entry")[0]))
    for page in (
        site.page("/models/"),
        own,
        listed,
        sample,
        site.page(of("compare", "first", HOSTILE_PART, "")),
    ):
        assert not holding(page, "<img src=x", "<script>alert", "<svg onload", "<b onclick")
    assert not lacking(own, "All 20 samples", html.escape("<b onclick=x>"))
    assert urljoin(address, next(each for each in hrefs(own) if "onload" in each)).startswith(
        address
    )


HOSTILE_PART = (
    "%3Cimg%20src%3Dx%20onerror%3Dalert%281%29%3E%20%22a%22%20%26%20%27b%27%20..%252e%252e%3F%23%3B"
)


@pytest.mark.parametrize(
    "address",
    [
        "/model/none/",
        "/model/../",
        "/model/%2e%2e/",
        "/model/%2e%2e%2f%2e%2e/",
        "/model/first/sample/no/such/ego_vehicle/1",
        "/model/first/sample/no/such/nobody/1",
        "/model/first/sample/../../ego_vehicle/1",
        "/model/first/sample/%2e%2e/%2e%2e/ego_vehicle/1/above.png",
        "/model/first/sample/no/such/ego_vehicle/12345",
        "/model/first/samples?by=<script>",
        "/compare/first/none/",
        "/compare/first/alone/",
        "/compare/none/first/sample/no/such/ego_vehicle/1",
    ],
)
def test_what_is_not_there_is_not_found(site: Site, address: str) -> None:
    answer = site.get(address)
    assert (answer.status, "<script>" not in answer.text) == (404, True)


@pytest.mark.parametrize(
    "address",
    [
        "/models/",
        "/model/first/",
        "/model/alone/",
        "/model/first/samples",
        "/compare/first/second/",
    ],
)
def test_pages_keep_to_the_policy(site: Site, address: str) -> None:
    """No style and script in the page, and only relative addresses."""
    forbidden = r""" style=|<style|<script(?![^>]* src=)|(?:href|src|action)=["'](?:/|https?:)"""
    assert re.findall(forbidden, site.page(address)) == []


def test_a_damaged_summary_is_a_sentence(
    site: Site, opened: Callable[..., Site], tmp_path: Path
) -> None:
    shutil.copytree(site.folder / "second", tmp_path / "broken")
    edit_summary(tmp_path / "broken", lambda summary: summary["headlines"][0].update(name={"a": 1}))
    answer = opened(bundles=[tmp_path / "broken"]).get("/model/broken/")
    assert (answer.status, "evaluate again" in answer.text) == (500, True)


# marks and warnings


def test_another_release_lacks_the_samples(
    site: Site, da: DeepAccident, opened: Callable[..., Site]
) -> None:
    other = opened(da, bundles=[site.folder / "first"])
    assert sorted(other.samples("/model/first/samples")) == sorted(
        site.runs["first"].evaluator.tokens
    )
    for address, *told in (
        ("/model/first/", "1 scenario of this evaluation is not in this release"),
        ("/model/first/samples?by=agent&value=ego_vehicle", "20 samples are not in this release"),
        (
            of("model", "first", "sample", sample_path(a_sample(site))),
            "This sample is not in this release.",
            "5 m: ",
        ),
    ):
        assert not lacking(other.page(address), *told)


def test_without_models_the_page_says_how_to_give_some(opened: Callable[..., Site]) -> None:
    assert not lacking(opened().page("/models/"), "--results PATH", "deepaccident evaluate")


# side by side


def test_a_comparison_has_the_largest_differences_first(site: Site) -> None:
    def difference(token: str) -> float:
        one, other = (main_number(site.runs[name], token) for name in ("first", "second"))
        return (1.0 if other is None else other) - (1.0 if one is None else one)

    shown = site.samples("/compare/first/second/")
    assert sorted(shown) == sorted(site.runs["first"].evaluator.tokens)
    differences = {token: difference(token) for token in shown}
    sizes = [abs(each) for each in differences.values()]
    assert sizes == sorted(sizes, reverse=True)
    better = site.samples("/compare/first/second/?better=a")
    assert sorted(better) == sorted(token for token, each in differences.items() if each < 0)
    assert site.samples("/compare/second/first/?better=b") == better


def test_what_cannot_be_compared_says_why(site: Site) -> None:
    whys = {
        "second/paper": "not evaluated by the same rules",
        "first/motion": "compare two of the same task",
    }
    for pair, why in whys.items():
        assert not lacking(html.unescape(site.page(f"/compare/{pair}/")), "cannot be compared", why)
    assert site.samples("/compare/second/paper/")  # the samples can be, by their own numbers


def test_two_models_at_the_same_moment(site: Site) -> None:
    token = site.samples("/compare/first/second/?better=a")[0]
    address = of("compare", "first", "second", "sample", sample_path(token), better="a")
    page = site.page(address)
    verdicts = [
        verdict_text("accident", site.rows(name)[token], in_full=True)
        for name in ("first", "second")
    ]
    assert not lacking(html.unescape(page), *verdicts)
    pictures = [urlsplit(each).path.rsplit("/", 1)[1] for each in images(page)]
    assert (page.count("<section"), pictures) == (
        2,
        ["above.png", "cameras.png"],
    )  # second has none
    assert [site.get(urljoin(address, each)).status for each in images(page)] == [200, 200]
    swapped = of("compare", "second", "first", "sample", sample_path(token), better="b")
    assert [urljoin(address, each) for each in hrefs(page) if "/second/first/" in each] == [swapped]
