"""Building blocks of subcommands: lazy groups, advanced options, and options from fields."""

import inspect
import re
from collections.abc import Callable, Iterable, Mapping
from difflib import get_close_matches
from functools import partial
from types import MappingProxyType, NoneType
from typing import TYPE_CHECKING, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import click

from deepaccident_devkit.errors import MissingPluginError
from deepaccident_devkit.support.plugins import LazyVerb, Offers, Plugin, offers
from deepaccident_devkit.support.text import meant_text
from deepaccident_devkit.support.values import NamedValues

Function = TypeVar("Function", bound=Callable[..., Any])
if TYPE_CHECKING:
    _Choice = click.Choice[str]
else:
    _Choice = click.Choice  # `Choice[str]` does not exist in click 8.1


class LazyVerbs(click.Group):
    """A group that loads its subcommands on demand, so that only the one that runs is imported.

    Listing the subcommands imports none of them.
    """

    def __init__(
        self,
        *arguments: Any,
        verbs: Mapping[str, LazyVerb],
        read_plugin: Callable[[Plugin], Mapping[str, LazyVerb]],
        **options: Any,
    ) -> None:
        """Create the group.

        Args:
            *arguments: Arguments of `click.Group`.
            verbs: The group's built-in subcommands by name.
            read_plugin: Function that returns the subcommands that a plug-in adds to the group.
            **options: Options of `click.Group`.
        """
        super().__init__(*arguments, **options)
        self._verbs = verbs
        self._read_plugin = read_plugin

    def _collect_offers(self, *, own: bool = False) -> Offers[LazyVerb]:
        """Return the subcommands of all plug-ins or, if `own`, of the devkit's plug-ins only."""
        return offers(self._read_plugin, self._verbs, own=own)

    def _collect_verbs(self) -> dict[str, LazyVerb]:
        return {**self._verbs, **self._collect_offers().by_name}

    def _find_in_groups(self, ctx: click.Context, name: str) -> list[str]:
        """Return the commands of a name in groups, such as `deepaccident evaluate compare`."""
        commands = []
        for group_name, group_verb in self._verbs.items():
            group = group_verb.load()
            if isinstance(group, click.Group) and name in group.list_commands(ctx):
                commands.append(f"{ctx.command_path} {group_name} {name}")
        return commands

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 - click's signature
        """Return the names of the subcommands in alphabetical order, like click."""
        return sorted(self._collect_verbs())

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002 - click's signature
        """Return the subcommand with a name; None if it does not exist."""
        for verbs in (self._verbs, self._collect_offers(own=True).by_name):
            if cmd_name in verbs:
                return verbs[cmd_name].load()
        plugin_verb = self._collect_offers().by_name.get(cmd_name)
        if plugin_verb is None:
            return None
        try:
            return plugin_verb.load()
        except Exception as error:
            raise MissingPluginError(
                f"{cmd_name}: its plug-in failed with {type(error).__name__}: {error}"
            ) from error

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002 - click's signature
        """Write the list of subcommands, and which plug-ins were left out."""
        verbs = sorted(self._collect_verbs().items())
        with formatter.section("Commands"):
            formatter.write_dl([(name, verb.summary) for name, verb in verbs])
        refusals = self._collect_offers().refusals_text()
        if refusals:
            formatter.write_paragraph()
            formatter.write_text(refusals)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the subcommand that the first word names.

        If there is none, the error suggests the most similar name, otherwise subcommands of groups
        with this name, and lists the plug-ins that were left out.
        """
        name = args[0]
        command = self.get_command(ctx, name)
        if command is not None:
            return name, command, args[1:]
        if not ctx.resilient_parsing and name[:1].isalnum():
            message = f"No such command '{name}'."
            suggestions = get_close_matches(name, self._collect_verbs(), n=1)
            if not suggestions and ctx.parent is None:
                suggestions = self._find_in_groups(ctx, name)
            if suggestions:
                message += f" Did you mean {' or '.join(map(repr, suggestions))}?"
            refusals = self._collect_offers().refusals_text()
            if refusals:
                message += f"\n{refusals}"
            ctx.fail(message)
        return super().resolve_command(ctx, args)


class Advanced(click.Option):
    """An option that few users need; the help lists it last."""


class Verb(click.Command):
    """A subcommand whose help lists advanced options under a separate heading."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the normal options, then the advanced ones."""
        for heading in ("Options", "Advanced"):
            records = []
            for option in self.get_params(ctx):
                is_advanced = isinstance(option, Advanced)
                if isinstance(option, click.Option) and is_advanced == (heading == "Advanced"):
                    record = option.get_help_record(ctx)
                    if record is not None:
                        records.append(record)
            if records:
                with formatter.section(heading):
                    formatter.write_dl(records)


