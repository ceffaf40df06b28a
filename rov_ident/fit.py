"""Offline fits, all with one type of result."""

import contextlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rov_ident import inputs
from rov_ident.bags import Bag
from rov_ident.config import Config
from rov_ident.effects import compiled
from rov_ident.errors import UserError
from rov_ident.messages import Array
from rov_ident.model import Model
from rov_ident.online import ESTIMATORS, Kind, OnlineEstimator
from rov_ident.records import HORIZON, Record, numbers, score
from rov_ident.result import Result, provenance
from rov_ident.samples import Sampler
from rov_ident.warm import warm_up

IDENTIFIABLE = 0.75  # share of the prior's variance that the data must have removed


@dataclass(frozen=True, kw_only=True)
class Fit(Result):
    """Coefficients identified from dives.

    ``identifiable`` (n,) tells where the data and not the prior made the value; ``rmse`` (6,) is of
    open-loop windows of HORIZON seconds.
    """

    identifiable: tuple[bool, ...]
    model: Model
    samples: int
    duration: float
    rmse: Array
    more: dict[str, Any] = field(default_factory=dict)
    """Further parts of the JSON that only some estimators have."""

    def to_json(self) -> str:
        """The machine-readable result; numbers that do not exist are null."""
        coefficients = self.entries()
        for entry, identifiable in zip(coefficients.values(), self.identifiable, strict=True):
            entry["identifiable"] = identifiable
        result = {
            "estimator": self.estimator,
            "coefficients": coefficients,
            "samples": self.samples,
            "duration_s": self.duration,
            "open_loop": {"horizon_s": HORIZON, "rmse": numbers(self.rmse)},
            "notes": list(self.notes),
            **self.more,
            "provenance": self.provenance,
        }
        return json.dumps(result, indent=2, allow_nan=False) + "\n"


def fit_online(records: Sequence[Record], config: Config, kind: Kind) -> Fit:
    """Fold a recursive estimator over records, one after the other, as the node would.

    Raises
    ------
    UserError
        If the data are too few to say anything.
    """
    if kind not in ESTIMATORS:
        raise UserError(f"there is no estimator '{kind}': use {' or '.join(ESTIMATORS)}")
    warm_up(config, kind)
    estimator = OnlineEstimator(config, kind)
    for record in records:
        estimator.sampler = Sampler(config)
        if config.estimate_effects:  # samples depend on what is known by then
            bag = Bag(record.path)
            for role, message in inputs.messages(bag, inputs.select(bag, config), config):
                estimator.push(role, message)
            estimator.flush()
        else:
            estimator.take(record.samples)
    report = estimator.report()
    removed = 1.0 - (report.std / estimator.prior.std) ** 2
    found = config.with_values(dict(zip(report.names, report.values.tolist(), strict=True)))
    model = found.model
    samples = sum(len(record.samples) for record in records)
    moves, effects = found.dynamics, compiled(found.effects)
    scores = [score(moves, record.samples, effects=effects) for record in records]
    squares = [s.rmse**2 * len(r.samples) for s, r in zip(scores, records, strict=True)]
    return Fit(
        estimator=kind,
        names=report.names,
        units=report.units,
        values=report.values,
        covariance=report.covariance,
        identifiable=tuple(bool(r > IDENTIFIABLE) for r in removed),
        model=model,
        samples=samples,
        duration=sum(record.duration for record in records),
        rmse=np.sqrt(np.sum(squares, axis=0) / samples),
        provenance=provenance(((r.path.name, r.sha256) for r in records), vehicle=config.name),
    )


def write_text(path: str | Path, text: str) -> None:
    """Write a file whole or not at all.

    Raises
    ------
    UserError
        If it cannot be written there.
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_text(text, encoding="utf-8")
        part.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            part.unlink()
        raise UserError(f"{path} cannot be written: {error.strerror}") from error
