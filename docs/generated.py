"""Pages that are made from the code when the site is built: so they cannot contradict it."""

import argparse
import importlib
import inspect
import math
import re
from collections.abc import Iterator
from typing import Any

from mkdocs.structure.files import File, Files

import rov_ident as ri
from rov_ident.cli import program as cli
from rov_ident.config import schema
from rov_ident.effects import EFFECTS
from rov_ident.effects.base import Effect
from rov_ident.model.coefficients import catalogue, input_catalogue

_HOOKS = {
    "coefficients": "adds coefficients to the equations of motion",
    "body": "changes the rigid body",
    "wrench": "adds a wrench along the motion",
    "water": "moves the water",
    "act": "stands between the commanded and the acting wrench",
    "sense": "stands between the motion and what is measured",
    "late": "delays the velocities that are measured",
    "heading": "turns the heading that is measured",
    "steer": "stands between the commanded angles of fins and those that act",
    "noise": "adds noise to the reading of the wrench",
}


def on_files(files: Files, config: Any) -> Files:
    """mkdocs calls this once it has found the written pages."""
    for name, text in pages().items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Links to files of the repository, which a reader of the site has not: named, not followed."""
    if "/" in page.file.src_uri:
        return markdown
    return re.sub(r"\[[^\]]*\]\(\.\./([^)#]+)[^)]*\)", r"`\1`", markdown)


def pages() -> dict[str, str]:
    """Every generated page: its place and its Markdown."""
    made = {
        "reference/python.md": python(),
        "reference/commands.md": commands(),
        "reference/parameters.md": parameters(),
        "reference/coefficients.md": coefficients(),
        "effects/index.md": effects(),
    }
    return made | {f"effects/{name}.md": effect(e) for name, e in EFFECTS.items()}


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(_cell(c) for c in line)} |" for line in lines) + "\n"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


# ------------------------------------------------------------------ Python


def python() -> str:
    """Every public function and class, from its own docstring."""
    parts = [
        "# Python\n",
        "`import rov_ident as ri`. What stands here is public; [the guide](../python.md) says what "
        "it is for.\n",
    ]
    public = {name: getattr(ri, name) for name in sorted(ri.__all__, key=str.lower)}
    for name, function in public.items():
        if inspect.isfunction(function):
            parts += [f"## {name}\n", _signature(name, function), _documented(function)]
    for name, kind in public.items():
        if not inspect.isclass(kind):
            continue
        parts += [f"## {name}\n", _documented(kind)]
        own = [c for c in reversed(kind.__mro__) if c.__module__.startswith("rov_ident")]
        members = {n: m for c in own for n, m in vars(c).items() if not n.startswith("_")}
        for member, value in members.items():
            if inspect.isfunction(value) and value.__doc__:
                parts += [f"### {name}.{member}\n", _signature(member, value), _documented(value)]
        rows = [
            [f"`{n}`", inspect.cleandoc(m.__doc__).replace("\n", " ")]
            for n, m in members.items()
            if isinstance(m, property) and m.__doc__
        ]
        parts += [_table(["attribute", ""], rows)] if rows else []
    effects = ", ".join(f"[{name}](../effects/{name}.md)" for name in ri.EFFECTS)
    parts += ["## EFFECTS\n", f"What a simulation may lack, by name: {effects}.\n"]
    return "\n".join(parts)


def _signature(name: str, function: Any) -> str:
    parameters = inspect.signature(function).parameters.values()
    bare = [p.replace(annotation=inspect.Parameter.empty) for p in parameters if p.name != "self"]
    return f"```python\n{name}{inspect.Signature(bare)}\n```\n"


def _documented(thing: Any) -> str:
    """A docstring, whose sections of parameters, results and errors become tables."""
    text, *sections = re.split(r"\n(?=\w+\n-{3,}\n)", inspect.cleandoc(thing.__doc__))
    parts = [_paragraphs(text.strip())]
    for section in sections:
        title, _, *lines = section.splitlines()
        rows: list[list[str]] = []
        for line in filter(None, lines):
            if line.startswith(" "):
                rows[-1][1] = f"{rows[-1][1]} {line.strip()}".strip().replace("``", "`")
            else:
                rows.append([f"`{line}`", ""])
        parts.append(_table([title.lower(), ""], rows))
    return "\n".join(parts)


# ------------------------------------------------------------------ commands


def commands() -> str:
    parts = [
        "# Commands\n",
        "`rov-ident COMMAND --help` says the same. Standard output carries the result, standard "
        "error progress and messages. Exit status: 0 done, 2 you can mend it (one sentence says "
        "what to change), 1 a fault of ours.\n",
        'Completion: `eval "$(rov-ident completion bash)"` in `~/.bashrc`; for zsh write the '
        "output of `rov-ident completion zsh` to a file `_rov-ident` in a folder of `$fpath`.\n",
    ]
    parser = cli._parser()
    for name, command in cli._commands(parser).items():
        summary = _summaries(parser)[name]
        usage = command.format_usage().removeprefix("usage: ").strip()
        parts += [
            f"## {name}\n",
            f"{summary[:1].upper()}{summary[1:]}.\n",
            f"```text\n{usage}\n```\n",
        ]
        rows = [list(row) for row in _arguments(command)]
        parts.append(_table(["argument", ""], rows))
    return "\n".join(parts)


def _summaries(parser: argparse.ArgumentParser) -> dict[str, str]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            return {choice.dest: choice.help or "" for choice in action._choices_actions}
    return {}


def _arguments(command: argparse.ArgumentParser) -> Iterator[tuple[str, str]]:
    for action in command._actions:
        if isinstance(action, argparse._HelpAction):
            continue
        name = ", ".join(action.option_strings) or str(action.metavar or action.dest)
        value = "" if action.nargs == 0 or not action.option_strings else action.metavar
        if value is None:
            value = action.dest.upper()
        if action.choices and action.option_strings:
            value = "\\|".join(map(str, action.choices))
        must = " (required)" if action.required and action.option_strings else ""
        yield f"`{name}{f' {value}' if value else ''}`".replace("\\|", "|"), f"{action.help}{must}"


# ------------------------------------------------------------------ parameters


def parameters() -> str:
    parts = [
        "# Parameters\n",
        "One ROS 2 parameter file serves nodes and commands. `vehicle` and `coefficients` are "
        "required, all else has a default. *live*: may be changed while a node runs "
        "(`ros2 param set`). An unknown key, a wrong type or a value out of its range is refused "
        "in one sentence that names it.\n",
    ]
    sections: dict[str, list[list[str]]] = {}
    for p in schema.VEHICLE_PARAMETERS + schema.PARAMETERS:
        section = p.key.rpartition(".")[0]
        sections.setdefault(section, []).append(
            [f"`{p.key}`", _kind(p), _default(p), p.unit, _range(p), p.description]
        )
    for section, rows in sections.items():
        parts.append(f"## {section or 'others'}\n")
        parts.append(_table(["key", "type", "default", "unit", "range", ""], rows))
    parts += [
        "## coefficients\n",
        "Any name of [the list](coefficients.md); a name left out is not in the model.\n",
        "## prior.std\n",
        "`prior.std.NAME`: standard deviation of a single coefficient before any data, in its "
        "unit; overrides `prior.relative_std`.\n",
        "## effects\n",
        "`effects.EFFECT.PARAMETER`: see [effects](../effects/index.md); what is left out is at "
        "the value where the effect vanishes.\n",
    ]
    return "\n".join(parts)


def _kind(p: schema.Parameter) -> str:
    if p.choices:
        return "text"
    if p.type is schema.Vector:
        return "numbers" if p.size == schema.ANY else f"{p.size} numbers"
    kinds = {
        bool: "true or false", float: "number", int: "whole number",
        str: "text", schema.Names: "names",
    }  # fmt: skip
    return kinds[p.type]


def _default(p: schema.Parameter) -> str:
    if p.required:
        return "required"
    if p.default is None:
        return "computed"
    if isinstance(p.default, tuple):
        return str(list(p.default)) if p.default else "empty"
    if isinstance(p.default, bool):
        return f"`{p.default}`".lower()
    return f"`{p.default}`" if p.default != "" else "empty"


def _range(p: schema.Parameter) -> str:
    live = "; live" if p.live else ""
    if p.choices:
        return ", ".join(f"`{c}`" for c in p.choices if c) + live
    low, high = p.lower, p.upper
    if p.type not in (float, int, schema.Vector) or (math.isinf(low) and math.isinf(high)):
        return live.removeprefix("; ")
    if low == schema.POSITIVE and math.isinf(high):
        return f"above 0{live}"
    low_text = "0 (not itself)" if low == schema.POSITIVE else f"{low:g}"
    if math.isinf(high):
        return f"from {low_text}{live}"
    return f"{low_text} to {high:g}{live}"


# ------------------------------------------------------------------ coefficients and effects


def coefficients() -> str:
    rows = [[f"`{c.name}`", c.unit, c.meaning] for c in (*catalogue(), *input_catalogue())]
    return (
        "# Coefficients\n\nSNAME derivatives with their usual signs: `M = M_RB - diag(X_udot, "
        "...)`, damping force `X_u u + X_uu |u|u`, negative for a hull that dissipates. A name is "
        "a place in the equations ([the model](../model.md)), so any name of the grammar works "
        "everywhere.\n\n" + _table(["name", "unit", "meaning"], rows)
    )


def effects() -> str:
    rows = [
        [f"[{name}]({name}.md)", e.place, e.summary]
        for name, e in sorted(EFFECTS.items(), key=lambda item: (item[1].place, item[0]))
    ]
    return (
        "# Effects\n\nWhat a simulation may lack. Each is one file in `rov_ident/effects/`; "
        "simulator, estimators and [the search](../explain.md) find it by being there. The pages "
        "are made from these files.\n\n" + _table(["effect", "enters at", ""], rows)
    )


def effect(e: Effect) -> str:
    module = importlib.import_module(f"rov_ident.effects.{e.name}")
    text = inspect.cleandoc(module.__doc__ or e.summary)
    hook = next(name for name in _HOOKS if getattr(e, name))
    parts = [
        f"# {e.name.replace('_', ' ').capitalize()}\n",
        f"{e.summary} It {_HOOKS[hook]}.\n",
        _paragraphs(text),
    ]
    if e.coefficients:
        parts.append("Coefficients: " + ", ".join(f"`{c}`" for c in e.coefficients) + ".\n")
    if e.parameters:
        rows = [
            [f"`{p.name}`", p.unit, f"{p.null:g}", f"{p.lower:g} to {p.upper:g}", f"{p.typical:g}",
             p.role, p.meaning]
            for p in e.parameters
        ]  # fmt: skip
        parts.append("## Parameters\n")
        parts.append(f"Keys `effects.{e.name}.NAME`. At `vanishes` it does nothing.\n")
        head = ["name", "unit", "vanishes", "bounds", "typical", "role", ""]
        parts.append(_table(head, rows))
    parts += ["## Shown by\n", f"{e.manoeuvre[:1].upper()}{e.manoeuvre[1:]}.\n"]
    functions = [name for name in ("body", "wrench", "water", "act", "sense") if getattr(e, name)]
    if functions:
        code = "\n\n".join(_source(getattr(e, name)) for name in functions)
        parts += ["## The equation, as it runs\n", f"```python\n{code}\n```\n"]
    else:
        parts += [
            "## The equation\n",
            "In [the model](../model.md), under the coefficients' names.\n",
        ]
    parts += ["## Source\n", f"{e.source}.\n"]
    return "\n".join(parts)


def _source(function: Any) -> str:
    """The text of a hook, also where it is compiled."""
    return inspect.getsource(getattr(function, "py_func", function)).rstrip()


def _paragraphs(text: str) -> str:
    """A docstring as Markdown: literals of one backquote, indented lines as code."""
    blocks = []
    for block in text.split("\n\n"):
        if block.startswith("    "):
            blocks.append(f"```text\n{inspect.cleandoc(block)}\n```")
        else:
            blocks.append(block.replace("``", "`").replace("::", ":"))
    return "\n\n".join(blocks) + "\n"
