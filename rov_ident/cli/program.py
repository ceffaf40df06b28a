"""The command ``rov-ident``: standard output carries results, standard error everything else.

Exit status: 0 done, 2 the user can mend it, 1 a fault of ours.
"""

import argparse
import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

from rov_ident.cli.common import command, say
from rov_ident.core.errors import UserError

# The files of this room that hold commands, in the order of --help.
COMMANDS = (
    "demo init identify replay fit check plan explain compare simulate import_log models nomoto "
    "forces coast_down steer live coefficients"
).split()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; the exit status."""
    parser = _parser()
    options = parser.parse_args(arguments)
    try:
        options.run(options)
    except UserError as error:
        say(f"rov-ident {options.command}: {error}")
        return 2
    except BrokenPipeError:
        # Whoever read our output has seen enough (`rov-ident coefficients | head`).
        sys.stderr.close()
        return 0
    except KeyboardInterrupt:
        say("interrupted")
        return 130
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="rov-ident",
        description="Identify the hydrodynamic coefficients of underwater vehicles.",
    )
    parser.add_argument("--version", action="version", version=version("rov_ident"))
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name in COMMANDS:
        import_module(f"rov_ident.cli.{name}").add(commands)
    completion = command(commands, "completion", "print a shell's completion script", _completion)
    completion.add_argument("shell", choices=("bash", "zsh", "tcsh"), help="which shell")
    for each in commands.choices.values():
        each.add_argument("--quiet", action="store_true", help="no progress on standard error")
    return parser


def _completion(options: argparse.Namespace) -> None:
    try:
        import shtab
    except ImportError as error:
        raise UserError("completion needs shtab: pip install shtab") from error
    parser = _parser()
    for each in (parser, *_commands(parser).values()):
        for action in each._actions:  # shtab, too, goes through them
            if action.type is Path:
                action.complete = shtab.FILE  # type: ignore[attr-defined]
    print(shtab.complete(parser, options.shell))


def _commands(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """The parser of every command, by name."""
    subparsers = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    return dict(next(subparsers).choices)
