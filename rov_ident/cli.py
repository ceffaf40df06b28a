"""The command ``rov-ident``: standard output carries results, standard error everything else.

Exit status: 0 done, 2 the user can mend it, 1 a fault of ours.
"""

import argparse
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from rov_ident.commands import (
    check,
    coefficients,
    demo,
    explain,
    fit,
    forces,
    import_log,
    live,
    models,
    nomoto,
    plan,
    replay,
    simulate,
    steer,
)
from rov_ident.commands.common import ERR
from rov_ident.errors import UserError

# In the order of --help.
COMMANDS = (
    demo,
    replay,
    fit,
    check,
    plan,
    explain,
    simulate,
    import_log,
    models,
    nomoto,
    forces,
    steer,
    live,
    coefficients,
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; the exit status."""
    parser = _parser()
    options = parser.parse_args(arguments)
    try:
        options.run(options)
    except UserError as error:
        ERR.print(f"rov-ident {options.command}: {error}", markup=False, soft_wrap=True)
        return 2
    except BrokenPipeError:
        # Whoever read our output has seen enough (`rov-ident coefficients | head`).
        sys.stderr.close()
        return 0
    except KeyboardInterrupt:
        ERR.print("interrupted")
        return 130
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="rov-ident",
        description="Identify the hydrodynamic coefficients of underwater vehicles.",
    )
    parser.add_argument("--version", action="version", version=version("rov_ident"))
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for module in COMMANDS:
        module.add(commands)
    completion = commands.add_parser("completion", help="print a shell's completion script")
    completion.add_argument("shell", choices=("bash", "zsh", "tcsh"), help="which shell")
    completion.set_defaults(run=_completion)
    for command in commands.choices.values():
        command.add_argument("--quiet", action="store_true", help="no progress on standard error")
    return parser


def _completion(options: argparse.Namespace) -> None:
    try:
        import shtab
    except ImportError as error:
        raise UserError("completion needs shtab: pip install shtab") from error
    parser = _parser()
    for command in (parser, *_commands(parser).values()):
        for action in command._actions:  # shtab, too, goes through them
            if action.type is Path:
                action.complete = shtab.FILE  # type: ignore[attr-defined]
    print(shtab.complete(parser, options.shell))


def _commands(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """The parser of every command, by name."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            return dict(action.choices)
    return {}


if __name__ == "__main__":
    sys.exit(main())
