"""What every identification gives, whatever its method: named numbers, their covariance, and from
which data they come; and what every result of a command can do: table, picture, file, JSON."""

import json
import math
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from rov_ident.core.errors import UserError, require
from rov_ident.core.files import write_file
from rov_ident.core.messages import Array
from rov_ident.reports.table import PLUS_MINUS, Table, Tables, estimate

if TYPE_CHECKING:
    import matplotlib.figure

Figure: TypeAlias = "matplotlib.figure.Figure"
NORMAL = 1.959963984540054  # half of a 95 % interval, in standard deviations


class Shown(ABC):
    """A result that shows itself; in a notebook as the last value of a cell.

    ``str(result)`` is its table.
    """

    notes: tuple[str, ...] = ()  # what was refused or is doubtful, in words

    @property
    @abstractmethod
    def sentence(self) -> str:
        """The whole result in a sentence or two."""

    @abstractmethod
    def table(self) -> Table | Tables:
        """The result as a table of text: print it."""

    @abstractmethod
    def plot(self) -> Figure:
        """The result as a picture, a figure of matplotlib that is not registered with pyplot."""

    @abstractmethod
    def to_json(self) -> str:
        """The result for machines; numbers that do not exist are null."""

    def page(self) -> str:
        """The result as a self-contained HTML document."""
        from rov_ident.reports import html, plots

        sections = [self.table().html(), html.figure(plots.to_svg(self.plot()), "")]
        sections += [html.bullets(self.notes)] if self.notes else []
        made = f"rov_ident {version('rov_ident')}"
        return html.page(type(self).__name__, self.sentence, sections, made)

    def save(self, path: str | Path) -> None:
        """Write the result to ``path``: what is written follows from the ending.

        Every result: ``.json`` (:meth:`to_json`), ``.html`` (:meth:`page`) and ``.png``, ``.svg``
        or ``.pdf`` (:meth:`plot`). A Fit and an Explanation also: ``.yaml``, the configuration with
        what was found; an Explanation: a path without ending, the folder that the command
        ``explain`` writes; a Simulation and a Proposal: ``.mcap``, the messages. Folders are made;
        a file that is there is replaced.

        Parameters
        ----------
        path
            The file to write.

        Raises
        ------
        UserError
            If the ending is none of these, or the file cannot be written.
        """
        require(str | os.PathLike, "a path", path=path)
        path = Path(path)
        writers = self._writers()
        if path.suffix not in writers:
            raise UserError(
                f"{path}: this result is saved as {', '.join(e or 'a folder' for e in writers)}"
            )
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            writers[path.suffix](path)
        except OSError as error:
            raise UserError(f"{path} cannot be written: {error.strerror}") from error

    def _writers(self) -> dict[str, Callable[[Path], None]]:
        """What writes the result, by the ending of the file."""
        return {
            ".json": lambda path: write_file(path, self.to_json()),
            ".html": lambda path: write_file(path, self.page()),
            **dict.fromkeys((".png", ".svg", ".pdf"), self._write_plot),
        }

    def _write_plot(self, path: Path) -> None:
        buffer = BytesIO()
        self.plot().savefig(buffer, format=path.suffix[1:], dpi=110)
        write_file(path, buffer.getvalue())

    def __str__(self) -> str:
        return str(self.table())

    def _repr_html_(self) -> str:
        from rov_ident.reports import html, plots

        picture = html.figure(plots.to_svg(self.plot(), f"id{id(self):x}-"), "")
        table = self.table()
        return html.fragment([html.paragraph(self.sentence), table.html(), picture])


@dataclass(frozen=True, kw_only=True)
class Result:
    """Arrays are (n,) in the order of ``names``, covariance (n, n).

    ``quantile``: half of the 95 % interval in standard deviations, more than NORMAL where few data
    left few degrees of freedom.
    """

    estimator: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    covariance: Array
    provenance: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    quantile: float = NORMAL

    @property
    def std(self) -> Array:
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def lower(self) -> Array:
        return self.values - self.quantile * self.std

    @property
    def upper(self) -> Array:
        return self.values + self.quantile * self.std

    def value(self, name: str) -> float:
        """One number by its name. Raises UserError if the result has none of that name."""
        if name not in self.names:
            raise UserError(f"there is no {name!r} in this result: use {', '.join(self.names)}")
        return float(self.values[self.names.index(name)])

    def entries(self) -> dict[str, dict[str, Any]]:
        """Each number with its standard deviation, unit and 95 % interval, for JSON."""
        columns = (self.values, self.std, self.lower, self.upper)
        rows = zip(*(c.tolist() for c in columns), strict=True)
        return {
            name: {"value": value, "std": std, "unit": unit, "lower": lower, "upper": upper}
            for name, unit, (value, std, lower, upper) in zip(
                self.names, self.units, rows, strict=True
            )
        }

    def numbers(self, title: str, more: Mapping[str, Iterable[str]] | None = None) -> Table:
        """The numbers with half of their 95 % intervals; ``more``: further columns of text (n,)."""
        more = more or {}
        pairs = zip(self.values.tolist(), (self.quantile * self.std).tolist(), strict=True)
        columns = zip(self.names, map(list, (estimate(*p) for p in pairs)), self.units)
        rows = [[name, *pair, unit] for name, pair, unit in columns]
        for column in more.values():
            rows = [[*row, cell] for row, cell in zip(rows, column, strict=True)]
        return Table(title, ["", "value", PLUS_MINUS, "unit", *more], rows, text=(3, 3 + len(more)))


def as_json(document: Mapping[str, Any]) -> str:
    """A result as text for machines; what is infinite is null. Raises ValueError for NaN."""
    return json.dumps(_without_infinity(document), indent=2, allow_nan=False) + "\n"


def _without_infinity(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _without_infinity(x) for key, x in value.items()}
    if isinstance(value, list | tuple):
        return [_without_infinity(x) for x in value]
    return None if isinstance(value, float) and math.isinf(value) else value


def provenance(files: Iterable[tuple[str, str]], **more: str) -> dict[str, Any]:
    """Of a result: the version, and every (file, sha256) it is from."""
    bags = [{"file": name, "sha256": sha256} for name, sha256 in files]
    return {"version": version("rov_ident"), **more, "bags": bags}
