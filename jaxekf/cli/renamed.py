"""Old names of options, which work for one release."""

from collections.abc import Mapping

import click

from jaxekf.cli.console import note


def renamed_options(renamed: Mapping[str, str]) -> type[click.Command]:
    """Class of commands that take options under their old names too, and note the new ones."""

    class Command(click.Command):
        def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
            end = args.index("--") if "--" in args else len(args)
            for i, argument in enumerate(args[:end]):
                old, equals, value = argument.partition("=")
                if old in renamed:
                    new = renamed[old]
                    note(f"{old} is now {new}; the old name will be gone in the next release")
                    args[i] = new + equals + value
            return super().parse_args(ctx, args)

    return Command
