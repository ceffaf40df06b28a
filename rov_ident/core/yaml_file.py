"""YAML as ROS reads and writes it: the only module that reads any.

What is read is plain data of a sensible size: mappings, lists, text, numbers, true, false and null.
The parameter files of ROS 2 know no more.
"""

import re
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml

from rov_ident.core.errors import UserError
from rov_ident.core.files import read_input

LARGEST_FILE = 1 << 20
"""Bytes. The longest configuration has a hundredth of it; the metadata of a bag of a thousand files
a quarter. Reading that much takes some ten seconds."""

_DEEPEST = 32
"""Levels: a configuration and a bag's metadata have six; Python's own stack ends at some 200."""

_LARGEST_NUMBER = 1 << 64  # ROS has no larger whole number

_PLAIN = {f"tag:yaml.org,2002:{kind}" for kind in "null bool int float str seq map".split()}


class _Loader(yaml.SafeLoader):
    """Plain data alone; `1e-3` is a number; a key given twice is refused."""

    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        event = self.peek_event()
        if isinstance(event, yaml.AliasEvent) or event.anchor is not None:
            raise _refused("there is an anchor (&) or alias (*): write the value out", event)
        if event.tag not in (None, "!"):
            raise _refused(f"there is a tag, {event.tag}: leave it out", event)
        if self.depth >= _DEEPEST:
            raise _refused(f"the value is nested deeper than {_DEEPEST} levels", event)
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        if node.tag == "tag:yaml.org,2002:timestamp":
            raise _refused("there is a date: put it in quotes", node)
        if node.tag not in _PLAIN:
            raise _refused(f"{node.value} has a meaning of its own: put it in quotes", node)
        if isinstance(node, yaml.ScalarNode) and len(node.value) > 100 and node.tag.endswith("int"):
            raise _refused("there is a number of more than 100 digits", node)
        value = super().construct_object(node, deep)
        if isinstance(value, int) and abs(value) > _LARGEST_NUMBER:
            raise _refused("there is a whole number beyond 64 bits", node)
        return value

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise _refused("a key is a list or a section", key)
            if key.value in seen:
                raise _refused(f"the key {key.value} is given twice", key)
            seen.add(key.value)
        return super().construct_mapping(node, deep)

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Nothing: the key `<<`, which would merge mappings, is of no plain kind."""


class Dumper(yaml.SafeDumper):
    """Sections in block style, lists on one line."""


for _yaml in (_Loader, Dumper):  # the dumper, to quote text that looks like such a number
    _yaml.add_implicit_resolver(
        "tag:yaml.org,2002:float",
        re.compile(r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$"),
        list("-+.0123456789"),
    )
Dumper.add_representer(
    list, lambda dumper, items: dumper.represent_sequence("tag:yaml.org,2002:seq", items, True)
)


def parse(text: str) -> Any:
    """The plain data that a YAML text holds.

    Raises UserError: half a sentence, to be put behind the name of the file.
    """
    try:
        return yaml.load(text, _Loader)  # nosec B506
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" at line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        what = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise UserError(f"is not valid YAML{where}: {what}") from error
    except ValueError as error:  # `0x_` looks like a number
        raise UserError(f"is not valid YAML: {error}") from error


def parse_file(path: Path) -> Any:
    """The data in a YAML file in UTF-8; raises UserError alike."""
    try:
        return parse(read_input(path, LARGEST_FILE).decode())
    except OSError as error:
        raise UserError(f"cannot be read, {error.strerror}: give a YAML file") from error
    except UnicodeDecodeError as error:
        raise UserError("is not a text file: give a YAML file") from error


def _refused(why: str, at: Any) -> yaml.YAMLError:
    return yaml.constructor.ConstructorError(problem=why, problem_mark=at.start_mark)
