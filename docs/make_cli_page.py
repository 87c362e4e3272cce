"""Write docs/cli.md from the help texts of the commands themselves: `python docs/make_cli_page.py`."""

import inspect
from collections.abc import Iterable, Iterator
from pathlib import Path
from textwrap import indent

import click

from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.cli.options import release_parameters
from deepaccident_devkit.cli.verbs import Advanced

PAGE = Path(__file__).parent / "cli.md"

_HEAD = """# Command line: all commands

For everyone who uses the command `deepaccident`: what each command does, and all of its options.

`python docs/make_cli_page.py` makes this page from the help of the commands. `deepaccident COMMAND --help` prints the
same text in the terminal.

## The most used commands

| command | what it does |
|---|---|
| `deepaccident demo` | Makes a small synthetic release in `deepaccident_demo/`, and a page that shows it. |
| `deepaccident info DATAROOT` | Prints what a release holds. |
| `deepaccident validate DATAROOT` | Prints what is wrong or unusual in a download; with `--files`, what is missing. |
| `deepaccident index DATAROOT` | Makes the index before you need it. |
| `deepaccident synth OUT` | Makes a synthetic release, so that you can work without the data. |
| `deepaccident render VIEW DATAROOT --out FILE` | Renders a picture of the first accident, or of a row that you name. |
| `deepaccident render replay DATAROOT --out replay.html` | Writes one accident as a web page that plays it. |
| `deepaccident labels DATAROOT --split train --out FOLDER` | Writes the motion labels of a split into files. |
| `deepaccident predict constant_velocity DATAROOT --out FOLDER` | Writes predictions of a baseline, or of a trained \
model. |
| `deepaccident evaluate motion DATAROOT --results R --out DIR` | Evaluates predictions. `motion` can be `accident`, \
`detection` or `warning`. |
| `deepaccident check bundle DIR --dataroot DATAROOT` | Repeats an evaluation and lists all differences. |
| `deepaccident evaluate compare A B` | Compares two evaluations and tests which differences are significant. |

DATAROOT is the folder of a release: your download, a synthetic release, or `deepaccident_demo/release`. The exit status
is 0 if all is well, 1 if the command found something wrong, and 2 if it could not run.

Ctrl-C and SIGTERM end a command and its workers within two seconds, with exit status 130 and 143, at any moment: no
file is half-written, and the same command can be run again. While a file is written, it has a hidden name that ends in
`.tmp`. If a command is killed, such files stay; the next command that writes into their folder removes them, and keeps
those that others are writing. Files from other hosts are kept for a day.

Files are written first, then the command prints. So no file is missing if the reader of the output goes away (exit
status 141) or the output cannot be written (one line and exit status 2). A letter that the terminal lacks becomes a
question mark, and control characters in names are shown as in JSON, such as `\\u001b`.

## Options of a release

Every command with a DATAROOT and a link to this section has these options:

{release}
## All commands

"""


@click.command()
@release_parameters
def _release(**_: object) -> None: ...


_MIN_SIMILAR_COMMANDS = 3
"""Number of commands of a group from which on their common options are described at the group."""
_DIFFERENT_COMMANDS = ("video", "replay")
_RELEASE_NAMES = {parameter.name for parameter in _release.params}


def page() -> str:
    """Return the page's text."""
    release = "\n".join(_tables(_options(_release)))
    text = _HEAD.replace("{release}", release)
    sections = [_section(*command) for command in _commands(deepaccident, ("deepaccident",))]
    return text + "\n".join(sections)


def _options(command: click.Command) -> list[click.Option]:
    options = [parameter for parameter in command.params if isinstance(parameter, click.Option)]
    return [option for option in options if not option.hidden]


def _commands(
    command: click.Command, path: tuple[str, ...], parent: click.Group | None = None
) -> Iterator[tuple[click.Command, tuple[str, ...], click.Group | None]]:
    """Yield all commands below a group, each with its words and its group."""
    if len(path) > 1:
        yield command, path, parent
    if isinstance(command, click.Group):
        context = click.Context(command)
        for name in command.list_commands(context):
            subcommand = command.get_command(context, name)
            assert subcommand is not None
            yield from _commands(subcommand, (*path, name), command)


def _has_release_options(command: click.Command) -> bool:
    visible = [option for option in command.params if not getattr(option, "hidden", False)]
    return {parameter.name for parameter in visible} >= _RELEASE_NAMES


def _similar_commands(group: click.Group) -> dict[str, click.Command]:
    """Return the commands of a group that have the options of a release, except for the ones that
    differ from the rest.
    """
    context = click.Context(group)
    commands = {}
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        if command and _has_release_options(command) and name not in _DIFFERENT_COMMANDS:
            commands[name] = command
    return commands


