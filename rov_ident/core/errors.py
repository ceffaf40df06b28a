"""Exceptions for errors that the user can correct."""

from collections.abc import Mapping
from typing import Any

_LONGEST = 2000  # characters


class UserError(Exception):
    """Wrong use or unusable input: the message is one sentence naming the thing and the change.

    The command line turns it into exit status 2; bad data *in a stream* never raises it.
    """

    def __str__(self) -> str:
        sentence = super().__str__()  # which may quote a file: its middle goes beyond a screen
        if len(sentence) <= _LONGEST:
            return sentence
        return f"{sentence[: _LONGEST - 505]} ... {sentence[-500:]}"


def refuse_ignored(given: Mapping[str, bool], what: str) -> None:
    """Refuse options without a meaning with ``what``, by their names and whether they are given.

    Raises UserError.
    """
    for name, is_given in given.items():
        if is_given:
            raise UserError(f"{name} has no meaning with {what}: leave it out")


def require(kind: Any, words: str, /, **arguments: Any) -> None:
    """Refuse arguments of a program, given by their names, that are not of a ``kind`` (a class, or
    several: ``str | None``), which is called ``words``.

    Raises UserError.
    """
    for name, value in arguments.items():
        if not isinstance(value, kind):
            raise UserError(f"{name} is {value!r}, but must be {words}")
