"""`deepaccident safety`: what is to be learnt from the accidents of a release, from its labels alone."""

import click

from deepaccident_devkit.cli.safety_avoidability import avoidability
from deepaccident_devkit.cli.safety_describe import describe
from deepaccident_devkit.cli.safety_lead_time import lead_time
from deepaccident_devkit.cli.safety_report import report
from deepaccident_devkit.cli.safety_twins import twins


@click.group()
def safety() -> None:
    """Look into accidents: who saw the danger first, when it was too late, and how a normal twin differs."""


safety.add_command(lead_time)
safety.add_command(avoidability)
safety.add_command(twins)
safety.add_command(describe)
safety.add_command(report)
