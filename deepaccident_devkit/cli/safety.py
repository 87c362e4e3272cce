"""`deepaccident safety`: what is to be learnt from the accidents of a release, from its labels alone."""

import click


@click.group()
def safety() -> None:
    """Look into accidents: who saw the danger first, and how a normal twin differs."""
