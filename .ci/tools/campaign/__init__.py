"""The campaign: files that strangers changed, processes that are killed, disks that are full.
Nothing may go wrong.

`PYTHONPATH=.ci/tools python -m campaign` from the top of the checkout runs all of it and writes its
numbers into docs/validation.md.
"""
