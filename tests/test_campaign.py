"""Some cases of each kind in a test run; every way to fail is noticed; kills, full disks, the page
of the last run.
"""

import re
from pathlib import Path

import pytest
from campaign import planted
from campaign.healthy import make_healthy
from campaign.kinds import KINDS
from campaign.pool import drawn, run
from campaign.stops import VERBS, Stop, run_stops
from campaign.worker import Case

from deepaccident_devkit.support.reading import BYTE_LIMITS

TOP = Path(__file__).parents[1]
PAGE = TOP / "docs" / "validation.md"
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
    verdicts = [outcome.verdict for outcome in outcomes]
    assert [outcome for outcome in outcomes if outcome.failed] == []
    assert (len(verdicts), {*verdicts[: len(HERE)]}) == ((CASES + 1) * len(HERE), {"read"})
    assert {*verdicts[len(HERE) :]} == {"read", "refused"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kinds", "how"),
    [
        ([kind for kind in planted.KINDS if kind != "hang"], {}),
        (
            ["hang"],
            {"seconds": 1.0, "workers": 1},
        ),  # of work: only what never ends has more on any machine
    ],
)
def test_every_way_to_fail_is_noticed(
    healthy: Path, kinds: list[str], how: dict[str, float]
) -> None:
    """Bad readers, by turns with good ones: what fails does not touch the next case."""
    cases = [
        case for kind in kinds for case in (Case(kind, "emptied", 0), Case("read", "emptied", 0))
    ]
    verdicts = [outcome.verdict for outcome in run(cases, healthy, kinds="campaign.planted", **how)]
    assert verdicts == [verdict for kind in kinds for verdict in (kind.split(",")[0], "read")]


@pytest.mark.slow
def test_verbs_are_killed_and_meet_a_full_disk(healthy: Path, tmp_path: Path) -> None:
    """A third of them; the campaign itself stops all."""
    stops = [Stop(verb.name, kind, 0.6) for verb in VERBS[::3] for kind in ("kill", "full disk")]
    assert [stopped for stopped in run_stops(stops, healthy, tmp_path) if stopped.failed] == []


def test_the_limits_of_the_security_page_are_those_of_the_code() -> None:
    text = (TOP / "SECURITY.md").read_text(encoding="utf-8")
    stated = {
        kind: int(size) << 20
        for kind, size in re.findall(r"^\| `(\w+)` \|[^|]*\| (\d+) MiB \|$", text, re.MULTILINE)
    }
    assert stated == BYTE_LIMITS
