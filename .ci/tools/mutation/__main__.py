"""`PYTHONPATH=.ci/tools:tests python -m mutation`: count planted faults that the tests notice."""

import json
from collections import Counter
from pathlib import Path

import click

from mutation.campaign import Campaign
from mutation.mutants import Mutant
from mutation.sample import AREAS, drawn

_REASONS_FILE = Path(__file__).parent / "survivors.txt"
_KILLED_OUTCOMES = ("killed", "timed out")
_SURVIVING_OUTCOMES = ("survived", "not reached")
_COLUMN_WIDTHS = {
    "killed": 8,
    "timed out": 11,
    "survived": 10,
    "not reached": 13,
    "not planted": 13,
    "to run": 8,
}


@click.command()
@click.option("--count", default=1500, help="Number of mutants that each seed draws.")
@click.option(
    "--seed",
    "seeds",
    multiple=True,
    type=int,
    default=[17],
    help="Seed of the drawing; the mutants of several seeds are pooled.",
)
@click.option(
    "--only",
    multiple=True,
    metavar="PATH",
    help="Run only mutants of files whose paths begin with PATH, such as motion/warping.",
)
@click.option("--again", is_flag=True, help="Run the survivors once more.")
@click.option(
    "--results",
    type=click.Path(path_type=Path),
    default="build/mutants.jsonl",
    help="File of outcomes, to which new ones are appended.",
)
@click.option("--table", is_flag=True, help="Print the table without running anything.")
def main(
    count: int,
    seeds: tuple[int, ...],
    only: tuple[str, ...],
    again: bool,
    results: Path,
    table: bool,
) -> None:
    """Run the mutants that RESULTS lacks; print the counts of each area and the survivors."""
    pooled_mutants = {mutant.key: mutant for seed in seeds for mutant in drawn(count, seed)}
    mutants = [m for m in pooled_mutants.values() if m.path.startswith(only or ("",))]
    outcomes = _outcomes(results)
    repeated_outcomes = (None, *_SURVIVING_OUTCOMES) if again else (None,)
    pending = [mutant for mutant in mutants if outcomes.get(mutant.key) in repeated_outcomes]
    if pending and not table:
        results.parent.mkdir(parents=True, exist_ok=True)
        Campaign(pending, results).run()
        outcomes = _outcomes(results)
    click.echo(_table(mutants, outcomes))


def _outcomes(results: Path) -> dict[str, str]:
    """Return the last outcome of each mutant by its key."""
    if not results.exists():
        return {}
    lines = results.read_text(encoding="utf-8").splitlines()
    return {record["key"]: record["outcome"] for record in map(json.loads, lines)}


def _table(mutants: list[Mutant], outcomes: dict[str, str]) -> str:
    """Return a row of counts for each area, then a line for each survivor with its reason."""
    head = "".join(f"{outcome:>{width}}" for outcome, width in _COLUMN_WIDTHS.items())
    rows = [f"{'area':<11}{head}   killed of those planted"]
    rows += [_area_row(area, mutants, outcomes) for area in (*AREAS, "")]
    survivors = [m for m in mutants if outcomes.get(m.key) in _SURVIVING_OUTCOMES]
    lines = _REASONS_FILE.read_text(encoding="utf-8").splitlines()
    reasons = dict(line.rsplit(" | ", 1) for line in lines)
    for mutant in sorted(survivors, key=lambda mutant: (mutant.path, mutant.line)):
        reason = reasons.get(f"{mutant.path}: {mutant.change}", outcomes[mutant.key])
        rows.append(f"{mutant.path}:{mutant.line}: {mutant.change} ({reason})")
    return "\n".join(rows)


def _area_row(area: str, mutants: list[Mutant], outcomes: dict[str, str]) -> str:
    """Return the counts of outcomes in an area, and the killed share of its planted mutants."""
    area_mutants = [mutant for mutant in mutants if mutant.path.startswith(area)]
    counts = Counter(outcomes.get(mutant.key, "to run") for mutant in area_mutants)
    killed = sum(counts[outcome] for outcome in _KILLED_OUTCOMES)
    planted = killed + sum(counts[outcome] for outcome in _SURVIVING_OUTCOMES)
    cells = "".join(f"{counts[outcome]:>{width}}" for outcome, width in _COLUMN_WIDTHS.items())
    share = f"{100 * killed / planted:.1f} %" if planted else "–"
    return f"{area or 'all':<11}{cells}{share:>10}"


if __name__ == "__main__":
    main()
