"""`python -m tests.campaign`: all cases and all stops; prints what fails and writes docs/reliability.md."""

import sys
import tempfile
from pathlib import Path

import click

_TOP = Path(__file__).parents[2]
sys.path.insert(0, str(_TOP / "tests"))  # the tests' packages are found by their own names


@click.command()
@click.option("--count", default=3000, show_default=True, help="How many changed files, of kinds that share a seed.")
@click.option("--each", default=60, show_default=True, help="How many of each kind that has a seed of its own.")
@click.option("--kills", default=100, show_default=True, help="How many killed processes; 0: no full disks either.")
@click.option("--seed", default=0, show_default=True)
@click.option(
    "--out", type=click.Path(path_type=Path), default=_TOP / "docs" / "reliability.md", help="The page to write."
)
def main(count: int, each: int, kills: int, seed: int, out: Path) -> None:
    """Change files, kill processes and fill disks; exit status 1 if anything failed."""
    from campaign.healthy import TORCH, make_healthy
    from campaign.page import page
    from campaign.pool import drawn, drawn_apart, run
    from campaign.stops import Stopped, drawn_stops, run_stops
    from campaign.worker import Outcome

    def tell(told: Outcome | Stopped) -> None:
        bar.update(1)
        if told.failed:
            click.echo(f"\r{told}")

    if not TORCH:
        click.echo("PyTorch is not installed: no weights are changed; the page is of a run that changes them")

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        healthy = make_healthy(folder / "healthy")
        cases = [*drawn(count, seed), *drawn_apart(each, seed)]
        with click.progressbar(length=len(cases), label="changed files") as bar:
            outcomes = run(cases, healthy, tell=tell)
        stops = drawn_stops(kills, seed) if kills else []
        with click.progressbar(length=len(stops), label="kills and full disks") as bar:
            stopped = run_stops(stops, healthy, folder / "out", tell)
    failed = sum(told.failed for told in (*outcomes, *stopped))
    command = f"--count {count} --each {each} --kills {kills} --seed {seed}"
    out.write_text(page(outcomes, stopped, f"`{command}`"), encoding="utf-8")
    click.echo(f"{failed} failed; written: {out}")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
