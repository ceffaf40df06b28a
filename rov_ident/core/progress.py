"""The interface by which long computations report their progress."""

from typing import Protocol


class Progress(Protocol):
    """Called now and then with what is being done, and the share of it that is, where known."""

    def __call__(self, what: str, share: float | None = None) -> None: ...


def silent(what: str, share: float | None = None) -> None:
    """Tells nobody."""
