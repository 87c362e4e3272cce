"""Pages of models, requested as a browser does: their lists, the target of each bar, and the files
that they refuse to open.
"""

import html
import json
import re
import shlex
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode, urljoin, urlsplit

import numpy as np
import pytest
from support.asgi_client import Response, get_response
from support.evaluation_runs import BREAKDOWNS, stored_run
from support.text_contents import contained_parts, missing_parts

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import Accident, Resampling, ResultsWriter
from deepaccident_devkit.evaluation.accident.scoring import count_words
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

pytestmark = pytest.mark.slow

BOXES = EvaluationSetup(task="accident", protocol="boxes")
HOSTILE = """<img src=x onerror=alert(1)> "a" & 'b' ..%2e%2e?#;"""
FALSE_ALARM = (Accident(positions=np.full((2, 2), 30.0), time=0.5, score=0.9),)


@dataclass
class Site:
    """The pages of an explorer, and the runs that its bundles were saved from."""

    explorer: Explorer
    runs: dict[str, EvaluationRun] = field(default_factory=dict)
    folder: Path = Path()

    def __post_init__(self) -> None:
        self.app = make_app(self.explorer)

    def get(self, address: str) -> Response:
        return get_response(self.app, address)

    def page(self, address: str) -> str:
        """Return the page once its work is done."""
        for _ in range(3):
            response = self.get(address)
            assert response.status == 200, response.text
            if "data-titles" not in response.text:
                return response.text
            assert self.explorer.jobs.wait(60)
        raise AssertionError(f"{address}: waits and waits")

    def samples(self, address: str) -> list[str]:
        """Return the samples on all pages of a list, in order."""
        page = self.page(address)
        tokens = []
        for link in link_addresses(page, "entry"):
            tokens.append(token_of_address(urljoin(address, link)))
        for link in link_addresses(page, rel="next"):
            tokens += self.samples(urljoin(address, link))
        return tokens

    def rows(self, name: str) -> Any:
        return self.explorer.models[name].rows


def link_addresses(page: str, kind: str = "", rel: str = "") -> list[str]:
    """Return the addresses of the links in the content, of one class or relation if given."""
    addresses = []
    for tag in re.findall(r"<a [^>]*>", page.partition('<main id="content">')[2]):
        has_kind = not kind or f'class="{kind}"' in tag
        has_rel = not rel or f'rel="{rel}"' in tag
        if has_kind and has_rel:
            address = re.findall(r'href="([^"]*)"', tag)[0]
            addresses.append(html.unescape(address))
    return addresses


def image_addresses(page: str) -> list[str]:
    return [html.unescape(address) for address in re.findall(r'<img src="([^"]+)"', page)]


def picture_names(page: str) -> list[str]:
    return [Path(urlsplit(address).path).stem for address in image_addresses(page)]


def token_of_address(address: str) -> str:
    _, path = urlsplit(address).path.split("/sample/", 1)
    recording, frame = path.rsplit("/", 1)
    return f"{recording}/{int(frame):03d}"


def model_address(kind: str, name: str, *parts: str, **query: str) -> str:
    path = "/".join([quote(name, safe=""), *parts])
    question = f"?{urlencode(query)}" if query else ""
    return f"/{kind}/{path}{question}"


def write_results(path: Path, accidents: Sequence[Accident], tokens: Sequence[str]) -> Path:
    """Write results with the same accidents at all samples."""
    with ResultsWriter(path, "accident", meta={"method": path.stem}) as writer:
        for token in tokens:
            writer.add(token, [*accidents])
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


def edit_results(folder: Path, **changes: str) -> None:
    edit_summary(folder, lambda summary: summary["results"].update(changes))


def save_bundle(
    da: DeepAccident,
    folder: Path,
    results: Path,
    setup: EvaluationSetup = BOXES,
    *,
    include_results: bool = False,
) -> EvaluationRun:
    selection = default_selection(setup, "train")
    run = evaluate_results(da, results, setup, selection, workers=1, allow_partial=True)
    run = run.broken_down(BREAKDOWNS, Resampling(resamples=20))
    save_run(run, folder, include_results=include_results)
    return run


