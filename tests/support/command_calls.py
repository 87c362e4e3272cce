"""Calls of the command line, in this process or in a new one."""

import subprocess
import sys
from collections.abc import Iterator

import click
from click.testing import CliRunner, Result

from deepaccident_devkit.cli import deepaccident


def invoke_command(*words: object, status: int = 0) -> Result:
    """Run a command in this process; errors of the library are raised."""
    result = CliRunner().invoke(deepaccident, [*map(str, words)], catch_exceptions=False)
    assert result.exit_code == status, result.output
    return result


def run_command(*words: object, status: int = 0) -> subprocess.CompletedProcess[str]:
    """Run a command in a new process, where each error is one message without a traceback."""
    command = [sys.executable, "-m", "deepaccident_devkit.cli", *map(str, words)]
    process = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert process.returncode == status, process.stderr
    assert "Traceback" not in process.stderr, process.stderr
    return process


def walk_commands(
    command: click.Command, *words: str
) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    """Yield a command with its words, and all commands below it."""
    yield words, command
    if isinstance(command, click.Group):
        context = click.Context(command)
        for name in command.list_commands(context):
            subcommand = command.get_command(context, name)
            assert subcommand is not None
            yield from walk_commands(subcommand, *words, name)
