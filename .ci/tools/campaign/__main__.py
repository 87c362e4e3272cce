"""Run all cases and stops, and write the numbers into docs/validation.md.

`PYTHONPATH=.ci/tools python -m campaign`
"""

import sys
import tempfile
from pathlib import Path

import click

CASES_OF_A_KIND = 100
_TOP = Path(__file__).parents[3]
sys.path.insert(0, str(_TOP / "tests"))  # the campaign uses modules of the tests


@click.command()
@click.option(
    "--count", default=CASES_OF_A_KIND, show_default=True, help="Number of changed files a kind."
)
@click.option("--kinds", metavar="NAME[,NAME…]", help="Run only these kinds; the page stays.")
@click.option(
    "--kills",
    default=100,
    show_default=True,
    help="Number of killed processes; 0 leaves out full disks too.",
)
@click.option("--seed", default=0, show_default=True)
def main(count: int, kinds: str | None, kills: int, seed: int) -> None:
    """Change files, kill processes and fill disks; exit with status 1 if anything failed.

    With --kinds nothing is killed, and the page stays.
    """
    from campaign.healthy import make_healthy
    from campaign.kinds import KINDS
    from campaign.page import format_tables, summarize, write_summary
    from campaign.pool import draw_cases, find_missing_packages, run
    from campaign.stops import StopOutcome, draw_stops, run_stops
    from campaign.worker import Outcome

    def report(outcome: Outcome | StopOutcome) -> None:
        bar.update(1)
        if outcome.failed:
            click.echo(f"\r{outcome}")

    names = [name.strip() for name in kinds.split(",")] if kinds else list(KINDS)
    if unknown_names := set(names) - KINDS.keys():
        raise click.BadParameter(f"{min(unknown_names)}: no such kind; known: {', '.join(KINDS)}")
    cases = draw_cases(count, seed, names)
    for name, package in find_missing_packages(names).items():
        click.echo(f"left out: {name}, as {package} is not installed")
    with tempfile.TemporaryDirectory() as temporary_folder:
        folder = Path(temporary_folder)
        healthy = make_healthy(folder / "healthy")
        with click.progressbar(length=len(cases), label="changed files") as bar:
            outcomes = run(cases, healthy, report=report)
        stops = draw_stops(kills, seed) if kills and not kinds else []
        with click.progressbar(length=len(stops), label="kills and full disks") as bar:
            stop_outcomes = run_stops(stops, healthy, folder / "out", report)
    failure_count = sum(outcome.failed for outcome in (*outcomes, *stop_outcomes))
    click.echo(format_tables(outcomes, stop_outcomes))
    if not kinds:
        command = f"--count {count} --kills {kills} --seed {seed}"
        write_summary(summarize(outcomes, stop_outcomes, command))
    click.echo(f"{failure_count} failed")
    sys.exit(1 if failure_count else 0)


if __name__ == "__main__":
    main()
