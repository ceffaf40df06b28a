"""Values, expectations and suggestions in the sentences that refuse a configuration."""

import difflib
from collections.abc import Iterable, Mapping
from typing import Any

from rov_ident.config.schema import ANY, Names, Parameter, Vector


def shown(value: Any) -> str:
    """A value as the user wrote it, and what it was read as."""
    if value is None:
        return "empty"
    if isinstance(value, Mapping):
        return "a section of keys"
    kinds = {bool: "true or false", str: "text", int: "a number", float: "a number"}
    text = repr(value)
    text = text if len(text) <= 60 else f"{text[:57]}..."
    return f"{text} ({kinds.get(type(value), 'a list')})"


def expected(parameter: Parameter) -> str:
    if parameter.choices:
        return "one of " + ", ".join(parameter.choices)
    count = "" if parameter.size == ANY else f"{parameter.size} "
    words = {float: "a number", int: "a whole number", bool: "true or false", str: "text"}
    words |= {Names: "a list of names", Vector: f"a list of {count}numbers"}
    return words[parameter.type] + (f" ({parameter.unit})" if parameter.unit else "")


def suggestion(name: Any, known: Iterable[str]) -> str:
    known = list(known)
    close = difflib.get_close_matches(str(name), known, 1)
    return f"did you mean {close[0]}?" if close else f"use one of {', '.join(known)}"
