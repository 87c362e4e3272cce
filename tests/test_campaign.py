"""A small campaign of damaged files, killed commands and full disks; each failure is noticed."""

import re
from pathlib import Path

import pytest
from campaign import planted
from campaign.healthy import make_healthy
from campaign.kinds import KINDS
from campaign.pool import draw_cases, run
from campaign.stops import VERBS, Stop, run_stops
from campaign.worker import Case

from deepaccident_devkit.support.reading import BYTE_LIMITS

TOP = Path(__file__).parents[1]
PAGE = TOP / "docs" / "validation.md"
CASES_PER_KIND = 12
"""Two for each group of mutations."""
SEED = 1
"""The page has another seed: the test run tries other cases."""
READABLE_KINDS = [name for name, kind in KINDS.items() if kind.can_be_read]


@pytest.fixture(scope="session")
def healthy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a healthy file of each kind."""
    return make_healthy(tmp_path_factory.mktemp("campaign") / "healthy")


@pytest.mark.slow
def test_changed_files_are_read_or_refused(healthy: Path) -> None:
    """Healthy files are read. Kinds that need PyTorch are tried if it is installed."""
    num_kinds = len(READABLE_KINDS)
    healthy_cases = [Case(kind, None, 0) for kind in READABLE_KINDS]

    outcomes = run([*healthy_cases, *draw_cases(CASES_PER_KIND, SEED)], healthy)

    verdicts = [outcome.verdict for outcome in outcomes]
    assert [outcome for outcome in outcomes if outcome.failed] == []
    assert len(verdicts) == (CASES_PER_KIND + 1) * num_kinds
    assert {*verdicts[:num_kinds]} == {"read"}
    assert {*verdicts[num_kinds:]} == {"read", "refused"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kinds", "limits"),
    [
        ([kind for kind in planted.KINDS if kind != "hang"], {}),
        # on any machine, only a reader that never ends works for more than a second
        (["hang"], {"seconds": 1.0, "workers": 1}),
    ],
)
def test_every_way_to_fail_is_noticed(
    healthy: Path, kinds: list[str], limits: dict[str, float]
) -> None:
    """Good readers follow bad ones: a failure does not affect the next case."""
    cases, expected = [], []
    for kind in kinds:
        cases += [Case(kind, "emptied", 0), Case("read", "emptied", 0)]
        expected += [kind.split(",")[0], "read"]

    outcomes = run(cases, healthy, kinds="campaign.planted", **limits)

    assert [outcome.verdict for outcome in outcomes] == expected


@pytest.mark.slow
def test_verbs_are_killed_and_meet_a_full_disk(healthy: Path, tmp_path: Path) -> None:
    """A third of the verbs is enough here; the campaign itself stops all."""
    stops = [Stop(verb.name, kind, 0.6) for verb in VERBS[::3] for kind in ("kill", "full disk")]
    outcomes = run_stops(stops, healthy, tmp_path)
    assert [outcome for outcome in outcomes if outcome.failed] == []


def test_the_security_page_states_the_limits_of_the_code() -> None:
    text = (TOP / "SECURITY.md").read_text(encoding="utf-8")
    items = re.findall(r"^- `(\w+)`, (\d+) MiB: ", text, re.MULTILINE)
    assert {kind: int(size) << 20 for kind, size in items} == BYTE_LIMITS
