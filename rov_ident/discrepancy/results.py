"""What `explain` found, as plain results: written to findings.json, told in the report."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from rov_ident.reports.result import as_json

Verdict = Literal["agrees", "retuned", "explained", "unexplained"]


@dataclass(frozen=True)
class Value:
    """A parameter with its standard deviation."""

    value: float
    std: float
    unit: str


@dataclass(frozen=True)
class Together:
    """A gain [%] of several velocities, the mean of its logarithms, with its 95 % interval."""

    percent: float
    low: float
    high: float


@dataclass(frozen=True)
class Gain:
    """What an effect gains on data that no fit has seen: ``component`` is a velocity component or
    "kinematic"; rmse in its unit (kinematic: in units of the noise); ``percent`` with its 95 %
    interval. Where no velocity surely gains by itself, those of the axes on which the effect acts
    ``together``."""

    component: str
    rmse_before: float
    rmse_after: float
    percent: float
    low: float
    high: float
    together: Together | None = None


@dataclass(frozen=True)
class Alternative:
    """Another effect that was fitted in this one's place."""

    effect: str
    why_not: str


@dataclass(frozen=True)
class Repetition:
    """What several records say of an effect: whether it is the ``same`` in each, whether a record
    is predicted better with it by fits to the others (``repeats``; None: not asked, as sensors are
    compared in each record, and an onset belongs to one), and its parameters in each."""

    same: bool
    repeats: bool | None
    records: tuple[dict[str, Value], ...]


@dataclass(frozen=True)
class Finding:
    """One effect that the simulation lacks; ``onset_s`` from the first message. Not ``separable``
    where the bag cannot tell it from its ``alternatives``, from what has no name, or from what was
    not tried; ``doubts`` then say what speaks against it beside those, and ``manoeuvre`` is the run
    that would tell."""

    effect: str
    axes: tuple[str, ...]
    parameters: dict[str, Value]
    onset_s: float | None
    gain: Gain
    separable: bool = True
    manoeuvre: str | None = None
    alternatives: tuple[Alternative, ...] = ()
    doubts: tuple[str, ...] = ()
    sentence: str = ""
    repetition: Repetition | None = None


@dataclass(frozen=True)
class Residual:
    """What no effect explains: on which axis, how it depends on what, and the share of the axis's
    residual power that the dependence explains; whether that is ``sure``, or only the best there is
    where something is surely left, and the share one of all axes together."""

    axis: str
    depends_on: str
    frequency_hz: float | None
    share: float
    sure: bool = True


@dataclass(frozen=True)
class Change:
    """A coefficient before and after refitting."""

    before: float
    after: float
    std: float
    unit: str


@dataclass(frozen=True)
class Findings:
    """The whole result; RMSE by velocity component, open loop, on held-out data. ``contradictions``
    say in which parts odometry and IMU, or several records, still differ."""

    baseline: dict[str, float]
    retuned: dict[str, float]
    extended: dict[str, float]
    changed: dict[str, Change]
    effects: tuple[Finding, ...]
    minor: tuple[Finding, ...]
    residual: tuple[Residual, ...]
    verdict: Verdict
    notes: tuple[str, ...] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)
    contradictions: tuple[str, ...] = ()

    def to_json(self) -> str:
        """As the contract has it; numbers that do not exist are null."""
        changed = {
            name: {"from": c.before, "to": c.after, "std": c.std, "unit": c.unit}
            for name, c in self.changed.items()
        }
        document = {
            "baseline": {"rmse": self.baseline},
            "retuned": {"rmse": self.retuned, "changed": changed},
            "effects": [asdict(f) for f in self.effects],
            "minor": [asdict(f) for f in self.minor],
            "residual": [asdict(r) for r in self.residual],
            "contradictions": list(self.contradictions),
            "extended": {"rmse": self.extended},
            "verdict": self.verdict,
            "notes": list(self.notes),
            "provenance": dict(self.provenance),
        }
        return as_json(_finite(document))


def _finite(x: Any) -> Any:
    if isinstance(x, float):
        return x if math.isfinite(x) else None
    if isinstance(x, Mapping):
        return {k: _finite(v) for k, v in x.items()}
    if isinstance(x, list | tuple):
        return [_finite(v) for v in x]
    return x
