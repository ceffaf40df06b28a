"""Whether model and data agree, so that an interval means what it says.

An estimator finds the values that suit the data best, however badly that is; these tests ask how
badly. "Does the model explain the data?" in docs/live.md has the study that limits are from.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from rov_ident.config import Config
from rov_ident.config.prior import STAMPS, Prior
from rov_ident.core.linalg import widened
from rov_ident.core.messages import Array
from rov_ident.core.states import IDENTIFIABLE, State
from rov_ident.core.whiteness import BY_CHANCE
from rov_ident.estimation.innovation_monitor import TIME
from rov_ident.estimation.process_noise import FIRST_FORCE
from rov_ident.model.coefficients import AXES, VELOCITIES
from rov_ident.model.scales import authority
from rov_ident.reports.result import NORMAL
from rov_ident.reports.table import with_unit

CAUSE = "rov-ident explain looks for the cause"
_PRIOR = "prior of "  # begins the name of such a test
_LEFT = "unexplained: "  # likewise
_WHITENESS = "whiteness: "
SUPPOSED = 2.8
"""Standard deviations: of nine suppositions one seems, or is, further off in 5 % of dives."""
_SELDOM = 1.645  # normal deviate that 5 % exceed, as of SUPPOSED
_BEYOND = 3.0  # standard deviations beyond a bound: chance asks for it once in 700 times
_SENSORS = 3.0  # standard deviations, as of a lone outlier
# as many of the variance of noise that TIME averages of sums over a second make of it
_BY_SCATTER = 1.0 + _SENSORS * float(np.sqrt(2.0 / TIME))
_WHITE = 2.0  # times what noise explains, of which clean dives reach 1.2 (table in docs/live.md)
_WORSE = 1.05  # what the scatter of a second dive allows
_RUINED = 3.0  # times the error before, whatever the uncertainty: clean dives fitted from the right
# file reach 2.0 ("What is asked", docs/live.md)
_DIVERGES = 1e3  # times: any number does that leaves no interval narrower than the prior's
_CHANCE = 2.0  # standard deviations: what 5 % of fits exceed if one direction decides


@dataclass(frozen=True)
class Test:
    """One question: it is passed while the value is at most the limit."""

    name: str
    value: float
    limit: float
    failure: str
    """What a value above the limit means, in words."""

    @property
    def passed(self) -> bool:
        return self.value <= self.limit

    @property
    def inflation(self) -> float:
        """How many times larger errors are than stated, if that is what the value comes from: of
        innovations, which are said to add up to 1, the value, also within the limit, but for what
        chance makes of it."""
        not_white = self.name.startswith(_WHITENESS) and self.value > BY_CHANCE
        return self.value if not_white else self.value / self.limit


@dataclass(frozen=True)
class Consistency:
    """The tests, and by how much wider they make every interval."""

    tests: tuple[Test, ...]

    @cached_property
    def consistent(self) -> bool:
        return all(test.passed for test in self.tests)

    @property
    def possible(self) -> bool:
        """Whether every nuisance parameter is within the range that its prior allows for."""
        return all(test.passed for test in self.tests if test.name.startswith(_PRIOR))

    @cached_property
    def judged(self) -> bool:
        """Whether any axis moved enough to test what the model leaves unexplained on it."""
        return any(test.name.startswith(_LEFT) for test in self.tests)

    @cached_property
    def inflation(self) -> float:
        """How many times larger than stated errors may be: as the worst test says."""
        return max([1.0, *(test.inflation for test in self.tests)])

    def widened(self, covariance: Array, prior: Array, moved: Array, already: float = 1.0) -> Array:
        """The covariance (n, n) of an estimate with standard deviations (n,) of its ``prior``, from
        whose mean it has ``moved`` (n,).

        Errors are taken to be larger by :attr:`inflation`, of which ``already`` is there before;
        but what the file says remains, within reach of what the data say against it.
        """
        factor = max(self.inflation / already, 1.0)
        variance = np.diag(covariance)
        limit = np.maximum(prior, np.abs(moved)) ** 2
        return widened(covariance, np.maximum(variance, np.minimum(factor**2 * variance, limit)))

    @property
    def sentence(self) -> str:
        """What the worst test says, and what to do; or what it means that none fails."""
        failed = [test for test in self.tests if not test.passed]
        if not failed and not self.judged:
            return (
                "nothing contradicts the model, but there was too little motion, throughout or "
                "since estimation began anew with another lag or delay, to test what the model "
                "leaves unexplained"
            )
        if not failed:
            return "model and data agree"
        return max(failed, key=lambda test: test.value / test.limit).failure

    @cached_property
    def doubt(self) -> str:
        """Why nothing can have converged, in a few words; empty where something can."""
        if not self.consistent:
            return "data and model disagree"
        return "" if self.judged else "too little motion yet to judge the model"

    def of_states(self, states: Iterable[State], removed: Array) -> tuple[State, ...]:
        """The states of a fit: in :attr:`doubt` nothing has converged, and of what the intervals
        have then ``removed`` too little of the prior's variance, as shares (n,), is held."""
        if not self.doubt:
            return tuple(states)
        doubted = {State.CONVERGED: State.CONVERGING}
        out = (doubted.get(state, state) for state in states)
        return tuple(
            State.HELD if state is State.CONVERGING and share <= IDENTIFIABLE else state
            for state, share in zip(out, removed.tolist(), strict=True)
        )

    def with_open_loop(self, before: Array, after: Array, chance: Array) -> "Consistency":
        """The same, asked also whether a fit predicts worse than what it began with.

        ``before`` and ``after`` (6,) are errors of the open-loop simulation, NaN where not known,
        infinite where it diverges;
        ``chance`` (6,) is the part of the latter that the uncertainty of the fit explains. Without
        it, no fit could stand beside a configuration that is right already; but what has been
        fitted to these very data does not miss them by far.
        """
        tests = list(self.tests)
        allowed = before + _CHANCE * chance  # the triangle inequality
        allowed = np.minimum(allowed, _RUINED / _WORSE * before)
        columns = before.tolist(), after.tolist(), allowed.tolist()
        for component, old, new, most in zip(VELOCITIES, *columns, strict=True):
            if 0.0 < old < np.inf and not np.isnan(new):
                tests.append(
                    Test(
                        f"open loop: {component}", min(new / most, _DIVERGES), _WORSE,
                        f"the fit predicts {component} worse than the configuration does (error "
                        f"{new:.3g} instead of {old:.3g}): {CAUSE}",
                    )
                )  # fmt: skip
        return replace(self, tests=tuple(tests))

    def to_dict(self) -> dict[str, Any]:
        """As in the JSON of a fit."""
        return {
            "consistent": self.consistent,
            "tests": [
                {"name": t.name, "value": t.value, "limit": t.limit, "passed": t.passed}
                for t in self.tests
            ],
            "sentence": self.sentence,
        }


