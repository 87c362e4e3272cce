"""A verb that does its own work and has further verbs below it."""

from typing import Any

import click


class VerbGroup(click.Group):
    """A group that is a verb itself: words that begin with none of its subcommands are its own arguments.

    An argument that is called like a subcommand can be given as a path: `./info`.
    """

    allow_extra_args = False
    allow_interspersed_args = True

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """Take what `click.Group` takes."""
        super().__init__(*arguments, **{"no_args_is_help": False, "invoke_without_command": True, **options})

    def make_context(
        self, info_name: str | None, args: list[str], parent: click.Context | None = None, **extra: Any
    ) -> click.Context:
        """The context of the subcommand that the first word names, else of the verb itself."""
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
