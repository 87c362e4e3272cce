"""`PYTHONPATH=.ci/tools:tests python -m mutation`: plant mutants in the package, and see which the
tests notice.
"""

import json
from collections import Counter
from pathlib import Path

import click

from mutation.campaign import Campaign
from mutation.mutants import Mutant
from mutation.sample import AREAS, drawn

_PLANTED = ("killed", "timed out", "survived", "not reached")


@click.command()
@click.option("--count", default=1500, help="How many mutants are drawn by each seed.")
@click.option(
    "--seed",
    "seeds",
    multiple=True,
    type=int,
    default=[17],
    help="Of the drawing; several are pooled.",
)
@click.option(
    "--only",
    multiple=True,
    metavar="PATH",
    help="Run those of the files that begin so, as motion/warping.",
)
@click.option("--again", is_flag=True, help="Run those that survived once more.")
@click.option(
    "--results",
    type=click.Path(path_type=Path),
    default="build/mutants.jsonl",
    help="What came of each; it grows.",
)
@click.option("--table", is_flag=True, help="Run nothing.")
def main(
    count: int,
    seeds: tuple[int, ...],
    only: tuple[str, ...],
    again: bool,
    results: Path,
    table: bool,
) -> None:
    """Run what RESULTS does not have yet, and print how many were killed in each area, and what
    survived.
    """
    pooled = {mutant.key: mutant for seed in seeds for mutant in drawn(count, seed)}
    mutants = [mutant for mutant in pooled.values() if mutant.path.startswith(only or ("",))]
    known = _outcomes(results)
    waiting = [
        each
        for each in mutants
        if known.get(each.key) is None or (again and known[each.key] in _PLANTED[2:])
    ]
    if waiting and not table:
        results.parent.mkdir(parents=True, exist_ok=True)
        Campaign(waiting, results).run()
        known = _outcomes(results)
    click.echo(_table(mutants, known))


def _outcomes(results: Path) -> dict[str, str]:
    """The last outcome of each mutant."""
    lines = results.read_text(encoding="utf-8").splitlines() if results.exists() else []
    return {record["key"]: record["outcome"] for record in map(json.loads, lines)}


def _table(mutants: list[Mutant], outcomes: dict[str, str]) -> str:
    rows = [
        (
            "area         killed  timed out  survived  not reached  not planted  to run "
            "  killed of those planted"
        )
    ]
    for area in (*AREAS, ""):
        inside = [mutant for mutant in mutants if mutant.path.startswith(area)]
        counts = Counter(outcomes.get(mutant.key, "to run") for mutant in inside)
        planted = sum(counts[outcome] for outcome in _PLANTED)
        share = (
            f"{100 * (counts['killed'] + counts['timed out']) / planted:.1f} %" if planted else "–"
        )
        cells = "".join(
            f"{counts[outcome]:>{width}}"
            for outcome, width in zip(
                (*_PLANTED, "not planted", "to run"), (8, 11, 10, 13, 13, 8), strict=True
            )
        )
        rows.append(f"{area or 'all':<11}{cells}{share:>10}")
    left = [mutant for mutant in mutants if outcomes.get(mutant.key) in _PLANTED[2:]]
    lines = (Path(__file__).parent / "survivors.txt").read_text(encoding="utf-8").splitlines()
    reasons = dict(line.rsplit(" | ", 1) for line in lines)
    for mutant in sorted(left, key=lambda mutant: (mutant.path, mutant.line)):
        reason = reasons.get(f"{mutant.path}: {mutant.change}", outcomes[mutant.key])
        rows.append(f"{mutant.path}:{mutant.line}: {mutant.change} ({reason})")
    return "\n".join(rows)


if __name__ == "__main__":
    main()
