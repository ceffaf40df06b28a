"""Tables of text, for a terminal, a page and a notebook; numbers written as their digits allow."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from io import StringIO
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, Group, RenderResult
    from rich.table import Table as RichTable

PLUS_MINUS = "± 95 %"
"""The heading of half-widths of 95 % intervals: the one meaning of ± in this package."""


@dataclass(frozen=True)
class Table:
    """Cells of text: ``head`` (n,), ``rows`` (k, n).

    The first column and those numbered in ``text`` are left-aligned. Print it, or let a notebook
    show it.
    """

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    text: Sequence[int] = ()

    def __rich_console__(self, console: "Console", options: "ConsoleOptions") -> "RenderResult":
        yield fitting((self._rich(), self._rich(narrow=True)), console, options.max_width)

    def _rich(self, narrow: bool = False) -> "RichTable":
        """``narrow``: without units and without a frame."""
        from rich.table import Table as RichTable
        from rich.text import Text

        columns = [i for i, name in enumerate(self.head) if not (narrow and name == "unit")]
        title = self.title if len(columns) == len(self.head) else f"{self.title} [SI units]"
        frame = not narrow
        table = RichTable(title=Text(title), title_justify="left", show_edge=frame, pad_edge=frame)
        for i in columns:
            justify: Literal["left", "right"] = "left" if i == 0 or i in self.text else "right"
            # in a narrow terminal the widest columns are folded first, and nothing is cut
            table.add_column(Text(self.head[i]), justify=justify, overflow="fold")
        for row in self.rows:
            table.add_row(*(Text(row[i]) for i in columns))
        return table

    def __str__(self) -> str:
        from rich.console import Console

        # As wide as the table needs, without colour or escapes.
        console = Console(file=StringIO(), width=1000, color_system=None, force_terminal=False)
        with console.capture() as captured:
            console.print(self)
        return "\n".join(line.rstrip() for line in captured.get().splitlines())

    def html(self) -> str:
        """An HTML table without the title."""
        start = ["<t{} class='text'>" if i in self.text else "<t{}>" for i in range(len(self.head))]
        top = "".join(s.format("h") + escape(c) + "</th>" for s, c in zip(start, self.head))
        body = "".join(
            "<tr>"
            + "".join(s.format("d") + escape(c) + "</td>" for s, c in zip(start, row))
            + "</tr>"
            for row in self.rows
        )
        inside = f"<thead><tr>{top}</tr></thead><tbody>{body}</tbody>"
        return f"<div class='scroll'><table>{inside}</table></div>"

    def _repr_html_(self) -> str:
        from rov_ident.reports.html import fragment, heading

        return fragment([heading(self.title), self.html()])


@dataclass(frozen=True)
class Tables:
    """Several tables, one below the other."""

    parts: tuple[Table, ...]

    def __rich__(self) -> "Group":
        from rich.console import Group

        return Group(*self.parts)

    def __str__(self) -> str:
        return "\n".join(map(str, self.parts))

    def html(self) -> str:
        from rov_ident.reports.html import heading

        return "".join(heading(part.title) + part.html() for part in self.parts)

    def _repr_html_(self) -> str:
        from rov_ident.reports.html import fragment

        return fragment([self.html()])


def fitting(tables: "Iterable[RichTable]", console: "Console", width: int) -> "RichTable":
    """The first table of which ``width`` characters need no column folded, or the last."""
    from rich.measure import Measurement

    unbound = console.options.update_width(10_000)
    for table in tables:
        if Measurement.get(console, unbound, table).maximum <= width:
            break
    return table


def number(x: float, digits: int = 3) -> str:
    """With so many significant digits, without an exponent where that can be read."""
    if not math.isfinite(x):
        return "-"
    if x == 0.0:
        return "0"
    decimals = digits - 1 - math.floor(math.log10(abs(x)))
    if decimals > 7:
        return f"{x:.{digits - 1}e}"
    return f"{round(x, decimals):.{max(decimals, 0)}f}"


def with_unit(number: str, unit: str) -> str:
    return number if unit == "1" else f"{number} {unit}"


def estimate(value: float, doubt: float) -> tuple[str, str]:
    """A value with the digits that its doubt leaves, and the doubt: a standard deviation, or half
    of an interval."""
    if not (math.isfinite(doubt) and doubt > 0.0):
        return number(value, 4), "-"
    decimals = 1 - math.floor(math.log10(doubt))
    return f"{round(value, decimals):.{min(max(decimals, 0), 9)}f}", number(doubt, 2)