@pytest.fixture(scope="module")
def site(da_motion: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """Open a site of evaluations and of results without one.

    The evaluations are of accidents (with and without a copy of the results, by another protocol,
    partial, with a hostile name and without results), and of all other tasks.
    """
    folder = tmp_path_factory.mktemp("models")
    tokens = default_selection(BOXES, "train").tokens(da_motion)
    runs = {"first": stored_run(da_motion, BOXES, folder / "first.json")[0]}
    save_run(runs["first"], folder / "first", include_results=True)
    quiet = write_results(folder / "quiet.json", (), tokens)
    paper = replace(BOXES, protocol="paper")
    few = write_results(folder / "few.json", FALSE_ALARM, tokens[::2])
    runs["second"] = save_bundle(da_motion, folder / "second", quiet)
    runs["paper"] = save_bundle(da_motion, folder / "paper", quiet, paper)
    runs["part"] = save_bundle(da_motion, folder / "part", few, include_results=True)
    shutil.copytree(folder / "second", folder / HOSTILE)
    edit_summary(folder / HOSTILE, make_hostile)
    for task, protocol, name in (
        ("motion", "released", "maps"),
        ("detection", "released", "detection.json"),
        ("warning", "clean", "warning.json"),
        ("planning", "clean", "planning.json"),
        ("forecasting", "clean", "forecasting.json"),
    ):
        setup = EvaluationSetup(task=task, protocol=protocol)
        runs[task], _ = stored_run(da_motion, setup, folder / name)
        save_run(runs[task], folder / task, include_results=True)

    alone = write_results(folder / "alone.json", FALSE_ALARM, tokens)
    bundles = [folder / name for name in (*runs, HOSTILE)]
    explorer = Explorer(da_motion, bundles=bundles, results=[alone], workers=1)
    explorer.begin()
    yield Site(explorer, runs, folder)
    explorer.jobs.end()


@pytest.fixture
def open_site(da_motion: DeepAccident, request: pytest.FixtureRequest) -> Callable[..., Site]:
    """Return a function that opens a further explorer of bundles and results until the test
    ends.
    """

    def open_explorer(dataset: DeepAccident = da_motion, **models: Any) -> Site:
        explorer = Explorer(dataset, workers=1, **models)
        request.addfinalizer(explorer.jobs.end)
        return Site(explorer)

    return open_explorer


def last_token(site: Site, name: str = "first") -> str:
    return max(site.runs[name].evaluator.tokens)


# lists and bars


@pytest.mark.parametrize("name", ["first", "second", "part", "motion", "detection"])
@pytest.mark.parametrize("order", ["worst", "best"])
def test_the_worst_samples_come_first(site: Site, name: str, order: str) -> None:
    run = site.runs[name]
    tokens = site.samples(model_address("model", name, "samples", order=order))
    assert sorted(tokens) == sorted(run.evaluator.tokens)

    numbers = [main_number(run, token) for token in tokens]
    known = [number for number in numbers if number is not None]
    num_unknown = len(numbers) - len(known)
    assert numbers == sorted(known, reverse=order == "best") + [None] * num_unknown
    assert len(set(known)) > 1 or name not in ("first", "motion")


def main_number(run: EvaluationRun, token: str) -> float | None:
    """Return a sample's number as the evaluator computes it; without anything to find it is 0 if
    something is false, and None otherwise.
    """
    result = run.evaluator.compute([token])
    has_false_alarms = False
    if run.setup.task == "accident":
        number = result.apa
        has_false_alarms = bool(result.within[15.0].fp)
    elif run.setup.task == "motion":
        number = result.ranges["100x100"].pq
    else:
        number = result.mean_average_precision
    if np.isnan(number):
        return 0.0 if has_false_alarms else None
    return number


def test_a_scenario_and_a_group_can_be_chosen_together(site: Site) -> None:
    attributes = site.runs["detection"].attributes
    scenario = min(record.scenario for record in attributes.values())
    group = {"by": "agent", "value": "infrastructure"}
    address = model_address("model", "detection", "samples", **group, scenario=scenario)
    expected = [token for token in attributes if token.startswith(f"{scenario}/infrastructure/")]
    assert sorted(site.samples(address)) == sorted(expected)
    for query in ("scenario=no/such", "by=agent&value=nobody"):
        assert not site.samples(f"/model/detection/samples?{query}")


def test_warnings_are_listed_in_time_sixty_a_page(site: Site) -> None:
    """A single sample of a recording has no number to sort by."""
    address, tokens = "/model/warning/samples", site.runs["warning"].evaluator.tokens
    assert site.samples(address) == sorted(tokens)
    assert "worst" not in site.page(address)

    def entries(page: str) -> list[str]:
        return link_addresses(site.page(f"{address}?page={page}"), "entry")

    assert len(entries("1")) == 60
    assert len(entries("2")) == len(tokens) - 60
    for page in ("-1", "0", "x", "99999999999"):
        assert entries(page)


# verdicts


def test_accident_verdicts_agree_with_the_evaluator(site: Site) -> None:
    for name in ("first", "second", "part"):
        for token, row in site.rows(name).items():
            within = site.runs[name].evaluator.compute([token]).within
            full_text = ", ".join(
                f"{distance:g} m: {count_words(counts)}" for distance, counts in within.items()
            )
            assert verdict_text("accident", row).split(",")[0] == count_words(within[15.0])
            assert verdict_text("accident", row, in_full=True).startswith(full_text)
    token = last_token(site)
    page = site.page(model_address("model", "first", "sample", sample_path(token)))
    verdict = verdict_text("accident", site.rows("first")[token], in_full=True)
    assert verdict in html.unescape(page)


@pytest.mark.parametrize(
    "task", ["accident", "motion", "detection", "warning", "task of a plug-in"]
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
    for in_full in (False, True):
        assert isinstance(verdict_text(task, row, in_full=in_full), str)
        assert isinstance(verdict_text(task, {}, in_full=in_full), str)


# a sample


@pytest.mark.parametrize(
    "name",
    ["first", "motion", "detection", "warning", "planning", "forecasting", "alone", HOSTILE],
)
def test_a_sample_shows_the_prediction_and_always_the_truth(site: Site, name: str) -> None:
    token = min(site.explorer.models[name].tokens)
    address = model_address("model", name, "sample", sample_path(token))
    page = site.page(address)
    names = ["above", "cameras", "truth"]
    assert picture_names(page) == (names[-1:] if name == HOSTILE else names)
    for picture in image_addresses(page):
        response = site.get(urljoin(address, picture))
        assert response.status == 200
        assert response.headers["content-type"] == "image/png"
        assert response.body.startswith(b"\x89PNG")


def test_motion_is_shown_frame_by_frame(site: Site) -> None:
    def count_frames(token: str) -> int:
        page = site.page(model_address("model", "motion", "sample", sample_path(token)))
        return sum(link.endswith("#ahead") for link in link_addresses(page))

    tokens = site.runs["motion"].evaluator.tokens
    assert count_frames(min(tokens)) == 5  # from now to 2 s
    assert count_frames(max(tokens)) < 5  # the recording ends
    address = model_address("model", "motion", "sample", sample_path(min(tokens)))
    for frame in ("5", "-1", "x", "999"):
        assert site.get(f"{address}/cameras.png?ahead={frame}").status == 404


def test_a_sample_leads_to_the_ones_before_and_after(site: Site) -> None:
    """Its neighbours in time have the same agent, its neighbours in the list the same group."""
    group = {"by": "time_to_impact", "value": "1 s"}
    worse, token, better, *_ = site.samples(model_address("model", "first", "samples", **group))
    address = model_address("model", "first", "sample", sample_path(token), **group)
    page = site.page(address)
    recording, frame = token.rsplit("/", 1)
    scenario = recording.rsplit("/", 1)[0]
    recorded = sorted(row for row in site.rows("first") if row.startswith(f"{recording}/"))
    index = recorded.index(token)
    neighbours = recorded[index - 1 : index] + recorded[index + 1 : index + 2]

    links = link_addresses(page, rel="prev") + link_addresses(page, rel="next")
    for name in ("worse", "better"):
        links += re.findall(f'<a id="{name}" href="([^"]+)"', page)[:1]
    tokens = [token_of_address(urljoin(address, link)) for link in links]
    assert tokens == [*neighbours, worse, better]
    scenario_address = f"/scenario/{scenario}/?frame={int(frame)}&model=first"
    assert scenario_address in [urljoin(address, link) for link in link_addresses(page)]


def test_a_sample_that_is_not_evaluated_is_a_sentence(site: Site) -> None:
    token = max(site.runs["first"].evaluator.tokens - site.runs["part"].evaluator.tokens)
    address = model_address("model", "part", "sample", sample_path(token))
    page = site.page(address)
    assert not missing_parts(page, "has no prediction for this sample", "is not in the evaluation")
    assert picture_names(page) == ["truth"]
    assert site.get(f"{address}/above.png").status == 404


# results that a bundle names


def test_the_results_that_a_bundle_names_are_shown_if_they_are_the_same(
    site: Site, open_site: Callable[..., Site], tmp_path: Path
) -> None:
    """Without them, a page has the truth and a sentence, until the results are given."""
    path = sample_path(last_token(site, "second"))
    results = site.folder / "quiet.json"
    assert "The predictions are not shown" not in site.page("/model/second/")
    for name, entry in (("changed", {"fingerprint": "5e"}), ("moved", {"path": "/no/such"})):
        shutil.copytree(site.folder / "second", tmp_path / name)
        edit_results(tmp_path / name, **entry)
        other = open_site(bundles=[tmp_path / name])
        for page in (other.page(f"/model/{name}/"), other.page(f"/model/{name}/sample/{path}")):
            assert "is missing or has changed. Pass them with --results PATH" in page
        assert picture_names(page) == ["truth"]
        assert other.get(f"/model/{name}/sample/{path}/above.png").status == 404

    other = open_site(bundles=[tmp_path / "moved"], results=[results])
    assert [*other.explorer.models] == ["moved"]
    assert picture_names(other.page(f"/model/moved/sample/{path}")) == ["above", "cameras", "truth"]


# the command


def test_results_without_an_evaluation_show_how_to_make_one(
    site: Site, da_motion: DeepAccident
) -> None:
    page = site.page("/model/alone/")
    (command,) = re.findall(r'<pre class="wide" id="command">(.*?)</pre>', page)
    expected = ["deepaccident", "evaluate", "accident", str(da_motion.dataroot)]
    expected += ["--version", "v1", "--results", str(site.folder / "alone.json")]
    expected += ["--protocol", "boxes", "--out", "alone_bundle"]
    assert shlex.split(html.unescape(command)) == expected


# hostile names and addresses


def test_names_are_escaped_and_lead_to_their_pages(site: Site) -> None:
    list_page = site.page("/models/")
    entries = link_addresses(list_page, "entry")
    address = urljoin("/models/", next(link for link in entries if "onerror" in link))
    samples_address = urljoin(address, "samples")
    model_page, samples_page = site.page(address), site.page(samples_address)
    first_sample = link_addresses(samples_page, "entry")[0]
    sample_page = site.page(urljoin(samples_address, first_sample))
    comparison = site.page(model_address("compare", "first", HOSTILE_PART, ""))

    for page in (list_page, model_page, samples_page, sample_page, comparison):
        assert not contained_parts(page, "<img src=x", "<script>alert", "<svg onload", "<b onclick")
    assert not missing_parts(model_page, "All 20 samples", html.escape("<b onclick=x>"))
    bar = next(link for link in link_addresses(model_page) if "onload" in link)
    assert urljoin(address, bar).startswith(address)


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
def test_missing_pages_are_not_found(site: Site, address: str) -> None:
    response = site.get(address)
    assert (response.status, "<script>" not in response.text) == (404, True)


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
    """Pages have no inline style or script, and only relative addresses."""
    forbidden = r""" style=|<style|<script(?![^>]* src=)|(?:href|src|action)=["'](?:/|https?:)"""
    assert re.findall(forbidden, site.page(address)) == []


def test_a_damaged_summary_is_a_sentence(
    site: Site, open_site: Callable[..., Site], tmp_path: Path
) -> None:
    folder = tmp_path / "broken"
    shutil.copytree(site.folder / "second", folder)
    edit_summary(folder, lambda summary: summary["headlines"][0].update(name={"a": 1}))
    response = open_site(bundles=[folder]).get("/model/broken/")
    assert (response.status, "evaluate again" in response.text) == (500, True)


# marks and warnings


def test_another_release_lacks_the_samples(
    site: Site, da: DeepAccident, open_site: Callable[..., Site]
) -> None:
    other = open_site(da, bundles=[site.folder / "first"])
    tokens = site.runs["first"].evaluator.tokens
    assert sorted(other.samples("/model/first/samples")) == sorted(tokens)
    sample_address = model_address("model", "first", "sample", sample_path(last_token(site)))
    for address, *messages in (
        ("/model/first/", "1 scenario of this evaluation is not in this release"),
        ("/model/first/samples?by=agent&value=ego_vehicle", "20 samples are not in this release"),
        (sample_address, "This sample is not in this release.", "5 m: "),
    ):
        assert not missing_parts(other.page(address), *messages)


def test_without_models_the_page_says_how_to_give_some(open_site: Callable[..., Site]) -> None:
    page = open_site().page("/models/")
    assert not missing_parts(page, "--results PATH", "deepaccident evaluate")


# side by side


def test_a_comparison_has_the_largest_differences_first(site: Site) -> None:
    def number(name: str, token: str) -> float:
        value = main_number(site.runs[name], token)
        return 1.0 if value is None else value

    tokens = site.samples("/compare/first/second/")
    assert sorted(tokens) == sorted(site.runs["first"].evaluator.tokens)
    differences = {token: number("second", token) - number("first", token) for token in tokens}
    sizes = [abs(difference) for difference in differences.values()]
    assert sizes == sorted(sizes, reverse=True)
    better = site.samples("/compare/first/second/?better=a")
    assert sorted(better) == sorted(token for token in tokens if differences[token] < 0)
    assert site.samples("/compare/second/first/?better=b") == better


def test_models_that_cannot_be_compared_say_why(site: Site) -> None:
    for pair, reason in (
        ("second/paper", "not evaluated by the same rules"),
        ("first/motion", "compare two evaluations of the same task"),
    ):
        page = html.unescape(site.page(f"/compare/{pair}/"))
        assert not missing_parts(page, "cannot be compared", reason)
    assert site.samples("/compare/second/paper/")  # samples can be, by their own numbers


def test_two_models_are_shown_at_the_same_moment(site: Site) -> None:
    token = site.samples("/compare/first/second/?better=a")[0]
    path = sample_path(token)
    address = model_address("compare", "first", "second", "sample", path, better="a")
    page = site.page(address)
    for name in ("first", "second"):
        verdict = verdict_text("accident", site.rows(name)[token], in_full=True)
        assert verdict in html.unescape(page)

    assert page.count("<section") == 2
    assert picture_names(page) == ["truth", *("above", "cameras") * 2]
    for picture in image_addresses(page):
        assert site.get(urljoin(address, picture)).status == 200
    swapped = model_address("compare", "second", "first", "sample", path, better="b")
    swap_links = [link for link in link_addresses(page) if "/second/first/" in link]
    assert [urljoin(address, link) for link in swap_links] == [swapped]
