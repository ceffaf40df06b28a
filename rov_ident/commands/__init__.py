"""One file a command (or a few that belong together): its arguments, and what it does.

What a command needs beyond numpy is imported when it runs: `rov-ident --help` is there at once.
"""
