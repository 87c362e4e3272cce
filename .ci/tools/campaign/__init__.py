"""A campaign of files that strangers changed, of processes that are killed and of full disks.

`PYTHONPATH=.ci/tools python -m campaign` from the top of the checkout runs all of it and writes its
numbers into docs/validation.md. Nothing may go wrong.
"""
