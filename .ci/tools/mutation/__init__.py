"""A campaign of small faults planted in the package, one at a time: which of them do the tests
notice?

`PYTHONPATH=.ci/tools:tests python -m mutation` draws mutants by a seed, of each file in proportion
to its lines of code (`sample`), and runs for each the tests that reach the function it lies in
(`campaign`), in a fork of one process that has collected all tests and made the session's releases,
so that a mutant costs little more than its tests (`planting` says how it gets there).

What is mutated (`mutants`): comparisons, arithmetic, signs, numbers, booleans, conditions, what is
    returned or raised,
statements that can be left out, keyword arguments, and functions that have a twin such as `min` and
`max`. What is not: texts (strings, docstrings, messages of errors, f-strings), annotations,
decorators and imports; nor the arguments `strict`, `dtype`, `copy` and `encoding`, which no value
shows on one machine.
"""