def verb(name: str | None = None, **options: Any) -> Callable[[Callable[..., Any]], Verb]:
    """Return a decorator that makes a function a subcommand; takes `click.command` arguments."""
    return click.command(name, cls=Verb, **options)


advanced = partial(click.option, cls=Advanced)
"""Decorator like `click.option`, for an advanced option."""


def together(*parameters: Callable[[Any], Any]) -> Callable[[Function], Function]:
    """Return a decorator that adds all these parameters to a subcommand, in this order."""

    def add_parameters(function: Function) -> Function:
        for parameter in reversed(parameters):
            function = parameter(function)
        return function

    return add_parameters


class WordChoice(_Choice):
    """One of several words, in any case; errors suggest a similar word."""

    def __init__(
        self, words: Iterable[str], elsewhere: Mapping[str, str] = MappingProxyType({})
    ) -> None:
        """Store the words, and hints for words that are only valid elsewhere."""
        super().__init__(tuple(words), case_sensitive=False)
        self.elsewhere = elsewhere

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the word in the spelling in which it was defined."""
        try:
            return super().convert(value, param, ctx)
        except click.BadParameter as error:
            hint = self.elsewhere.get(value) or meant_text(value, self.choices)
            self.fail(f"{error.message.removesuffix('.')}{hint}", param, ctx)


def field_option(
    config: type[Any],
    field: str,
    *names: str,
    option: Callable[..., Any] = click.option,
    **changes: Any,
) -> Callable[[Function], Function]:
    """Make an option for a dataclass field, with the field's name, type and default.

    The help is the first sentence of the field's documentation.

    Args:
        config: The dataclass.
        field: Name of the field.
        *names: Names of the option, if they differ from the name of the field.
        option: Function that makes the option.
        **changes: Arguments of `click.option` that override those derived from the field.
    """
    default = changes.get("default", config.__dataclass_fields__[field].default)
    hint = get_type_hints(config)[field]
    name = field.replace("_", "-")
    settings: NamedValues = {
        "default": default,
        "help": field_text(config, field),
        "show_default": default is not None and default is not False,
    }
    hints = [member for member in get_args(hint) or (hint,) if member is not NoneType]
    literals = [member for member in (hint, *hints) if get_origin(member) is Literal]
    if literals:
        settings["type"] = WordChoice(get_args(literals[0]))
    elif hint is bool:
        settings["is_flag"] = True
        settings["help"] = _capitalise(settings["help"].removeprefix("Whether to "))
    else:
        settings["type"] = hints[0]
    flag = f"--{name}"
    if default is True:
        flag = f"--{name}/--no-{name}"
    decorator: Callable[[Function], Function] = option(
        *(names or (flag, field)), **{**settings, **changes}
    )
    return decorator


def field_text(config: type[Any], field: str) -> str:
    """Return the first sentence of an attribute's documentation in a class."""
    pattern = rf"^    {field}: (.+?)(?=\n    \w|\n\n|\Z)"
    match = re.search(pattern, inspect.getdoc(config) or "", re.DOTALL | re.MULTILINE)
    if match is None:
        return ""
    text = " ".join(match[1].split())
    sentence: str = re.split(r"(?<=\.)\s+(?=[A-Z`])", text)[0]
    return _capitalise(sentence)


def _capitalise(sentence: str) -> str:
    return sentence[:1].upper() + sentence[1:]