def _common_options(group: click.Group) -> list[click.Option]:
    """Return the options that all similar commands have; none if these are few."""
    commands = _similar_commands(group).values()
    if len(commands) < _MIN_SIMILAR_COMMANDS:
        return []
    first, *further = [_options(command) for command in commands]
    common = _without(first, _options(_release))
    for options in further:
        common = [option for option in common if _is_in(option, options)]
    return common


def _is_in(option: click.Option, options: list[click.Option]) -> bool:
    """Return whether one of several options has the same row."""
    return _row(option) in map(_row, options)


def _without(options: list[click.Option], excluded: list[click.Option]) -> list[click.Option]:
    return [option for option in options if not _is_in(option, excluded)]


def _join_names(names: Iterable[str]) -> str:
    *first_names, last = [f"`{name}`" for name in names]
    return f"{', '.join(first_names)} and {last}"


def _section(command: click.Command, path: tuple[str, ...], parent: click.Group | None) -> str:
    """Return one command's section: its name, usage, help and options."""
    lines = [f"### {' '.join(path)}", ""]
    is_only_group = isinstance(command, click.Group) and not command.invoke_without_command
    if not is_only_group:
        words = [*path, "[OPTIONS]"]
        for parameter in command.params:
            if isinstance(parameter, click.Argument):
                words.append(_argument(parameter))
        lines += [f"    {' '.join(words)}", ""]
    lines += [_plain(command.help), ""]
    if isinstance(command, click.Group):
        context = click.Context(command)
        anchor = "-".join(path)
        names = command.list_commands(context)
        links = [f"[`{name}`](#{anchor}-{name})" for name in names]
        lines += [f"Commands below it: {', '.join(links)}.", ""]
        common = _common_options(command)
        if common:
            commands = _join_names(_similar_commands(command))
            lines += [f"{commands} have these options in common:", "", *_tables(common)]
    if is_only_group:
        return "\n".join(lines)
    options = _options(command)
    if _has_release_options(command):
        options = _without(options, _options(_release))
        text = "It has the [options of a release](#options-of-a-release)"
        described_at_group = _options_at_group(path[-1], parent)
        if described_at_group:
            options = _without(options, described_at_group)
            group = path[:-1]
            text += f", the options of [{' '.join(group)}](#{'-'.join(group)})"
        text += ", and these:" if options else "."
        lines += [text, ""]
    lines += _tables(options)
    if command.epilog:
        lines += [_plain(command.epilog), ""]
    return "\n".join(lines)


def _options_at_group(name: str, parent: click.Group | None) -> list[click.Option]:
    """Return the options of a command that are described at its group."""
    if parent is None or name in _DIFFERENT_COMMANDS:
        return []
    return _common_options(parent)


def _argument(argument: click.Argument) -> str:
    name = argument.metavar or str(argument.name).upper()
    return name if argument.required or name.startswith("[") else f"[{name}]"


def _row(option: click.Option) -> str:
    return f"| {_name(option)} | {_meaning(option)} |"


def _tables(options: list[click.Option]) -> list[str]:
    """Return a row for each option; the advanced ones in a table of their own."""
    lines = []
    for heading, is_advanced in (("option", False), ("advanced option", True)):
        rows = [_row(option) for option in options if isinstance(option, Advanced) is is_advanced]
        if rows:
            lines += [f"| {heading} | what it does |", "|---|---|", *rows, ""]
    return lines


def _name(option: click.Option) -> str:
    names = ", ".join(f"`{name}`" for name in (*option.opts, *option.secondary_opts))
    if option.is_flag or isinstance(option.type, click.Choice):
        return names
    value = option.metavar or option.type.name.upper().removesuffix(" RANGE")
    return f"{names} `{value}`".replace("|", "\\|")


def _meaning(option: click.Option) -> str:
    text = _plain(option.help).replace("\n", " ").replace("  [", " [")
    sentences = [text.replace("|", "\\|")]
    if isinstance(option.type, click.Choice):
        choices = [f"`{choice}`" for choice in option.type.choices]
        sentences.append(f"One of {', '.join(choices)}.")
    if option.required:
        sentences.append("Required.")
    elif option.show_default is True:
        value = option.default
        if isinstance(value, (list, tuple)):
            value = ", ".join(map(str, value))
        if option.is_flag:
            value = (option.opts if value else option.secondary_opts)[0]
        sentences.append(f"Default: `{value}`.")
    return " ".join(filter(None, sentences))


def _plain(text: str | None) -> str:
    """Return a help text as Markdown; what click does not wrap is a block."""
    paragraphs = inspect.cleandoc(text or "").split("\n\n")
    for index, paragraph in enumerate(paragraphs):
        if paragraph.startswith("\b\n"):
            paragraphs[index] = indent(paragraph[2:], "    ")
    return "\n\n".join(paragraphs)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
