"""Groups of verbs: one imports a verb only when it is needed, the other is a verb with further verbs below it."""

from collections.abc import Mapping
from difflib import get_close_matches
from importlib import import_module
from typing import Any

import click


class ModuleVerbs(click.Group):
    """Verbs that lie in modules of the same names: only the module of the verb that is run is imported.

    The list of verbs imports none of them.
    """

    def __init__(self, *arguments: Any, package: str, verbs: Mapping[str, str], **options: Any) -> None:
        """Take what `click.Group` takes, and verbs with a line on each; `package.verb` is the module that holds it."""
        super().__init__(*arguments, **options)
        self._package = package
        self._verbs = verbs

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 - click's signature
        """The verbs in alphabetical order, as click lists commands."""
        return sorted(self._verbs)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002 - click's signature
        """The verb of a name; None if there is none."""
        if cmd_name not in self._verbs:
            return None
        name = cmd_name.replace("-", "_")
        verb: click.Command = getattr(import_module(f"{self._package}.{name}"), name)
        return verb

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002 - click's signature
        """Write the list of verbs."""
        with formatter.section("Commands"):
            formatter.write_dl(sorted(self._verbs.items()))

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """The verb that the first word names; for a word that is nearly one, the error names the verb."""
        meant = get_close_matches(args[0], self._verbs, n=1)
        if meant and args[0] not in self._verbs and not ctx.resilient_parsing:
            ctx.fail(f"No such command '{args[0]}'. Did you mean '{meant[0]}'?")
        return super().resolve_command(ctx, args)


class VerbGroup(click.Group):
    """A group that is a verb itself: if the first word is no subcommand, all words are its own arguments.

    An argument with the name of a subcommand can be given as a path: `./info`.
    """

    allow_extra_args = False
    allow_interspersed_args = True

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """Take what `click.Group` takes."""
        super().__init__(*arguments, **{"no_args_is_help": False, "invoke_without_command": True, **options})

    def make_context(
        self, info_name: str | None, args: list[str], parent: click.Context | None = None, **extra: Any
    ) -> click.Context:
        """The context of the subcommand that the first word names; if there is none, that of the verb itself."""
        if args and args[0] in self.commands:
            name, *rest = args
            return self.commands[name].make_context(f"{info_name} {name}", rest, parent, **extra)
        return super().make_context(info_name, args, parent, **extra)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse as a plain verb does."""
        return click.Command.parse_args(self, ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        """Run as a plain verb does."""
        return click.Command.invoke(self, ctx)

    def collect_usage_pieces(self, ctx: click.Context) -> list[str]:
        """Show the verb's own usage; the subcommands are listed below it."""
        return click.Command.collect_usage_pieces(self, ctx)
