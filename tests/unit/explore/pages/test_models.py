"""Pages of models, asked as a browser asks: what they list, where each bar leads, what they refuse to open."""

import html
import json
import re
import shlex
import shutil
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, quote, urlencode, urljoin, urlsplit

import numpy as np
import pytest
from asgi import Answer, get
from evaluation_runs import BREAKDOWNS, PARTIAL, stored_run

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import Resampling
from deepaccident_devkit.evaluation.breakdowns import tokens_by_value
from deepaccident_devkit.evaluation.predictions import Accident
from deepaccident_devkit.evaluation.results import ResultsWriter
from deepaccident_devkit.evaluation.runs import EvaluationRun, default_selection, evaluate_results, save_run
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.explore import Explorer, make_app
from deepaccident_devkit.explore.background import Jobs
from deepaccident_devkit.explore.evaluations import verdict
from deepaccident_devkit.explore.pages.samples import sample_path
from deepaccident_devkit.render.outcomes.above import count_words

pytestmark = pytest.mark.slow

BOXES = EvaluationSetup(task="accident", protocol="boxes")
HOSTILE = """<img src=x onerror=alert(1)> "a" & 'b' ..%2e%2e?#;"""
ELSEWHERE = (Accident(positions=np.full((2, 2), 30.0), time=0.5, score=0.9),)


@dataclass
class Site:
    """The pages of an explorer, and the runs behind its bundles."""

    explorer: Explorer
    runs: dict[str, EvaluationRun]
    folder: Path

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
        found: list[str] = []
        while True:
            page = self.page(address)
            found += [sample_of(urljoin(address, each)) for each in hrefs(page, "entry")]
            after = hrefs(page, rel="next")
            if not after:
                return found
            address = urljoin(address, after[0])


def hrefs(page: str, kind: str = "", rel: str = "") -> list[str]:
    """Addresses of the links of a class or relation, or of all links in the content."""
    content = page.partition('<main id="content">')[2]
    tags = re.findall(r"<a [^>]*>", content)
    wanted = [each for each in tags if f'class="{kind}"' in each or not kind]
    wanted = [each for each in wanted if f'rel="{rel}"' in each or not rel]
    return [html.unescape(re.findall(r'href="([^"]*)"', each)[0]) for each in wanted]


def sample_of(address: str) -> str:
    """The token of a sample's address."""
    *scenario, agent, frame = urlsplit(address).path.split("/sample/")[1].split("/")
    return f"{'/'.join(scenario)}/{agent}/{int(frame):03d}"


def of(kind: str, name: str, *parts: str, **query: str) -> str:
    """An address below a model."""
    return f"/{kind}/{quote(name, safe='')}/{'/'.join(parts)}" + (f"?{urlencode(query)}" if query else "")


def written(path: Path, foreseen: Sequence[Accident], tokens: Sequence[str]) -> Path:
    """Results that foresee the same at all samples."""
    with ResultsWriter(path, "accident", meta={"method": path.stem}) as writer:
        for token in tokens:
            writer.add(token, [*foreseen])
    return path


def bundle(da: DeepAccident, folder: Path, path: Path, setup: EvaluationSetup = BOXES, **how: Any) -> EvaluationRun:
    run = evaluate_results(da, path, setup, default_selection(setup, "train"), workers=1, allow_partial=True)
    run = run.broken_down(BREAKDOWNS, Resampling(resamples=20))
    save_run(run, folder, **how)
    return run