def consistency_of(
    config: Config,
    prior: Prior,
    values: Array,
    unexplained: Array,
    lasting: Array | None = None,
    sensors: Mapping[str, float] | None = None,
    std: Array | None = None,
    reading_noise: Array | None = None,
) -> Consistency:
    """Judge an estimate.

    ``values`` (n,) are what the data ask for, not yet drawn to what is possible; ``std`` (n,) are
    their standard deviations, None for least squares, which asks for nothing but the prior.
    ``unexplained`` (6,) is the force that lasts a second and that the model does not have, relative
    to the working wrench; NaN where it is not known. ``lasting`` (6,), of RLS, UKF and ML, is the
    power of innovations added up over a second in motion: 1 is expected, NaN where it is not known.
    ``sensors`` are test ratios of the odometry's parts against the IMU. ``reading_noise`` (6,) is
    the variance density [N2 s, (N m)2 s] of what is read beside the wrench and not followed by the
    vehicle: over a second, it leaves as much unexplained.
    """
    tests = []
    # weight rights the vehicle to the measured attitude, whose error lasts as long as such a force
    working = authority(config.model)
    righting = np.linalg.norm(config.model.body.restoring, axis=1) / working
    limits = np.hypot(FIRST_FORCE, config.odometry.attitude_std * righting)
    if reading_noise is not None:
        limits = np.hypot(limits, np.sqrt(_BY_SCATTER * reading_noise) / working)
    for axis, share, limit in zip(AXES, unexplained.tolist(), limits.tolist(), strict=True):
        if np.isfinite(share):
            tests.append(
                Test(
                    f"{_LEFT}{axis}", share, limit,
                    f"something acts along {axis} that the model does not have: {share:.1%} of "
                    f"the working wrench; {CAUSE}",
                )
            )  # fmt: skip
    powers = [] if lasting is None else lasting.tolist()
    for axis, power in zip(AXES, powers):
        if np.isfinite(power):
            tests.append(
                Test(
                    f"{_WHITENESS}{axis}", float(np.sqrt(power)), _WHITE,
                    f"predictions along {axis} are off for a second by {np.sqrt(power):.1f} times "
                    f"what noise explains: {CAUSE}",
                )
            )  # fmt: skip
    supposed = {".".join(key) for key in config.nuisance_std}
    of_nuisance = [i for i, name in enumerate(prior.names) if name in supposed]
    if k := len(of_nuisance):
        distance = (values[of_nuisance] - prior.mean[of_nuisance]) / prior.std[of_nuisance]
        # quantile of chi squared (Wilson and Hilferty 1931), for which scipy would be loaded
        limit = np.sqrt(k) * (1.0 - 2.0 / (9.0 * k) + _SELDOM * np.sqrt(2.0 / (9.0 * k))) ** 1.5
        tests.append(
            Test(
                f"{_PRIOR}all together",
                float(np.linalg.norm(distance)),
                max(SUPPOSED, float(limit)),
                "the data ask for more of thrust, trim, current and times together than the "
                f"configuration takes for possible: {CAUSE}",
            )
        )
    asked = [
        f"the data ask for {name} = {with_unit(f'{x:.3g}', unit)}, which"
        for name, x, unit in zip(prior.names, values.tolist(), prior.units, strict=True)
    ]
    unlikely = {}  # what to make of a value further off than the configuration supposes
    for i in of_nuisance:
        mean, half = prior.mean[i], NORMAL * prior.std[i]
        # no stamp makes a force that lasts; nor does a weight make anything late
        suspects = "the stamps" if prior.units[i] == "s" else "the wrench and the vehicle's file"
        unlikely[i] = (
            f"{asked[i]} the configuration takes for impossible ({mean:.3g} ± {half:.2g}): check "
            f"{suspects}, or say what is known of it; {CAUSE}"
        )
        off = abs(values[i] - mean) / prior.std[i]
        tests.append(Test(f"{_PRIOR}{prior.names[i]}", float(off), SUPPOSED, unlikely[i]))
    if std is not None:
        upper = np.where(prior.negative, np.minimum(prior.upper, 0.0), prior.upper)
        by_clocks = np.array([STAMPS if unit == "s" else 0.0 for unit in prior.units])
        beyond = np.maximum(prior.lower - values, values - upper) / np.hypot(std, by_clocks)
        for i in np.flatnonzero(beyond > 0.0).tolist():
            # beyond what is only supposed it is not impossible by itself
            words = unlikely.get(i, "")
            if not words or abs(values[i] - prior.mean[i]) <= SUPPOSED * prior.std[i]:
                words = (
                    f"{asked[i]} {'drives the vehicle' if prior.negative[i] else 'is impossible'}: "
                    "the model lacks something, or wrench, odometry and IMU are not stamped by one "
                    f"clock, at the time of measurement; {CAUSE}"
                )
            tests.append(Test(f"bound of {prior.names[i]}", float(beyond[i]), _BEYOND, words))
    return Consistency((*tests, *tests_of_sensors(sensors or {})))


def worst_of(records: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Of the test ratios of several records the largest of each part."""
    worst: dict[str, float] = {}
    for ratios in records:
        worst |= {part: max(x, worst.get(part, 0.0)) for part, x in ratios.items()}
    return worst


def tests_of_sensors(ratios: Mapping[str, float]) -> list[Test]:
    """Whether the parts of the odometry and the IMU agree, by their test ratios."""
    return [
        Test(
            f"odometry and IMU: {part}", float(np.sqrt(ratio)), _SENSORS,
            f"the {part} of the odometry and the IMU contradict each other (they differ by "
            f"{np.sqrt(ratio):.1f} times their noise): check frames, mountings, stamps and "
            "biases, and whether the attitude wanders",
        )
        for part, ratio in ratios.items()
    ]  # fmt: skip
