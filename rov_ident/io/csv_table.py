"""CSV tables by their headings, for the commands that read measurements rather than dives."""

import csv
import hashlib
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rov_ident.core.errors import UserError
from rov_ident.core.files import read_input
from rov_ident.core.messages import Array

_LARGEST = 1 << 30  # bytes: a day at 200 Hz


@dataclass(frozen=True)
class CsvTable:
    """Cells as text under their headings; ``lines`` (n,) are the rows' line numbers; ``sha256`` is
    of the file's bytes."""

    path: Path
    cells: Mapping[str, tuple[str, ...]]
    lines: tuple[int, ...]
    sha256: str

    def numbers(self, heading: str, blank: bool = False) -> Array:
        """A column (n,); with ``blank``, empty cells are NaN.

        Raises UserError: a cell that is not a finite number.
        """
        out = np.empty(len(self.lines))
        for i, text in enumerate(self.cells[heading]):
            if blank and (not text or text.lower() == "nan"):
                out[i] = np.nan
                continue
            try:
                out[i] = float(text)
            except ValueError:
                out[i] = np.nan
            if not np.isfinite(out[i]):
                raise UserError(
                    f"{self.path}, line {self.lines[i]}, column `{heading}`: `{text}` is not a "
                    "number; correct or remove the row"
                )
        return out


def read_csv(path: Path) -> CsvTable:
    """A file of comma-separated columns under one line of headings; `#` begins a comment.

    Where numbers follow at once, the last comment above them is the line of headings, as numpy
    writes it.

    Raises UserError if it cannot be read, or is no such file.
    """
    rows: list[list[str]] = []
    lines: list[int] = []
    header: list[str] = []
    comment: list[str] = []  # the last one above the headings
    try:
        data = read_input(path, _LARGEST)
        # utf-8-sig: spreadsheets begin their files with a byte order mark.
        text = io.StringIO(data.decode("utf-8-sig"), newline="")
        reader = csv.reader(text, skipinitialspace=True)
        for cells in reader:
            if not any(cell.strip() for cell in cells):
                continue
            cells = [cell.strip() for cell in cells]
            if cells[0].startswith("#"):
                comment = [cells[0].lstrip("# "), *cells[1:]] if not header else []
                continue
            if not header and len(comment) == len(cells) and all(map(_is_number, cells)):
                header = comment
            if not header:
                header = cells
                if len(cells) == 1 and (other := [c for c in ";\t " if c in cells[0]]):
                    raise UserError(
                        f"{path} separates its columns by {other[0]!r}: save it with commas, and "
                        "points in its numbers"
                    )
                continue
            if len(cells) != len(header):
                raise UserError(
                    f"{path}, line {reader.line_num}: {len(cells)} cells under {len(header)} "
                    "headings; correct or remove the row, and write numbers with points"
                )
            rows.append(cells)
            lines.append(reader.line_num)
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror}): check the path") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise UserError(
            f"{path} is not a CSV text file in UTF-8 ({error}): save it as one"
        ) from error
    if not rows:
        raise UserError(f"{path} has no rows below its headings: give a CSV table with data")
    if twice := {name for name in header if name and header.count(name) > 1}:
        raise UserError(f"{path} has two columns `{min(twice)}`: rename one of them")
    columns = {name: tuple(row[i] for row in rows) for i, name in enumerate(header) if name}
    return CsvTable(path, columns, tuple(lines), hashlib.sha256(data).hexdigest())


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
