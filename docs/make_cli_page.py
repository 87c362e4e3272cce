"""Write docs/cli.md from the help texts of the commands themselves: `python
docs/make_cli_page.py`.
"""

import inspect
from collections.abc import Iterator
from pathlib import Path
from textwrap import indent

import click

from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.cli.options import release_parameters
from deepaccident_devkit.cli.verbs import Advanced

PAGE = Path(__file__).parent / "cli.md"
WORDS_A_MINUTE = 200

_HEAD = """# Command line: all commands

For everybody who uses the command `deepaccident`: what each command does, and all of its options. {minutes} minutes;
one minute if you look up one command.

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


_ALIKE = 3
"""Options that at least so many commands of a group have in common are described once, at the
group.
"""
_UNLIKE = ("video", "replay")
_SHARED = {parameter.name for parameter in _release.params}


def page() -> str:
    """The page's text."""
    release = "\n".join(_tables(_options(_release)))
    commands = "\n".join(_section(*each) for each in _commands(deepaccident, ("deepaccident",)))
    text = _HEAD.replace("{release}", release) + commands
    return text.replace("{minutes}", str(max(1, round(len(text.split()) / WORDS_A_MINUTE))))


def _options(command: click.Command) -> list[click.Option]:
    return [each for each in command.params if isinstance(each, click.Option) and not each.hidden]


def _commands(
    command: click.Command, path: tuple[str, ...], parent: click.Group | None = None
) -> Iterator[tuple[click.Command, tuple[str, ...], click.Group | None]]:
    """All commands below a group, each with its words and its group."""
    if len(path) > 1:
        yield command, path, parent
    if isinstance(command, click.Group):
        context = click.Context(command)
        for name in command.list_commands(context):
            below = command.get_command(context, name)
            assert below is not None
            yield from _commands(below, (*path, name), command)


def _on_release(command: click.Command) -> bool:
    return {each.name for each in command.params if not getattr(each, "hidden", False)} >= _SHARED


def _alike(group: click.Group) -> dict[str, click.Command]:
    """The commands of a group that have the options of a release, except for those that differ from
    the others.
    """
    context = click.Context(group)
    commands = {name: group.get_command(context, name) for name in group.list_commands(context)}
    return {
        name: each
        for name, each in commands.items()
        if each and _on_release(each) and name not in _UNLIKE
    }


def _common(group: click.Group) -> list[click.Option]:
    """The options that all of these commands have; none if they are few."""
    alike = [_options(command) for command in _alike(group).values()]
    if len(alike) < _ALIKE:
        return []
    return [
        each
        for each in _without(alike[0], _options(_release))
        if all(_is_in(each, options) for options in alike)
    ]


def _is_in(option: click.Option, options: list[click.Option]) -> bool:
    """Whether one of some options has the same row."""
    return _row(option) in map(_row, options)


def _without(options: list[click.Option], others: list[click.Option]) -> list[click.Option]:
    return [each for each in options if not _is_in(each, others)]


def _with_release(group: click.Group) -> str:
    *most, last = (f"`{name}`" for name in _alike(group))
    return f"{', '.join(most)} and {last}"


def _section(command: click.Command, path: tuple[str, ...], parent: click.Group | None) -> str:
    """One command: its name, usage, help and options."""
    lines = [f"### {' '.join(path)}", ""]
    only_group = isinstance(command, click.Group) and not command.invoke_without_command
    if not only_group:
        words = [_argument(each) for each in command.params if isinstance(each, click.Argument)]
        lines += [f"    {' '.join([*path, '[OPTIONS]', *words])}", ""]
    lines += [_plain(command.help), ""]
    if isinstance(command, click.Group):
        context = click.Context(command)
        names = [
            f"[`{name}`](#{'-'.join((*path, name))})" for name in command.list_commands(context)
        ]
        lines += [f"Commands below it: {', '.join(names)}.", ""]
        if common := _common(command):
            lines += [
                f"{_with_release(command)} have these options in common:",
                "",
                *_tables(common),
            ]
    if only_group:
        return "\n".join(lines)
    options = _options(command)
    if _on_release(command):
        options = _without(options, _options(_release))
        also = ""
        if parent is not None and path[-1] not in _UNLIKE and (common := _common(parent)):
            options = _without(options, common)
            also = f", those of [{' '.join(path[:-1])}](#{'-'.join(path[:-1])})"
        lines += [
            f"It has the [options of a release](#options-of-a-release){also}{', and these:' if options else '.'}",
            "",
        ]
    lines += _tables(options)
    if command.epilog:
        lines += [_plain(command.epilog), ""]
    return "\n".join(lines)


def _argument(argument: click.Argument) -> str:
    name = argument.metavar or str(argument.name).upper()
    return name if argument.required or name.startswith("[") else f"[{name}]"


def _row(option: click.Option) -> str:
    return f"| {_name(option)} | {_meaning(option)} |"


def _tables(options: list[click.Option]) -> list[str]:
    """A row an option; the advanced ones in a table of their own."""
    lines = []
    for heading, kind in (("option", False), ("advanced option", True)):
        if rows := [_row(each) for each in options if isinstance(each, Advanced) is kind]:
            lines += [f"| {heading} | what it does |", "|---|---|", *rows, ""]
    return lines


def _name(option: click.Option) -> str:
    names = ", ".join(f"`{name}`" for name in (*option.opts, *option.secondary_opts))
    if option.is_flag or isinstance(option.type, click.Choice):
        return names
    return f"{names} `{option.metavar or option.type.name.upper().removesuffix(' RANGE')}`".replace(
        "|", "\\|"
    )


def _meaning(option: click.Option) -> str:
    words = [_plain(option.help).replace("\n", " ").replace("  [", " [").replace("|", "\\|")]
    if isinstance(option.type, click.Choice):
        words.append(f"One of {', '.join(f'`{choice}`' for choice in option.type.choices)}.")
    if option.required:
        words.append("Required.")
    elif option.show_default is True:
        value = option.default
        if isinstance(value, (list, tuple)):
            value = ", ".join(map(str, value))
        if option.is_flag:
            value = (option.opts if value else option.secondary_opts)[0]
        words.append(f"Default: `{value}`.")
    return " ".join(word for word in words if word)


def _plain(text: str | None) -> str:
    """A help text; what click does not wrap is a block."""
    parts = inspect.cleandoc(text or "").split("\n\n")
    return "\n\n".join(
        indent(each[2:], "    ") if each.startswith("\b\n") else each for each in parts
    )


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