@pytest.fixture(scope="module")
def site(da_motion: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """Evaluations of accidents (with and without a copy, by another protocol, partial, with a hostile name), of motion
    and of boxes; and results alone."""
    folder, da = tmp_path_factory.mktemp("models"), da_motion
    tokens = default_selection(BOXES, "train").tokens(da)
    runs = {}
    run, _ = stored_run(da, BOXES, folder / "first.json")
    save_run(run, folder / "first", include_results=True)
    runs["first"] = run
    quiet = written(folder / "quiet.json", (), tokens)
    runs["second"] = bundle(da, folder / "second", quiet)
    runs["paper"] = bundle(da, folder / "paper", quiet, replace(BOXES, protocol="paper"))
    few = written(folder / "few.json", ELSEWHERE, tokens[::2])
    runs["part"] = bundle(da, folder / "part", few, include_results=True)
    shutil.copytree(folder / "second", folder / HOSTILE)
    summary = json.loads((folder / HOSTILE / "metrics_summary.json").read_text())
    summary["results"] |= {
        "meta": {"method": "<script>alert(1)</script>"},
        "path": "<b onclick=x>",
        "fingerprint": "5e",
    }
    summary["breakdowns"]["town"] = summary["breakdowns"]["agent"]
    summary["breakdowns"]["town"]["groups"][0]["value"] = '"><svg onload=alert(1)>'
    (folder / HOSTILE / "metrics_summary.json").write_text(json.dumps(summary))
    for task in ("motion", "detection", "warning"):
        setup = EvaluationSetup(task=task, protocol="clean" if task == "warning" else "released")
        runs[task], _ = stored_run(da, setup, folder / ("maps" if task == "motion" else f"{task}.json"))
        save_run(runs[task], folder / task, include_results=True)
    alone = written(folder / "alone.json", ELSEWHERE, tokens)
    bundles = [folder / name for name in (*runs, HOSTILE)]
    explorer = Explorer(da, bundles=bundles, results=[alone], workers=1)
    explorer.begin()
    yield Site(explorer, runs, folder)
    explorer.jobs.end()


def a_sample(site: Site, name: str = "first") -> str:
    return max(site.runs[name].evaluator.tokens)


# lists and bars


@pytest.mark.parametrize("name", ["first", "second", "part", "motion", "detection"])
@pytest.mark.parametrize("order", ["worst", "best"])
def test_the_worst_samples_come_first(site: Site, name: str, order: str) -> None:
    run = site.runs[name]
    shown = site.samples(of("model", name, "samples", order=order))
    assert sorted(shown) == sorted(run.evaluator.tokens)
    values = [main_number(run, token) for token in shown]
    known = [each for each in values if each is not None]
    assert values[len(known) :] == [None] * (len(values) - len(known))  # nothing to count: last
    assert all((one <= other) if order == "worst" else (one >= other) for one, other in pairwise(known))
    if name in ("first", "motion"):
        assert len(set(known)) > 1


def main_number(run: EvaluationRun, token: str) -> float | None:
    """A sample's number, as the evaluator computes it; 0 where something is false and nothing is to be found."""
    result = run.evaluator.compute([token])
    false = run.setup.task == "accident" and bool(result.within[15.0].fp)
    value: float = {
        "accident": lambda: result.apa,
        "motion": lambda: result.ranges["100x100"].pq,
        "detection": lambda: result.mean_average_precision,
    }[run.setup.task]()
    return value if not np.isnan(value) else 0.0 if false else None


@pytest.mark.parametrize("name", ["first", "motion", "detection", "warning"])
def test_each_bar_leads_to_the_samples_of_its_group(site: Site, name: str) -> None:
    run, address = site.runs[name], of("model", name)
    page = site.page(address)
    links = [each for each in hrefs(page) if each.startswith("samples?by=")]
    found = {}
    for link in links:
        query = parse_qs(urlsplit(link).query)
        found[query["by"][0], query["value"][0]] = site.samples(urljoin(address, link))
    expected = {
        (broken.by, value or "unknown"): sorted(tokens)
        for broken in run.breakdowns
        if broken.by != "all"
        for value, tokens in tokens_by_value(run.attributes, broken.by).items()
    }
    assert {group: sorted(tokens) for group, tokens in found.items()} == expected
    assert len(expected) > 5


def test_bars_are_as_long_as_their_numbers(site: Site) -> None:
    page = site.page("/model/first/")
    bars = re.findall(r'<rect class="value" width="([\d.]+)%"', page)
    shown = [
        group.result.apa
        for broken in site.runs["first"].breakdowns
        if broken.by != "all" and len(broken.groups) > 1
        for group in broken.groups
    ]
    assert [float(each) for each in bars] == [round(100 * each, 2) for each in shown if not np.isnan(each)]


def test_a_scenario_and_a_group_can_be_chosen_together(site: Site) -> None:
    run = site.runs["detection"]
    scenario = min(each.scenario for each in run.attributes.values())
    found = site.samples(of("model", "detection", "samples", by="agent", value="infrastructure", scenario=scenario))
    assert sorted(found) == sorted(
        token for token, each in run.attributes.items() if each.agent == "infrastructure" and each.scenario == scenario
    )
    assert not site.samples("/model/detection/samples?scenario=no/such")
    assert not site.samples("/model/detection/samples?by=agent&value=nobody")


def test_warnings_are_listed_in_time(site: Site) -> None:
    """Single samples of recordings have no numbers."""
    assert site.samples("/model/warning/samples") == sorted(site.runs["warning"].evaluator.tokens)
    assert "worst" not in site.page("/model/warning/samples")


def test_a_list_has_sixty_samples_a_page(site: Site) -> None:
    first = site.page("/model/warning/samples")
    count = len(site.runs["warning"].evaluator.tokens)
    assert len(hrefs(first, "entry")) == 60 < count
    assert len(hrefs(site.page("/model/warning/samples?page=2"), "entry")) == count - 60
    for page in ("-1", "0", "x", "99999999999"):
        assert hrefs(site.page(f"/model/warning/samples?page={page}"), "entry")


# verdicts


def test_accident_verdicts_are_those_of_the_evaluator(site: Site) -> None:
    seen = set()
    for name in ("first", "second", "part"):
        run, rows = site.runs[name], site.explorer.models[name].rows
        for token in run.evaluator.tokens:
            result = run.evaluator.compute([token])
            words = count_words(result.within[15.0])
            assert verdict("accident", rows[token]).split(",")[0] == words
            whole = ", ".join(f"{distance:g} m: {count_words(each)}" for distance, each in result.within.items())
            assert verdict("accident", rows[token], whole=True).startswith(whole)
            seen.add(words)
            if words == "TP":
                assert f"places {result.within[15.0].position_error:.1f} m off" in verdict("accident", rows[token])
    assert seen >= {"TP", "FN", "FP + FN"}
    token = a_sample(site)
    row = site.explorer.models["first"].rows[token]
    assert verdict("accident", row, whole=True) in html.unescape(
        site.page(of("model", "first", "sample", sample_path(token)))
    )


def test_other_verdicts_are_those_of_the_evaluator(site: Site) -> None:
    for token in site.runs["motion"].evaluator.tokens:
        widest = site.runs["motion"].evaluator.compute([token]).ranges["100x100"]
        counts = f"{widest.true_positive} TP, {widest.false_positive} FP, {widest.false_negative} FN"
        expected = f"100x100 m: PQ {widest.pq:.1f} %, IoU {widest.iou:.1f} %, {counts}"
        assert verdict("motion", site.explorer.models["motion"].rows[token]) == expected
    counted = site.runs["detection"].evaluator.counts
    for token, row in site.explorer.models["detection"].rows.items():
        start = f"{sum(counted[token]['truths'])} true boxes, {len(counted[token]['detections'][0])} detections, "
        assert verdict("detection", row).startswith(start)
    assert "involvement " in verdict("warning", site.explorer.models["warning"].rows[a_sample(site, "warning")])


@pytest.mark.parametrize("task", ["accident", "motion", "detection", "warning"])
def test_verdicts_of_a_strange_row_are_no_error(task: str) -> None:
    row = {"tp_5m": "<b>", "tp_..m": 1, "pq_1x1": "x", "pq_..x.": None, "iou_1x1": True, "truths": 1e400, "tp_.": [1]}
    for whole in (False, True):
        assert isinstance(verdict(task, row, whole=whole), str)
        assert verdict(task, {}, whole=whole) is not None


# a sample


@pytest.mark.parametrize("name", ["first", "motion", "detection", "warning", "alone"])
def test_a_sample_shows_the_prediction_from_above_and_in_cameras(site: Site, name: str) -> None:
    token = min(site.explorer.models[name].tokens)
    address = of("model", name, "sample", sample_path(token))
    pictures = re.findall(r'<img src="([^"]+)"', site.page(address))
    assert len(pictures) == 2
    for each in pictures:
        answer = site.get(urljoin(address, html.unescape(each)))
        assert answer.status == 200, answer.text
        assert answer.body.startswith(b"\x89PNG")
        assert answer.headers["content-type"] == "image/png"


def test_motion_is_shown_frame_by_frame(site: Site) -> None:
    token = min(site.runs["motion"].evaluator.tokens)
    address = of("model", "motion", "sample", sample_path(token))
    ahead = [each for each in hrefs(site.page(address)) if each.endswith("#ahead")]
    assert len(ahead) == 5  # from now to 2 s
    shown = {site.get(f"{address}/cameras.png?ahead={number}").body for number in (0, 4)}
    assert len(shown) == 2
    for wrong in ("5", "-1", "x", "999"):
        assert site.get(f"{address}/cameras.png?ahead={wrong}").status == 404
    late = max(site.runs["motion"].evaluator.tokens)
    page = site.page(of("model", "motion", "sample", sample_path(late)))
    assert len([each for each in hrefs(page) if each.endswith("#ahead")]) < 5  # the recording ends


def test_a_sample_leads_to_the_ones_before_and_after(site: Site) -> None:
    """In time those of the same agent, in the list those of the group."""
    run, choices = site.runs["first"], {"by": "time_to_impact", "value": "1 s"}
    group = site.samples(of("model", "first", "samples", **choices))
    address = of("model", "first", "sample", sample_path(group[1]), **choices)
    page = site.page(address)
    same = sorted(each for each in run.evaluator.tokens if each.rsplit("/", 1)[0] == group[1].rsplit("/", 1)[0])
    at = same.index(group[1])
    expected = same[at - 1 : at] + same[at + 1 : at + 2]
    links = [*hrefs(page, rel="prev"), *hrefs(page, rel="next")]
    assert [sample_of(urljoin(address, each)) for each in links] == expected
    neighbours = [re.findall(f'<a id="{name}" href="([^"]+)"', page)[0] for name in ("worse", "better")]
    assert [sample_of(urljoin(address, each)) for each in neighbours] == [group[0], group[2]]
    assert f"2 of {len(group)}" in page
    scenario, agent, frame = group[1].rsplit("/", 2)
    here = [urljoin(address, each) for each in hrefs(page)]
    assert f"/scenario/{scenario}/?frame={int(frame)}&model=first" in here
    assert f"/scenario/{scenario}/moment/{agent}/{int(frame)}" in here


def test_a_sample_that_is_not_evaluated_is_a_sentence(site: Site) -> None:
    missed = max(site.runs["first"].evaluator.tokens - site.runs["part"].evaluator.tokens)
    address = of("model", "part", "sample", sample_path(missed))
    page = site.page(address)
    assert "predicts nothing for this sample" in page
    assert "is not in the evaluation" in page
    assert "<img" not in page
    assert site.get(f"{address}/above.png").status == 404


# results that are not given, and what is not opened


class _Opened:
    """The paths that are opened while `on`; a hook that Python cannot take away again."""

    def __init__(self) -> None:
        self.on, self.paths = False, list[str]()
        sys.addaudithook(self._hook)

    def _hook(self, event: str, arguments: tuple[Any, ...]) -> None:
        if self.on and event == "open":
            self.paths.append(str(arguments[0]))


def test_the_results_that_a_bundle_names_are_not_opened(site: Site, da_motion: DeepAccident) -> None:
    """They are there, and the release has all samples; yet a bundle may come from anywhere."""
    named = site.explorer.models["second"].bundle
    assert named is not None
    path = named.summary["results"]["path"]
    assert Path(path).is_file()
    seen = _Opened()
    seen.on = True
    explorer = Explorer(da_motion, bundles=[site.folder / "second"], workers=1)
    other = Site(explorer, {}, site.folder)
    token = a_sample(site, "second")
    address = of("model", "second", "sample", sample_path(token))
    page = other.page(address)
    assert other.get(f"{address}/above.png").status == 404
    other.page("/model/second/")
    other.page("/model/second/samples")
    seen.on = False
    explorer.jobs.end()
    assert any(each.endswith("samples.parquet") for each in seen.paths)
    assert path not in seen.paths
    assert not any(Path(each).name == Path(path).name for each in seen.paths)
    assert "--results PATH" in page
    assert html.escape(path) in page
    assert "<img" not in page
    assert "--results PATH" in other.page("/model/second/")


def test_given_results_join_their_bundle(site: Site, da_motion: DeepAccident) -> None:
    explorer = Explorer(da_motion, bundles=[site.folder / "second"], results=[site.folder / "quiet.json"], workers=1)
    other = Site(explorer, {}, site.folder)
    page = other.page(of("model", "second", "sample", sample_path(a_sample(site, "second"))))
    explorer.jobs.end()
    assert [*explorer.models] == ["second"]
    assert "<img" in page


# the command


def test_results_without_an_evaluation_show_how_to_make_one(site: Site, da_motion: DeepAccident) -> None:
    shown = re.findall(r'<pre class="wide" id="command">(.*?)</pre>', site.page("/model/alone/"))
    words = ["deepaccident", "evaluate", "accident", str(da_motion.dataroot), "--version", "v1"]
    words += ["--results", str(site.folder / "alone.json"), "--protocol", "boxes", "--out", "alone_bundle"]
    assert shlex.split(html.unescape(shown[0])) == words


def test_results_of_other_scenarios_are_told(da_motion: DeepAccident, tmp_path: Path) -> None:
    path = written(tmp_path / "few.json", (), ["type9/none/ego_vehicle/001"])
    page = Site(Explorer(da_motion, results=[path], workers=1), {}, tmp_path).page("/model/few/")
    assert "1 scenario of these results is not in this release" in page


# names and addresses of strangers


def test_names_are_escaped_and_lead_to_their_pages(site: Site) -> None:
    pages = [site.page("/models/")]
    link = next(each for each in hrefs(pages[0], "entry") if "onerror" in each)
    address = urljoin("/models/", link)
    pages += [site.page(address), site.page(urljoin(address, "samples"))]
    assert "All 20 samples" in pages[1]
    sample = urljoin(urljoin(address, "samples"), hrefs(pages[2], "entry")[0])
    pages += [site.page(sample), site.page(of("compare", "first", HOSTILE_PART, ""))]
    for page in pages:
        assert "<img src=x" not in page
        assert "<script>alert" not in page
        assert "<svg onload" not in page
        assert "<b onclick" not in page
    assert html.escape("<b onclick=x>") in pages[1]
    bars = [each for each in hrefs(pages[1]) if "onload" in each]
    assert urljoin(address, bars[0]).startswith(address)


HOSTILE_PART = "%3Cimg%20src%3Dx%20onerror%3Dalert%281%29%3E%20%22a%22%20%26%20%27b%27%20..%252e%252e%3F%23%3B"


def test_a_folders_address_gets_its_slash(site: Site) -> None:
    answer = site.get("/model/first?a=b")
    assert answer.status == 307
    assert urljoin("/model/first", answer.headers["location"]) == "/model/first/?a=b"
    hostile = site.get(f"/model/{HOSTILE_PART}")
    assert urljoin("/model/x", hostile.headers["location"]) == f"/model/{HOSTILE_PART}/"
    assert site.get("/models").headers["location"] == "./models/"


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
    assert answer.status == 404
    assert "<script>" not in answer.text


@pytest.mark.parametrize(
    "address", ["/models/", "/model/first/", "/model/alone/", "/model/first/samples", "/compare/first/second/"]
)
def test_pages_keep_to_the_policy(site: Site, address: str) -> None:
    """No style and script in the page, and only relative addresses."""
    page = site.page(address)
    assert " style=" not in page
    assert "<style" not in page
    assert not re.search(r"<script(?![^>]* src=)", page)
    assert not re.search(r"""(?:href|src|action)=["'](?:/|https?:)""", page)


def test_a_damaged_summary_is_a_sentence(site: Site, da_motion: DeepAccident, tmp_path: Path) -> None:
    shutil.copytree(site.folder / "second", tmp_path / "broken")
    path = tmp_path / "broken" / "metrics_summary.json"
    summary = json.loads(path.read_text())
    summary["headlines"][0]["name"] = {"a": 1}
    path.write_text(json.dumps(summary))
    other = Site(Explorer(da_motion, bundles=[tmp_path / "broken"], workers=1), {}, tmp_path)
    answer = other.get("/model/broken/")
    other.explorer.jobs.end()
    assert answer.status == 500
    assert "evaluate again" in answer.text


# marks and warnings


def test_what_is_partial_says_so(site: Site) -> None:
    run = site.runs["part"]
    assert run.partial is not None
    assert PARTIAL.text().startswith("PARTIAL")
    for address in ("/models/", "/model/part/", "/compare/part/part/"):
        assert run.partial.text() in site.page(address)
    assert "PARTIAL" not in site.page("/model/first/")


def test_another_release_lacks_the_samples(site: Site, da: DeepAccident) -> None:
    explorer = Explorer(da, bundles=[site.folder / "first"], workers=1)
    other = Site(explorer, {}, site.folder)
    page = other.page("/model/first/")
    assert "1 scenario of this evaluation is not in this release" in page
    assert sorted(other.samples("/model/first/samples")) == sorted(site.runs["first"].evaluator.tokens)
    group = other.page("/model/first/samples?by=agent&value=ego_vehicle")
    assert "20 samples are not in this release" in group
    sample = other.page(of("model", "first", "sample", sample_path(a_sample(site))))
    explorer.jobs.end()
    assert "This sample is not in this release." in sample
    assert "5 m: " in sample


def test_without_models_the_page_says_how_to_give_some(da_motion: DeepAccident) -> None:
    explorer = Explorer(da_motion, workers=1)
    page = Site(explorer, {}, Path()).page("/models/")
    assert "--results PATH" in page
    assert "deepaccident evaluate" in page


def test_pages_wait_for_scores(site: Site, da_motion: DeepAccident, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Jobs, "_run", lambda _: None)
    explorer = Explorer(da_motion, bundles=[site.folder / "first", site.folder / "second"], workers=1)
    other = Site(explorer, {}, site.folder)
    for address in ("/model/first/", "/model/first/samples", "/compare/first/second/"):
        answer = other.get(address)
        assert answer.status == 200
        titles = json.loads(html.unescape(re.findall("data-titles='([^']*)'", answer.text)[0]))
        assert set(titles) <= set(json.loads(other.get("/waiting.json").text))
        assert titles


# side by side


def test_a_comparison_has_the_largest_differences_first(site: Site) -> None:
    a, b = (site.runs[name] for name in ("first", "second"))
    shown = site.samples("/compare/first/second/")
    assert sorted(shown) == sorted(a.evaluator.tokens)

    def difference(token: str) -> float:
        one, other = (main_number(run, token) for run in (a, b))
        return (1.0 if other is None else other) - (1.0 if one is None else one)

    sizes = [abs(difference(token)) for token in shown]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[0] > sizes[-1]
    better = site.samples("/compare/first/second/?better=a")
    assert sorted(better) == sorted(token for token in shown if difference(token) < 0)
    assert site.samples("/compare/second/first/?better=b") == better
    page = site.page("/compare/first/second/")
    assert ">apa</th>" in page
    assert "b − a" in page


def test_quiet_where_nothing_comes_is_better_than_a_false_alarm(da_motion: DeepAccident, tmp_path: Path) -> None:
    setup = replace(BOXES, switches={"reading.danger_distance": 0.5})
    selection = default_selection(setup, "train", scope="all")
    tokens = selection.tokens(da_motion)
    for name, foreseen in (("quiet", ()), ("loud", ELSEWHERE)):
        path = written(tmp_path / f"{name}.json", foreseen, tokens)
        save_run(evaluate_results(da_motion, path, setup, selection, workers=1), tmp_path / name)
    site = Site(Explorer(da_motion, bundles=[tmp_path / "quiet", tmp_path / "loud"], workers=1), {}, tmp_path)
    better = site.samples("/compare/quiet/loud/?better=a")
    site.explorer.jobs.end()
    assert sorted(better) == sorted(token for token in tokens if "_normal/" in token)


def test_what_cannot_be_compared_says_why(site: Site) -> None:
    page = html.unescape(site.page("/compare/second/paper/"))
    assert "cannot be compared" in page
    assert "not evaluated by the same rules" in page
    assert site.samples("/compare/second/paper/")  # the samples can be, by their own numbers
    assert "not evaluated by the same rules" in html.unescape(site.page("/compare/first/motion/"))


def test_samples_that_only_one_has_can_be_left_out(site: Site) -> None:
    page = site.page("/compare/second/part/")
    assert "samples only in" in page
    (link,) = (each for each in hrefs(page) if "common=1" in each)
    page = site.page(urljoin("/compare/second/part/", link))
    assert "cannot be compared" not in page
    assert "10 that only one has are left out" in page


def test_two_models_at_the_same_moment(site: Site) -> None:
    token = site.samples("/compare/first/second/?better=a")[0]
    address = of("compare", "first", "second", "sample", sample_path(token), better="a")
    page = site.page(address)
    assert len(re.findall("<section", page)) == 2
    for name in ("first", "second"):
        assert verdict("accident", site.explorer.models[name].rows[token], whole=True) in html.unescape(page)
    pictures = [urljoin(address, html.unescape(each)) for each in re.findall(r'<img src="([^"]+)"', page)]
    assert [urlsplit(each).path.rsplit("/", 1)[1] for each in pictures] == [
        "above.png",
        "cameras.png",
    ]  # second has none
    assert "--results PATH" in page
    assert all(site.get(each).status == 200 for each in pictures)
    swapped = [urljoin(address, each) for each in hrefs(page) if "/second/first/" in each]
    assert swapped == [of("compare", "second", "first", "sample", sample_path(token), better="b")]
    assert "1 of " in page
    assert site.page(swapped[0])
    assert any("better=a" in each for each in hrefs(page, rel="next") + hrefs(page, rel="prev"))
