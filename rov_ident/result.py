"""What every identification gives, whatever its method: named numbers, their covariance, and from
which data they come. Tables, pages and JSON are functions of it."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any

import numpy as np

from rov_ident.messages import Array

NORMAL = 1.959964  # half of a 95 % interval, in standard deviations


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


def provenance(files: Iterable[tuple[str, str]], **more: str) -> dict[str, Any]:
    """Of a result: the version, and every (file, sha256) it is from."""
    bags = [{"file": name, "sha256": sha256} for name, sha256 in files]
    return {"version": version("rov_ident"), **more, "bags": bags}
