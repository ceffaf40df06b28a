"""The command ``rov-ident``: standard output carries results, standard error everything else.

Exit status: 0 done, 2 the user can mend it, 1 a fault of ours, 130 and 143 interrupted.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

from rov_ident.cli.common import OUTPUTS, check_paths, command, say
from rov_ident.core.errors import UserError
from rov_ident.core.interrupts import raise_interrupts

# The files of this room that hold commands, in the order of --help.
COMMANDS = (
    "demo init identify replay fit check plan explain compare simulate import_log models nomoto "
    "forces coast_down steer live coefficients"
).split()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; the exit status."""
    name = "rov-ident"
    try:
        options = _parser().parse_args(arguments)
        name += f" {options.command}"
        if arguments is None:
            raise_interrupts()
        check_paths(options)
        options.run(options)
        sys.stdout.flush()
        written = (getattr(options, name, None) for name in OUTPUTS)
        if paths := [str(path) for path in written if isinstance(path, Path) and path.exists()]:
            say(f"written: {', '.join(paths)}")
    except UserError as error:
        say(f"{name}: {error}")
        return 2
    except BrokenPipeError:
        # Whoever read our output has seen enough (`rov-ident coefficients | head`); what Python
        # still holds of it goes nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt as interrupt:
        say("interrupted")
        return getattr(interrupt, "status", 130)
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
    completion.add_argument("shell", choices=("bash", "zsh", "tcsh", "fish"), help="which shell")
    for each in commands.choices.values():
        each.add_argument("--quiet", action="store_true", help="no progress on standard error")
    return parser


def _completion(options: argparse.Namespace) -> None:
    parser = _parser()
    try:
        import shtab
    except ImportError as error:
        raise UserError("completion needs shtab: pip install shtab") from error
    if options.shell not in shtab.SUPPORTED_SHELLS:
        raise UserError(f"this shtab is too old for {options.shell}: pip install --upgrade shtab")
    for each in (parser, *_commands(parser).values()):
        for action in each._actions:  # shtab, too, goes through them
            if action.type is Path:
                action.complete = shtab.FILE  # type: ignore[attr-defined]
    print(shtab.complete(parser, options.shell))


def _commands(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """The parser of every command, by name."""
    subparsers = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    return dict(next(subparsers).choices)
