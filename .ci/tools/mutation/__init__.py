"""A campaign that plants small faults in the package, one at a time, and counts the noticed ones.

`PYTHONPATH=.ci/tools:tests python -m mutation` draws mutants by a seed, from each file in
proportion to its lines of code (`sample`). For each mutant it runs the tests that reach the
enclosing function (`campaign`), in a fork of one process that has already collected all tests and
made the session's releases; a mutant therefore costs little more than its tests. `planting` puts it
into the process.

Mutated (`mutants`) are comparisons, arithmetic, signs, numbers, booleans, conditions, returned and
raised values, statements that can be left out, keyword arguments, and functions with a twin such
as `min` and `max`. Not mutated are texts (strings, docstrings, error messages, f-strings),
annotations, decorators and imports, nor the arguments `strict`, `dtype`, `copy` and `encoding`,
which have no effect on values on one machine.
"""
