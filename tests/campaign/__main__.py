"""`python -m tests.campaign`: all cases and all stops; prints what fails and writes docs/reliability.md."""

import sys
import tempfile
from pathlib import Path

import click

_TOP = Path(__file__).parents[2]
sys.path.insert(0, str(_TOP / "tests"))  # the tests' packages are found by their own names


@click.command()
@click.option("--count", default=3000, show_default=True, help="How many changed files.")
@click.option("--kills", default=100, show_default=True, help="How many killed processes; 0: no full disks either.")
@click.option("--seed", default=0, show_default=True)
@click.option(
    "--out", type=click.Path(path_type=Path), default=_TOP / "docs" / "reliability.md", help="The page to write."
)
def main(count: int, kills: int, seed: int, out: Path) -> None:
    """Change files, kill processes and fill disks; exit status 1 if anything failed."""
    from campaign.healthy import make_healthy
    from campaign.page import page
    from campaign.pool import drawn, run
    from campaign.stops import Stopped, drawn_stops, run_stops
    from campaign.worker import Outcome

    def tell(each: Outcome | Stopped) -> None:
        bar.update(1)
        if each.failed:
            click.echo(f"\r{each}")

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        healthy = make_healthy(folder / "healthy")
        with click.progressbar(length=count, label="changed files") as bar:
            outcomes = run(drawn(count, seed), healthy, tell=tell)
        stops = drawn_stops(kills, seed) if kills else []
        with click.progressbar(length=len(stops), label="kills and full disks") as bar:
            stopped = run_stops(stops, healthy, folder / "out", tell)
    failed = sum(each.failed for each in (*outcomes, *stopped))
    command = f"--count {count} --kills {kills} --seed {seed}"
    out.write_text(page(outcomes, stopped, f"`{command}`"), encoding="utf-8")
    click.echo(f"{failed} failed; written: {out}")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
