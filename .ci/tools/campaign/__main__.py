"""`PYTHONPATH=.ci/tools python -m campaign`: all cases and stops; its numbers go into
docs/validation.md.
"""

import sys
import tempfile
from pathlib import Path

import click

EACH = 100
_TOP = Path(__file__).parents[3]
sys.path.insert(0, str(_TOP / "tests"))  # for what it shares with the tests


@click.command()
@click.option(
    "--count", default=EACH, show_default=True, help="How many changed files of each kind."
)
@click.option("--kinds", metavar="NAME[,NAME…]", help="Only these kinds of files; the page stays.")
@click.option(
    "--kills",
    default=100,
    show_default=True,
    help="How many killed processes; 0: no full disks either.",
)
@click.option("--seed", default=0, show_default=True)
def main(count: int, kinds: str | None, kills: int, seed: int) -> None:
    """Change files, kill processes and fill disks; exit status 1 if anything failed.

    With --kinds nothing is killed, and the page stays.
    """
    from campaign.healthy import make_healthy
    from campaign.kinds import KINDS
    from campaign.page import put, summary, tables
    from campaign.pool import drawn, left_out, run
    from campaign.stops import Stopped, drawn_stops, run_stops
    from campaign.worker import Outcome

    def tell(each: Outcome | Stopped) -> None:
        bar.update(1)
        if each.failed:
            click.echo(f"\r{each}")

    chosen = [each.strip() for each in kinds.split(",")] if kinds else list(KINDS)
    if unknown := set(chosen) - KINDS.keys():
        raise click.BadParameter(f"{min(unknown)}: no such kind; there are {', '.join(KINDS)}")
    cases = drawn(count, seed, chosen)
    for each, package in left_out(chosen).items():
        click.echo(f"left out: {each}, as {package} is not installed")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        healthy = make_healthy(folder / "healthy")
        with click.progressbar(length=len(cases), label="changed files") as bar:
            outcomes = run(cases, healthy, tell=tell)
        stops = drawn_stops(kills, seed) if kills and not kinds else []
        with click.progressbar(length=len(stops), label="kills and full disks") as bar:
            stopped = run_stops(stops, healthy, folder / "out", tell)
    failed = sum(each.failed for each in (*outcomes, *stopped))
    click.echo(tables(outcomes, stopped))
    if not kinds:
        put(summary(outcomes, stopped, f"--count {count} --kills {kills} --seed {seed}"))
    click.echo(f"{failed} failed")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
