"""Some cases of each kind in a test run; every way to fail is noticed; kills, full disks, the page of the last run."""

import re
from collections import Counter
from pathlib import Path

import pytest

from campaign import planted
from campaign.__main__ import EACH
from campaign.healthy import make_healthy
from campaign.kinds import KINDS
from campaign.mutations import FORMS, GROUPS, MUTATIONS, fitting
from campaign.page import numbers, page
from campaign.pool import drawn, left_out, run
from campaign.stops import VERBS, Stop, drawn_stops, files_in, run_stops
from campaign.worker import Bench, Case, Outcome
from deepaccident_devkit.reading import LIMITS

TOP = Path(__file__).parents[2]
PAGE = TOP / "docs" / "reliability.md"
CASES = 12
"""Of each kind: of each group of mutations two."""
SEED = 1
"""Not that of the page, so that the test run has cases of its own."""
HERE = [name for name, kind in KINDS.items() if kind.can_be_read]


@pytest.fixture(scope="session")
def healthy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One of each kind of file."""
    return make_healthy(tmp_path_factory.mktemp("campaign") / "healthy")


@pytest.mark.slow
def test_changed_files_are_read_or_refused(healthy: Path) -> None:
    """And healthy ones are read. Kinds that need PyTorch are tried where it is installed."""
    unchanged = [Case(kind, None, 0) for kind in HERE]
    outcomes = run([*unchanged, *drawn(CASES, SEED)], healthy)
    changed = outcomes[len(unchanged) :]
    assert [outcome for outcome in outcomes[: len(unchanged)] if outcome.verdict != "read"] == []
    assert [outcome for outcome in changed if outcome.failed] == []
    assert len(changed) == CASES * len(HERE)
    assert {outcome.verdict for outcome in changed} == {"read", "refused"}


def test_every_way_to_fail_is_noticed(healthy: Path) -> None:
    """Bad readers, by turns with good ones: what fails does not touch the next case."""
    cases = [case for kind in planted.KINDS for case in (Case(kind, "emptied", 0), Case("read", "emptied", 0))]
    outcomes = run(cases, healthy, seconds=6.0, kinds="campaign.planted")
    assert [outcome.verdict for outcome in outcomes[::2]] == [kind.split(",")[0] for kind in planted.KINDS]
    assert {outcome.verdict for outcome in outcomes[1::2]} == {"read"}


def test_a_case_depends_on_its_seed_alone(healthy: Path, tmp_path: Path) -> None:
    bench = Bench(healthy, tmp_path / "home", KINDS)
    before = files_in(healthy)

    def changed(case: Case) -> dict[str, bytes]:
        return files_in(bench.room(case).tree)

    for name in ("bits_flipped", "number_replaced", "word_with_an_odd_name"):
        first, other = Case("label", name, 3), Case("label", name, 4)
        assert changed(first) == changed(first) != changed(other)
    assert files_in(healthy) == before


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Duplicate name")  # it is what one of them makes
def test_every_mutation_can_change_every_form(healthy: Path, tmp_path: Path) -> None:
    bench = Bench(healthy, tmp_path / "home", KINDS)
    one_of = {kind.form: kind.name for kind in KINDS.values()}
    assert set(one_of) == set(FORMS)
    here = {kind.form: kind.name for kind in KINDS.values() if kind.can_be_read}
    for form, kind in here.items():
        for group in GROUPS:
            for name in fitting(form, group):
                room = bench.room(Case(kind, name, 0))
                assert room.tree.exists() or room.tree.is_symlink()


def test_cases_are_of_every_kind_and_group() -> None:
    cases = drawn(CASES, SEED)
    assert Counter(case.kind for case in cases) == dict.fromkeys(HERE, CASES)
    assert {MUTATIONS[case.mutation or ""].group for case in cases} == set(GROUPS)
    assert cases == drawn(CASES, SEED) != drawn(CASES, SEED + 1)


def test_a_kind_has_a_seed_of_its_own() -> None:
    cases = drawn(CASES, SEED)
    for kind in HERE:
        assert drawn(CASES, SEED, [kind]) == [case for case in cases if case.kind == kind]
    assert left_out().keys() == KINDS.keys() - set(HERE)


@pytest.mark.slow
def test_every_verb_is_killed_and_meets_a_full_disk(healthy: Path, tmp_path: Path) -> None:
    stops = [Stop(verb.name, kind, 0.6) for verb in VERBS for kind in ("kill", "full disk")]
    assert [stopped for stopped in run_stops(stops, healthy, tmp_path) if stopped.failed] == []


def test_kills_are_of_every_verb() -> None:
    stops = drawn_stops(100, SEED)
    for kind in ("kill", "full disk"):
        assert {stop.verb for stop in stops if stop.kind == kind} == {verb.name for verb in VERBS}
    assert sum(stop.kind == "kill" for stop in stops) == 100


def test_the_page_is_of_a_whole_run_without_a_failure() -> None:
    """`python -m tests.campaign` brings it up to date."""
    text = PAGE.read_text(encoding="utf-8")
    rows = numbers(text)
    assert set(rows) >= {*KINDS, *(f"`{verb.name}`" for verb in VERBS), "all"}
    for row in (rows[name] for name in KINDS):
        cells = [cell for cell in row[:-1] if cell]
        assert row[-1] == [sum(column) for column in zip(*cells, strict=True)]
        assert row[-1][2] == 0
        assert sum(row[-1]) == EACH
    total = re.search(r"^([\d,]+) times, one file", text, re.MULTILINE)
    assert total
    assert int(total[1].replace(",", "")) == EACH * len(KINDS)
    assert "Left out" not in text
    assert f"`--count {EACH} --kills 100 --seed 0`" in text
    assert [sum(rows[f"`{verb.name}`"][column][0] for verb in VERBS) for column in range(5)] == [
        100,
        4 * len(VERBS),
        0,
        0,
        0,
    ]


def test_a_page_counts_what_failed() -> None:
    outcomes = [Outcome(Case("label", "emptied", 0), verdict) for verdict in ("read", "wrong", "hang", "refused")]
    text = page(outcomes, [], "nothing")
    assert "2 failed" in text
    assert numbers(text)["label"][0] == numbers(text)["label"][-1] == [1, 1, 2]


def test_the_limits_of_the_security_page_are_those_of_the_code() -> None:
    text = (TOP / "SECURITY.md").read_text(encoding="utf-8")
    stated = {
        kind: int(size) << 20 for kind, size in re.findall(r"^\| `(\w+)` \|[^|]*\| (\d+) MiB \|$", text, re.MULTILINE)
    }
    assert stated == LIMITS
