"""Building blocks of verbs: lazily loaded groups, advanced options, options of fields."""

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

Function = TypeVar("Function", bound=Callable[..., Any])
if TYPE_CHECKING:
    _Choice = click.Choice[str]
else:
    _Choice = click.Choice  # click 8.1 has no `Choice[str]`


class LazyVerbs(click.Group):
    """A group that loads its verbs on demand: only the imports of the running verb are needed.

    The list of verbs imports none of them.
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
            verbs: The group's own verbs by name.
            read_plugin: Returns the verbs that a plug-in adds to the group.
            **options: Options of `click.Group`.
        """
        super().__init__(*arguments, **options)
        self._verbs = verbs
        self._read_plugin = read_plugin

    def _offers(self, *, own: bool = False) -> Offers[LazyVerb]:
        """Return the verbs of plug-ins; with `own` only the devkit's, without entry points."""
        return offers(self._read_plugin, self._verbs, own=own)

    def _all_verbs(self) -> dict[str, LazyVerb]:
        return {**self._verbs, **self._offers().by_name}

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 - click's signature
        """Return the verbs in alphabetical order, as click lists commands."""
        return sorted(self._all_verbs())

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002 - click's signature
        """Return the verb of a name; None if there is none."""
        for verbs in (self._verbs, self._offers(own=True).by_name):
            if cmd_name in verbs:
                return verbs[cmd_name].load()
        plugin_verb = self._offers().by_name.get(cmd_name)
        if plugin_verb is None:
            return None
        try:
            return plugin_verb.load()
        except Exception as error:
            raise MissingPluginError(
                f"{cmd_name}: its plug-in fails with {type(error).__name__}: {error}"
            ) from error

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002 - click's signature
        """Write the list of verbs, and which plug-ins were left out."""
        with formatter.section("Commands"):
            formatter.write_dl(
                [(name, verb.summary) for name, verb in sorted(self._all_verbs().items())]
            )
        refusals = self._offers().refusals_text()
        if refusals:
            formatter.write_paragraph()
            formatter.write_text(refusals)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the verb that the first word names.

        The error for an unknown word suggests the most similar verb, and names the plug-ins that
        were left out.
        """
        name = args[0]
        command = self.get_command(ctx, name)
        if command is not None:
            return name, command, args[1:]
        if not ctx.resilient_parsing and name[:1].isalnum():
            message = f"No such command '{name}'."
            for similar_name in get_close_matches(name, self._all_verbs(), n=1):
                message += f" Did you mean '{similar_name}'?"
            refusals = self._offers().refusals_text()
            if refusals:
                message += f"\n{refusals}"
            ctx.fail(message)
        return super().resolve_command(ctx, args)


class Advanced(click.Option):
    """An option that few users need; the help lists it last."""


class Verb(click.Command):
    """A command with a help that lists advanced options under a separate heading."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, and then the advanced ones."""
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
    """Return a decorator that makes a verb of a function; it takes arguments of `click.command`."""
    return click.command(name, cls=Verb, **options)


advanced = partial(click.option, cls=Advanced)
"""Like `click.option`."""


def together(*parameters: Callable[[Any], Any]) -> Callable[[Function], Function]:
    """Return a decorator that adds all these parameters to a verb, in this order."""

    def add(function: Function) -> Function:
        for parameter in reversed(parameters):
            function = parameter(function)
        return function

    return add


class WordChoice(_Choice):
    """One of several words, in upper or lower case; errors suggest a similar word."""

    def __init__(
        self, words: Iterable[str], elsewhere: Mapping[str, str] = MappingProxyType({})
    ) -> None:
        """Store the words, and hints for words that are valid elsewhere."""
        super().__init__(tuple(words), case_sensitive=False)
        self.elsewhere = elsewhere

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the word in its own spelling."""
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
    """Return an option for a field of a dataclass, with the field's name, type and default.

    Its help is the first sentence of the field's documentation.

    Args:
        config: The dataclass.
        field: Name of the field.
        *names: Names of the option, if they differ from the field's.
        option: Function that makes the option.
        **changes: Arguments of `click.option` that differ from the field.
    """
    default = changes.get("default", config.__dataclass_fields__[field].default)
    hint = get_type_hints(config)[field]
    name = field.replace("_", "-")
    settings: dict[str, Any] = {
        "default": default,
        "help": field_text(config, field),
        "show_default": default is not None and default is not False,
    }
    hints = [part for part in get_args(hint) or (hint,) if part is not NoneType]
    literals = [part for part in (hint, *hints) if get_origin(part) is Literal]
    if literals:
        settings["type"] = WordChoice(get_args(literals[0]))
    elif hint is bool:
        settings["is_flag"] = True
    else:
        settings["type"] = hints[0]
    flag = f"--{name}/--no-{name}" if default is True else f"--{name}"
    decorator: Callable[[Function], Function] = option(
        *(names or (flag, field)), **{**settings, **changes}
    )
    return decorator


def field_text(config: type[Any], field: str) -> str:
    """Return the first sentence of a class's documentation of one of its attributes."""
    pattern = rf"^    {field}: (.+?)(?=\n    \w|\n\n|\Z)"
    match = re.search(pattern, inspect.getdoc(config) or "", re.DOTALL | re.MULTILINE)
    if match is None:
        return ""
    text = " ".join(match[1].split())
    sentence: str = re.split(r"(?<=\.)\s+(?=[A-Z`])", text)[0]
    return sentence[:1].upper() + sentence[1:]
