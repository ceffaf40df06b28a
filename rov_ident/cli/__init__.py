"""The program `rov-ident`: one file a command (or a few that belong together).

Arguments in, sentences and tables out. What a command needs beyond its arguments is imported when
it runs, so that `rov-ident --help` is there at once.
"""

from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; the exit status. Without ``arguments`` the process is the program's own."""
    from rov_ident.core.interrupts import end_at_once

    if arguments is None:
        end_at_once()  # before anything else is loaded
    from rov_ident.core.threads import limit_process

    limit_process()  # before numpy is loaded
    from rov_ident.cli.program import main as run

    status = run(arguments)
    if arguments is None:
        end_at_once(status)
    return status
