"""Commands as a user gives them: in this process, or in one of their own."""

import subprocess
import sys
from collections.abc import Iterator

import click
from click.testing import CliRunner, Result

from deepaccident_devkit.cli import deepaccident


def called(*words: object, status: int = 0) -> Result:
    """What a command does in this process; errors of the library come through."""
    result = CliRunner().invoke(deepaccident, [*map(str, words)], catch_exceptions=False)
    assert result.exit_code == status, result.output
    return result


def ran(*words: object, status: int = 0) -> subprocess.CompletedProcess[str]:
    """What a command does in a process of its own, in which each error is one message."""
    command = [sys.executable, "-m", "deepaccident_devkit.cli", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert (done.returncode, "Traceback" in done.stderr) == (status, False), done.stderr
    return done


def commands(
    command: click.Command, *words: str
) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    """A command by its words, and all commands below it."""
    yield words, command
    context = click.Context(command)
    for name in command.list_commands(context) if isinstance(command, click.Group) else ():
        below = command.get_command(context, name)
        assert below is not None
        yield from commands(below, *words, name)
