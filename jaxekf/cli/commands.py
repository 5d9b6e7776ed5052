"""The group of commands: a command is imported when it runs, and its errors become messages of one line."""

import errno
import os
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import click
from click.shell_completion import CompletionItem

from jaxekf._support.errors import JaxekfError

WRITTEN = "jaxekf.written"
"""Key of the finished outputs in a command's context (`click.Context.meta`)."""
_SIGINT_STATUS = 130
"""128 plus the number of the signal, the convention of shells."""
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class LazyCommand(NamedTuple):
    """A command that is not imported yet."""

    module: str
    attribute: str
    summary: str


class LazyGroup(click.Group):
    """A group that imports a command only to run it, so that its help does not import JAX and SciPy."""

    def __init__(
        self, *args: Any, lazy_commands: Mapping[str, LazyCommand], **options: Any
    ) -> None:
        super().__init__(*args, **options)
        self.lazy_commands = dict(lazy_commands)

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted(self.lazy_commands)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        lazy = self.lazy_commands.get(cmd_name)
        return lazy and getattr(import_module(lazy.module), lazy.attribute)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(
                [(name, lazy.summary) for name, lazy in sorted(self.lazy_commands.items())]
            )

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        names = [
            CompletionItem(name, help=lazy.summary)
            for name, lazy in sorted(self.lazy_commands.items())
            if name.startswith(incomplete)
        ]
        return names + click.Command.shell_complete(self, ctx, incomplete)

    def invoke(self, ctx: click.Context) -> Any:
        # XLA logs kilobytes for each program that it reads from the cache; failures come as exceptions. It
        # reads this when it is imported, with the command.
        os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
        try:
            return super().invoke(ctx)
        except JaxekfError as error:
            raise click.ClickException(str(error)) from error
        except BrokenPipeError:
            raise  # The reader of the pipe has closed it: click ends without a message.
        except OSError as error:
            raise click.ClickException(_system_message(error)) from error
        except MemoryError as error:
            raise click.ClickException(
                f"got too little memory ({str(error) or 'out of memory'}), expected enough for all"
                " runs; pass fewer or shorter runs at once"
            ) from error
        except KeyboardInterrupt:
            click.echo(_interrupted(ctx.meta.get(WRITTEN, [])), err=True)
            raise click.exceptions.Exit(_SIGINT_STATUS) from None


def _system_message(error: OSError) -> str:
    """One sentence on an error of the operating system."""
    reason = error.strerror or " ".join(str(error).split())
    place = f"{error.filename or 'output'}: got '{reason}', expected"
    if error.errno in _FULL:
        return f"{place} free space; free some or name an output on another disk"
    return f"{place} to read or write there; check the path and its permissions"


def _interrupted(written: list[Path]) -> str:
    """The message of an interrupted command, with the outputs it has finished."""
    if not written:
        return "interrupted: nothing was written"
    more = f" and {len(written) - 3} more" if len(written) > 3 else ""
    shown = ", ".join(map(str, written[:3]))
    return f"interrupted: {shown}{more} {'was' if len(written) == 1 else 'were'} finished and kept"
