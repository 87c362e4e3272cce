"""What verbs are made of: groups that import the verb that runs alone, a heading "Advanced", options of fields."""

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
    """Verbs that are made when they are asked for, so that only what the verb that runs needs is imported.

    The list of verbs imports none of them.
    """

    def __init__(
        self,
        *arguments: Any,
        verbs: Mapping[str, LazyVerb],
        read_plugin: Callable[[Plugin], Mapping[str, LazyVerb]],
        **options: Any,
    ) -> None:
        """Take what `click.Group` takes.

        Args:
            *arguments: Of `click.Group`.
            verbs: The group's own verbs by name.
            read_plugin: Gives the verbs that a plug-in adds to the group.
            **options: Of `click.Group`.
        """
        super().__init__(*arguments, **options)
        self._verbs = verbs
        self._read_plugin = read_plugin

    def _offers(self, *, own: bool = False) -> Offers[LazyVerb]:
        """Return what plug-ins add; the devkit's own ones only with `own`, which reads no entry points."""
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
        found = self._offers().by_name.get(cmd_name)
        if found is None:
            return None
        try:
            return found.load()
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
        if refusals := self._offers().refusals_text():
            formatter.write_paragraph()
            formatter.write_text(refusals)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the verb that the first word names.

        The error for an unknown word names the verb that was probably meant, and the plug-ins that were left out.
        """
        command = self.get_command(ctx, args[0])
        if command is not None:
            return args[0], command, args[1:]
        if not ctx.resilient_parsing and args[0][:1].isalnum():
            meant = get_close_matches(args[0], self._all_verbs(), n=1)
            hint = f" Did you mean '{meant[0]}'?" if meant else ""
            refusals = self._offers().refusals_text()
            ctx.fail(f"No such command '{args[0]}'.{hint}" + (f"\n{refusals}" if refusals else ""))
        return super().resolve_command(ctx, args)


class Advanced(click.Option):
    """An option that few need: the help names it last."""


class Verb(click.Command):
    """A command whose help has advanced options under a heading of their own."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, and then the advanced ones."""
        options = [each for each in self.get_params(ctx) if isinstance(each, click.Option)]
        for heading, kind in (("Options", False), ("Advanced", True)):
            records = (
                each.get_help_record(ctx) for each in options if isinstance(each, Advanced) is kind
            )
            if rows := [record for record in records if record is not None]:
                with formatter.section(heading):
                    formatter.write_dl(rows)


def verb(name: str | None = None, **options: Any) -> Callable[[Callable[..., Any]], Verb]:
    """A decorator that makes a verb of a function; takes what `click.command` takes."""
    return click.command(name, cls=Verb, **options)


advanced = partial(click.option, cls=Advanced)
"""As `click.option`."""


def together(*parameters: Callable[[Any], Any]) -> Callable[[Function], Function]:
    """A decorator that gives a verb all of these parameters, in this order."""

    def give(function: Function) -> Function:
        for parameter in reversed(parameters):
            function = parameter(function)
        return function

    return give


class WordChoice(_Choice):
    """One of some words in any case of letters; the error of another one names the word that was probably meant."""

    def __init__(
        self, words: Iterable[str], elsewhere: Mapping[str, str] = MappingProxyType({})
    ) -> None:
        """Take the words, and what to say of words that mean something in another place."""
        super().__init__(tuple(words), case_sensitive=False)
        self.elsewhere = elsewhere

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The word in its own spelling."""
        try:
            return super().convert(value, param, ctx)
        except click.BadParameter as error:
            meant = self.elsewhere.get(value) or meant_text(value, self.choices)
            self.fail(f"{error.message.removesuffix('.')}{meant}", param, ctx)


def field_option(
    config: type[Any],
    field: str,
    *names: str,
    option: Callable[..., Any] = click.option,
    **changes: Any,
) -> Callable[[Function], Function]:
    """An option for a field of a dataclass, so that nothing is said twice.

    Its name, type and default are the field's, its help is the first sentence of what the class says of the field.
    `names` are of the option if other ones, `changes` what is other than the field, as `click.option` takes it.
    """
    default = changes.get("default", config.__dataclass_fields__[field].default)
    hint = get_type_hints(config)[field]
    hints = [each for each in get_args(hint) or (hint,) if each is not NoneType]
    words = (
        hint
        if get_origin(hint) is Literal
        else next((each for each in hints if get_origin(each) is Literal), None)
    )
    name = field.replace("_", "-")
    settings: dict[str, Any] = {"default": default, "help": field_text(config, field)}
    if words is not None:
        settings["type"] = WordChoice(get_args(words))
    elif hint is bool:
        settings["is_flag"] = True
    else:
        settings["type"] = hints[0]
    settings["show_default"] = default is not None and default is not False
    usual = (f"--{name}/--no-{name}" if default is True else f"--{name}", field)
    made: Callable[[Function], Function] = option(*(names or usual), **{**settings, **changes})
    return made


def field_text(config: type[Any], field: str) -> str:
    """The first sentence of what a class says of one of its attributes."""
    pattern = rf"^    {field}: (.+?)(?=\n    \w|\n\n|\Z)"
    found = re.search(pattern, inspect.getdoc(config) or "", re.DOTALL | re.MULTILINE)
    sentence = re.split(r"(?<=\.)\s+(?=[A-Z`])", " ".join(found[1].split()))[0] if found else ""
    return sentence[:1].upper() + sentence[1:]
