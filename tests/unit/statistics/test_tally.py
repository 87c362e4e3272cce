"""What parts count adds up to what is counted at once."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from deepaccident_devkit.statistics.results import GROUPS, PROBABILITIES
from deepaccident_devkit.statistics.tally import LEFT_OUT, PARTS, Tally

EDGES = (-1.0, 0.0, 0.5, 3.0)
numbers = st.one_of(st.sampled_from([-1.0, 0.0, 0.5, 0.1 + 0.2, 1 / 3, 3.0, 7.5]), st.floats(-1e6, 1e6))
rows = st.tuples(numbers.map(lambda number: number + 0.0), st.integers(-1, len(PARTS) - 1))  # no −0, which equals 0
words = st.sampled_from(["here", "also here", "a", "b", "unknown"])


@given(st.lists(st.lists(rows, max_size=12), min_size=1, max_size=5))
def test_quantiles_and_bins_of_parts_are_numpys_of_all_values(parts: list[list[tuple[float, int]]]) -> None:
    merged = Tally()
    for part in parts:
        tally = Tally()
        values, groups = np.array([value for value, _ in part]), np.array([code for _, code in part], dtype=np.int8)
        tally.add_values("sizes", "length", "car", values, groups)
        tally.count_bins("sizes", values, groups, EDGES)
        merged.add(tally)
    everything = [row for part in parts for row in part if row[1] >= 0]
    counts, outside = merged.by_bin("sizes", EDGES)
    for row in merged.quantiles("sizes", "length", "car"):
        mine = np.array([value for value, code in everything if row.group in ("total", PARTS[code])])
        assert row.number == len(mine)
        assert row.values == (tuple(np.quantile(mine, PROBABILITIES).tolist()) if len(mine) else None)
        assert counts[row.group] == tuple(np.histogram(mine, EDGES)[0].tolist())
        assert outside[row.group] == len(mine) - sum(counts[row.group])


@given(st.lists(st.lists(st.tuples(words, st.sampled_from(PARTS)), max_size=6), max_size=4))
def test_known_words_are_first_others_sorted_and_unknown_last(parts: list[list[tuple[str, str]]]) -> None:
    merged = Tally()
    for part in parts:
        tally = Tally()
        for word, group in part:
            tally.counts["words", word, group] += 1
        tally.counts["words", LEFT_OUT, PARTS[0]] += 1
        merged.add(tally)
    found = [row for part in parts for row in part]
    table = merged.by_word("words", ("here", "also here"))
    order = ["here", "also here", "a", "b", "unknown"]
    assert list(table) == [word for word in order if word in {"here", "also here"} | {word for word, _ in found}]
    for word, row in table.items():
        assert tuple(row) == GROUPS
        assert row == {
            group: sum(word == name and group in ("total", part) for name, part in found) for group in GROUPS
        }
    assert merged.by_group("words", LEFT_OUT)["total"] == len(parts)
