"""Accuracy of the live estimators, over seeds: the tables of docs/accuracy.md and
docs/choices.md.

    python -m bench.studies.accuracy [STUDY ...] [--seeds N] [--long-seeds N] [--few-seeds N]
                                     [--jobs N] [--minutes T] [--folder DIR] [--data DIR]

Studies, and their bars (exit status 1 where one is missed):

* ``efficiency``: error of each coefficient against the Cramer-Rao bound of the same dive
  (bound.py; RLS within 2 x, UKF within 1.5 x), 95 % intervals (92 to 98 % over all, no single
  coefficient off at the 0.1 % level), and the time until each is within 10 % of its final value;
* ``coverage``: intervals where the model lacks something (coloured force: 90 to 99 %), and which
  coefficients the bias reaches;
* ``change``: one coefficient grows by 30 % in mid-dive (old value left within 15 s, new one held
  within 60 s);
* ``noise``: velocities with once to three times the noise (mean error within its scatter);
* ``settings``: the curves from which defaults were chosen (no bars);
* ``tank``: prediction on the measured record (both estimators better than constant velocity and the
  published coefficients); the record belongs to others, --data (or ROV_IDENT_DATA) is its folder;
* ``windup``: a million samples without excitation (windup.py).

Each dive is simulated once and leaves one line in a file of FOLDER, so that a run can be broken off
and taken up again; the tables are made from the lines. Lines of other sources are not used. With
--minutes no dive is begun after so many; the tables are then of those that are there, and what is
missing counts as a bar missed.

Vehicles are drawn within 25 % of the BlueROV2 Heavy; the configuration starts off by up to 8 % and
by up to 50 %. Judged is what a node would publish.
"""

import argparse
import dataclasses
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from bench import DATA, HEAVY, ROOT
from bench.harness import Bars, Line, announce, digest, lines_of, table
from bench.studies import bound, windup
from rov_ident import config as configuration
from rov_ident.config import Config
from rov_ident.config.prior import prior_of
from rov_ident.core.messages import Array, Wrench
from rov_ident.estimation.online import ESTIMATORS
from rov_ident.estimation.physical import physical
from rov_ident.io.csv_log import import_csv
from rov_ident.model.equations import Model, build
from rov_ident.model.scales import authority
from rov_ident.offline.fit import fit_online
from rov_ident.sampling.records import Record, predicted, read_record, samples_of
from rov_ident.simulation import virtual_sensors as sensors
from rov_ident.simulation.manoeuvres import manoeuvre
from rov_ident.simulation.open_loop import Trajectory, simulate
from rov_ident.simulation.virtual_sensors import START, Dive, Suite

EIGHTEEN = {"Y_v": -8.0, "K_p": -0.1, "N_r": -0.1}
"""Published as zero: 5 to 20 % of the axis's drag."""

COUPLINGS = {"Y_rdot": 0.3, "Z_qdot": -0.3, "Y_uv": -40.0, "N_uv": -4.0, "Z_q": 1.0, "M_w": 0.5}
"""Six more: about a tenth of what acts on their axis."""

CHANGED = ("X_udot", "Z_wdot", "N_rdot", "X_uu", "Y_vv", "Z_ww", "K_pp", "M_q", "N_rr")
"""Of which one grows in mid-dive."""


def _constant(factor: float) -> dict[str, Any]:
    """Forgetting by a factor each 0.1 s."""
    return {"rls": {"forgetting": "constant", "forgetting_factor": factor}}


SETTINGS: dict[str, dict[str, Any]] = {
    **{f"prior.relative_std {v:g}": {"prior": {"relative_std": v}} for v in (0.1, 0.25, 1.0, 2.0)},
    **{f"process_std {v:g}": {"process_std": [v] * 6} for v in (2e-5, 5e-4, 1e-3, 3e-3)},
    **{f"rls.forgetting constant, {v:g}": _constant(v) for v in (1.0, 0.999, 0.99, 0.95, 0.9)},
    **{f"ukf.change_threshold {v:g}": {"ukf": {"change_threshold": v}} for v in (1.5, 2, 4, 6, 10)},
    **{f"ukf.random_walk {v:g}": {"ukf": {"random_walk": v}} for v in (0.002, 0.01, 0.05)},
    **{f"ukf.alpha {v:g}": {"ukf": {"alpha": v}} for v in (0.1, 0.2, 1.0)},
}
"""What each puts into the parameter file."""

OFFSETS = (8, 50)  # percent
CHANGE_TIME = 90.0  # s
GRID = 0.5  # s; how often an estimate is looked at
Z = 1.959963984540054  # of the normal distribution, 97.5 %


@dataclass(frozen=True)
class Trial:
    """One simulated dive and how it differs from the estimators' idea of it."""

    seed: int
    coefficients: int = 18
    minutes: float = 3.0
    noise: float = 1.0  # factor on the noise of all velocities
    manoeuvre: str = "steps"
    unknown: str = ""  # what the model lacks: see _UNKNOWN
    change: str = ""  # the coefficient that grows by 30 % at CHANGE_TIME
    setting: str = ""  # what is not at its default: see SETTINGS


# ------------------------------------------------------------------ dives


def vehicle(trial: Trial) -> Config:
    """The true vehicle."""
    parameters = configuration.to_parameters(configuration.load(HEAVY))
    extra = EIGHTEEN | (COUPLINGS if trial.coefficients == 24 else {})
    parameters["coefficients"] = parameters["coefficients"] | extra
    config = configuration.from_parameters(parameters)
    theta = config.model.theta
    rng = np.random.default_rng([trial.seed, trial.coefficients])
    config = config.with_model(config.model.with_theta(theta * rng.uniform(0.75, 1.25, len(theta))))
    return config


def told(true: Config, trial: Trial, offset: float) -> Config:
    """The configuration that the estimators start from, wrong by up to ``offset`` percent."""
    theta = true.model.theta
    rng = np.random.default_rng([trial.seed, trial.coefficients, 1])
    wrong = theta * (1.0 + 0.01 * offset * rng.uniform(-1.0, 1.0, len(theta)))
    config = true.with_model(true.model.with_theta(wrong))
    if not trial.setting:
        return config
    parameters = configuration.to_parameters(config)
    for key, value in SETTINGS[trial.setting].items():
        inside = isinstance(value, dict)
        parameters[key] = {**parameters.get(key, {}), **value} if inside else value
    return configuration.from_parameters(parameters)


def suite_of(trial: Trial) -> Suite:
    """The sensors of issue and docs, the velocities' noise multiplied."""
    suite = Suite()
    return dataclasses.replace(
        suite,
        linear_std=trial.noise * suite.linear_std,
        angular_std=trial.noise * suite.angular_std,
        gyro_std=trial.noise * suite.gyro_std,
    )


def dive_of(true: Config, trial: Trial) -> Dive:
    """The dive, its manoeuvre, sensors, and what no estimator is told."""
    suite, duration = suite_of(trial), 60.0 * trial.minutes
    rng = np.random.default_rng([trial.seed, 2])
    t = np.arange(0.0, duration, 1.0 / suite.wrench_rate)
    demand = manoeuvre(trial.manoeuvre, true.model, t, rng)
    secret, acting = _UNKNOWN[trial.unknown](true.model, t, demand, rng)
    later = secret
    if trial.change:
        value = secret.theta[secret.names.index(trial.change)]
        later = secret.with_values({trial.change: 1.3 * value})

    def simulated(model: Model, t: Array, wrench: Array, *_: object, **__: object) -> Trajectory:
        k = int(np.searchsorted(t, CHANGE_TIME)) if trial.change else len(t) - 1
        first = simulate(secret, t[: k + 1], wrench[: k + 1])
        if not trial.change:
            return first
        second = simulate(
            later, t[k:], wrench[k:], first.nu[-1], first.position[-1], first.orientation[-1]
        )
        return Trajectory(
            *(
                np.concatenate([a[:-1], b])
                for a, b in zip(vars(first).values(), vars(second).values())
            )
        )

    with patch.object(sensors, "simulate", simulated):
        run = sensors.measure(true, t, acting, duration, suite, rng)
    # The thrusters report what they were told to do, not what acts.
    hidden = acting - demand
    messages = []
    for arrival, role, message in run.messages:
        if isinstance(message, Wrench) and trial.unknown:
            i = round((message.stamp - START) * 1e-9 * suite.wrench_rate)
            message = message._replace(
                force=message.force - hidden[i, :3], torque=message.torque - hidden[i, 3:]
            )
        messages.append((arrival, role, message))
    return Dive(run.truth, run.demand, messages)


def _nothing(model: Model, t: Array, demand: Array, rng: np.random.Generator):
    return model, demand


def _coloured(model: Model, t: Array, demand: Array, rng: np.random.Generator):
    """A force of 1 % of the working wrench on every axis, correlated over a second."""
    keep = np.exp(-(t[1] - t[0]) / 1.0)
    force = np.empty_like(demand)
    force[0] = rng.standard_normal(6)
    for i in range(1, len(t)):
        force[i] = keep * force[i - 1] + np.sqrt(1.0 - keep**2) * rng.standard_normal(6)
    return model, demand + 0.01 * authority(model) * force


def _coupling(model: Model, t: Array, demand: Array, rng: np.random.Generator):
    """Sway by yaw and yaw by sway: 5 % of what drives these axes."""
    body, values = model.body, dict(zip(model.names, model.theta.tolist()))
    limits = authority(model)
    values |= {"Y_r": 0.05 * limits[1] / 0.8, "N_v": 0.05 * limits[5] / 0.5}
    return build(body, values), demand


def _lag(model: Model, t: Array, demand: Array, rng: np.random.Generator):
    """Thrusters that follow within 50 ms."""
    keep = np.exp(-(t[1] - t[0]) / 0.05)
    acting = demand.copy()
    for i in range(1, len(t)):
        acting[i] = keep * acting[i - 1] + (1.0 - keep) * demand[i]
    return model, acting


_UNKNOWN: dict[str, Callable[..., tuple[Model, Array]]] = {
    "": _nothing,
    "coloured force": _coloured,
    "Y_r and N_v": _coupling,
    "50 ms thruster lag": _lag,
}


# ------------------------------------------------------------------ one dive


def follow(module: ModuleType, config: Config, samples: NDArray[np.void], grid: float):
    """t (k,), values and standard deviations (k, n) every ``grid`` seconds and at the end."""
    task, prior = module.problem(config), prior_of(config)
    state = module.init(task)
    edges = np.arange(samples["t"][0], samples["t"][-1], grid)[1:]
    blocks = np.split(samples, np.searchsorted(samples["t"], edges))
    t, values, std = [], [], []
    for block in blocks:
        if len(block) == 0:
            continue
        state, _ = module.fold(task, state, block)
        estimate = module.estimate(task, state, prior)
        t.append(block["t"][-1])
        values.append(estimate.values)
        std.append(estimate.std)
    values[-1] = physical(config.model, prior, estimate)
    return np.array(t), np.array(values), np.array(std)


def measure(trial: Trial) -> Line:
    """The line of one dive."""
    true = vehicle(trial)
    run, suite, theta = dive_of(true, trial), suite_of(trial), true.model.theta
    line: Line = {"names": true.model.names}
    line["true"] = theta.tolist()
    if not trial.unknown and not trial.change:
        for key, accelerometer in (("bound", False), ("bound_accelerometer", True)):
            line[key] = np.sqrt(np.diag(bound.bound(true, run, suite, accelerometer))).tolist()
    samples = np.concatenate(list(samples_of(true, run)))
    short = trial.minutes < 10.0
    # a setting of one estimator is nothing to the other
    concerned = [n for n in ESTIMATORS if n in SETTINGS.get(trial.setting, ())] or list(ESTIMATORS)
    for offset in OFFSETS:
        for name in concerned:
            module = ESTIMATORS[name]
            config = told(true, trial, offset)
            t, values, std = follow(module, config, samples, GRID if short else 1e9)
            result: dict[str, Any] = {"value": values[-1].tolist(), "std": std[-1].tolist()}
            if trial.change:
                result |= changed(trial, true, t, values, std)
            elif short:
                close = np.abs(values - values[-1]) <= 0.1 * np.abs(values[-1])
                last = [int(np.flatnonzero(~c)[-1]) + 1 if not c.all() else 0 for c in close.T]
                result["settled"] = t[last].tolist()
            line[f"{name} {offset}"] = result
    return line


def changed(trial: Trial, true: Config, t: Array, values: Array, std: Array) -> dict[str, Any]:
    """Seconds after the change until the interval leaves the old value, and holds the new one.

    Either for the rest of the dive, save one look in ten.
    """
    i = true.model.names.index(trial.change)
    old = true.model.theta[i]
    after = t > CHANGE_TIME
    t, value, width = t[after] - CHANGE_TIME, values[after, i], Z * std[after, i]

    def for_good(holds: NDArray[np.bool_]) -> float | None:
        first = (k for k in range(len(t)) if holds[k] and holds[k:].mean() >= 0.9)
        return next((float(t[k]) for k in first), None)

    others = np.delete(np.abs(values[after] - true.model.theta) <= Z * std[after], i, axis=1)
    return {
        "left": for_good(np.abs(value - old) > width),
        "held": for_good(np.abs(value - 1.3 * old) <= width),
        "off": float(abs(value[-1] / old / 1.3 - 1.0)),
        "others": float(others.mean()),
    }


# ------------------------------------------------------------------ studies


# Seed by seed, so that what a run that is broken off has done is a smaller sample of all rows.


def _efficiency(seeds: int, long_seeds: int) -> Iterator[Trial]:
    for seed in range(seeds):
        for coefficients in (18, 24):
            yield Trial(seed, coefficients)
        if seed < long_seeds:
            for coefficients in (18, 24):
                yield Trial(seed, coefficients, 30.0)


def _coverage(seeds: int, long_seeds: int) -> Iterator[Trial]:
    for seed in range(seeds):
        for unknown in list(_UNKNOWN)[1:]:
            yield Trial(seed, unknown=unknown)


def _settings(seeds: int, long_seeds: int) -> Iterator[Trial]:
    for seed in range(min(seeds, 16)):
        for setting in ("", *SETTINGS):
            yield Trial(seed, setting=setting)
            yield Trial(seed, manoeuvre="pilot", setting=setting)
            yield Trial(seed, unknown="coloured force", setting=setting)
            yield Trial(seed, change=CHANGED[seed % len(CHANGED)], setting=setting)


def _noise(seeds: int, long_seeds: int) -> Iterator[Trial]:
    for seed in range(seeds):
        for noise in (1.0, 2.0, 3.0):
            yield Trial(seed, noise=noise)


def _change(seeds: int, long_seeds: int) -> Iterator[Trial]:
    for seed in range(seeds):
        for name in CHANGED:
            yield Trial(seed, change=name)


Lines = list[Line]


def _grouped(lines: Lines, *keys: str) -> dict[tuple[Any, ...], Lines]:
    groups: dict[tuple[Any, ...], Lines] = defaultdict(list)
    for line in lines:
        groups[tuple(line["trial"][key] for key in keys)].append(line)
    return groups


def _of(lines: Lines, estimator: str, offset: int):
    """error, std, true (k, n)."""
    results = [line[f"{estimator} {offset}"] for line in lines]
    true = np.array([line["true"] for line in lines])
    return (
        np.array([r["value"] for r in results]) - true,
        np.array([r["std"] for r in results]),
        true,
    )


def efficiency(lines: Lines, bars: Bars) -> None:
    """Error against the bound, and intervals."""
    limit = {"rls": 2.0, "ukf": 1.5}
    rows, per_coefficient = [], defaultdict(dict)
    for (minutes, coefficients), group in _grouped(lines, "minutes", "coefficients").items():
        names = group[0]["names"]
        crb = np.array([line["bound"] for line in group])
        sharp = np.array([line["bound_accelerometer"] for line in group])
        for offset in OFFSETS:
            for name in ESTIMATORS:
                error, std, true = _of(group, name, offset)
                row = f"{name} {minutes:g} min {coefficients} off {offset} %"
                ratio = np.sqrt(np.mean((error / crb) ** 2, axis=0))
                strict = np.sqrt(np.mean((error / sharp) ** 2, axis=0))
                inside = np.abs(error) <= Z * std
                worst = int(np.argmax(strict))
                odd = []
                for i, hits in enumerate(inside.sum(axis=0)):
                    if binomtest(int(hits), len(group), 0.95).pvalue < 0.001:
                        odd.append(f"{names[i]} {100 * hits / len(group):.0f}")
                cover = 100 * inside.mean()
                rows.append(
                    [
                        f"{minutes:g} min, {coefficients}, {offset} %",
                        name,
                        str(len(group)),
                        f"{100 * np.median(np.abs(error / true)):.2f} %",
                        f"{np.median(ratio):.2f}, {ratio.max():.2f} {names[int(np.argmax(ratio))]}",
                        bars.check(
                            strict.max() <= limit[name],
                            f"{np.median(strict):.2f}, {strict.max():.2f} {names[worst]}",
                            f"{row} error / bound",
                        ),
                        bars.check(92 <= cover <= 98, f"{cover:.1f} %", f"{row} coverage"),
                        bars.check(not odd, ", ".join(odd) or "none", f"{row} coverage of each"),
                    ]
                )
                if minutes < 10:
                    settled = np.array([line[f"{name} {offset}"]["settled"] for line in group])
                    for i, c in enumerate(names):
                        per_coefficient[coefficients, c][name, offset] = (
                            strict[i], inside[:, i].mean(), np.mean(error[:, i] / std[:, i]),
                            np.median(settled[:, i]), np.quantile(settled[:, i], 0.9),
                        )  # fmt: skip
    table(
        "record, coefficients, off | | dives | median error | error / bound: median, worst"
        " | with accelerometer: median, worst | 95 % cover | coefficients not covered 95 %",
        rows,
    )
    for coefficients in sorted({c for c, _ in per_coefficient}):
        print(f"\n3 minutes, {coefficients} coefficients, configuration off 50 %:")
        table(
            "coefficient | rls error / bound | rls cover | rls bias, std | "
            "rls settled s: median, 90 %"
            " | ukf error / bound | ukf cover | ukf bias, std | ukf settled s: median, 90 %",
            [
                [c] + [
                    cell
                    for name in ESTIMATORS
                    for r in [cells[name, 50]]
                    for cell in (
                        f"{r[0]:.2f}", f"{100 * r[1]:.0f} %", f"{r[2]:+.2f}",
                        f"{r[3]:.0f}, {r[4]:.0f}",
                    )
                ]
                for (k, c), cells in per_coefficient.items() if k == coefficients
            ],
        )  # fmt: skip


def noise(lines: Lines, bars: Bars) -> None:
    """Bias under more noise in the velocities."""
    rows = []
    for (factor,), group in _grouped(lines, "noise").items():
        crb = np.array([line["bound_accelerometer"] for line in group])
        for name in ESTIMATORS:
            error, std, _ = _of(group, name, 50)
            bias = error.mean(axis=0) / error.std(axis=0)
            worst = int(np.argmax(np.abs(bias)))
            cover = 100 * np.mean(np.abs(error) <= Z * std)
            ratio = np.sqrt(np.mean((error / crb) ** 2, axis=0))
            what = f"{name} noise x {factor:g}"
            rows.append(
                [
                    f"x {factor:g}", name, str(len(group)),
                    f"{np.median(np.abs(bias)):.2f}",
                    bars.check(
                        abs(bias[worst]) <= 1.0,
                        f"{bias[worst]:+.2f} {group[0]['names'][worst]}", f"{what} bias",
                    ),
                    f"{np.median(ratio):.2f}, {ratio.max():.2f}",
                    f"{cover:.1f} %",
                ]
            )  # fmt: skip
    table(
        "noise | | dives | mean error / its std: median | worst"
        " | error / bound: median, worst | 95 % cover",
        rows,
    )


def coverage(lines: Lines, bars: Bars) -> None:
    """What the model lacks: intervals, and where the bias goes."""
    rows = []
    for (lack,), group in _grouped(lines, "unknown").items():
        for name in ESTIMATORS:
            error, std, true = _of(group, name, 50)
            cover = 100 * np.mean(np.abs(error) <= Z * std)
            bias = error.mean(axis=0) / std.mean(axis=0)
            order = np.argsort(-np.abs(bias))[:6]
            text = f"{cover:.1f} %"
            if lack == "coloured force":
                text = bars.check(90 <= cover <= 99, text, f"{name}, {lack}: coverage")
            reached = [
                f"{group[0]['names'][i]} {bias[i]:+.1f} "
                f"({100 * np.mean(error[:, i] / np.abs(true[:, i])):+.1f} %)"
                for i in order if abs(bias[i]) > 0.5
            ]  # fmt: skip
            rows.append([lack, name, str(len(group)), text, ", ".join(reached) or "none"])
    table("unknown | | dives | 95 % cover | bias in standard deviations (and of the value)", rows)


def change(lines: Lines, bars: Bars) -> None:
    """A coefficient that grows by 30 % in mid-dive."""
    rows = []
    for (coefficient,), group in _grouped(lines, "change").items():
        for name in ESTIMATORS:
            results = [line[f"{name} 8"] for line in group]

            def cell(key: str, limit: float) -> str:
                text, share = _within(results, key, limit)  # noqa: B023
                return bars.check(share >= 0.9, text, f"{name} {coefficient} + 30 % {key}")  # noqa: B023

            rows.append(
                [
                    coefficient, name, str(len(group)), cell("left", 15.0), cell("held", 60.0),
                    f"{100 * np.median([r['off'] for r in results]):.1f} %",
                    f"{100 * np.mean([r['others'] for r in results]):.0f} %",
                ]
            )  # fmt: skip
    table(
        "changed | | dives | left the old value, s: median, 90 % (in 15 s)"
        " | holds the new one (in 60 s) | off at the end | others covered meanwhile",
        rows,
    )


def _within(results: list[dict[str, Any]], key: str, limit: float) -> tuple[str, float]:
    """Median and 90 % of the seconds after the change, and the share within the limit."""
    t = np.array([np.inf if r[key] is None else r[key] for r in results])
    share = float(np.mean(t <= limit))
    late = np.quantile(t, 0.9, method="higher")
    return f"{np.median(t):.1f}, {late:.1f} ({100 * share:.0f} %)", share


def settings(lines: Lines, bars: Bars) -> None:
    """By setting: the curves behind the defaults."""
    rows = []
    for (setting,), group in _grouped(lines, "setting").items():
        for name in (n for n in ESTIMATORS if f"{n} 50" in group[0]):
            kinds: dict[str, Lines] = defaultdict(list)
            for line in group:
                trial = line["trial"]
                kind = trial["unknown"] or ("change" if trial["change"] else trial["manoeuvre"])
                kinds[kind].append(line)
            crb = np.array([line["bound_accelerometer"] for line in kinds["steps"]])
            error, _, _ = _of(kinds["steps"], name, 50)
            ratio = np.sqrt(np.mean((error / crb) ** 2, axis=0))
            settled = np.concatenate([line[f"{name} 50"]["settled"] for line in kinds["steps"]])
            cells = [
                f"{np.median(ratio):.2f}, {ratio.max():.2f}",
                f"{np.median(settled):.1f}, {np.quantile(settled, 0.9):.0f}",
            ]
            for kind in ("steps", "pilot", "coloured force"):
                error, std, true = _of(kinds[kind], name, 50)
                if kind != "steps":
                    cells.append(f"{100 * np.median(np.abs(error / true)):.2f} %")
                cells.append(f"{100 * np.mean(np.abs(error) <= Z * std):.1f} %")
            after = [line[f"{name} {offset}"] for line in kinds["change"] for offset in OFFSETS]
            cells += [_within(after, key, limit)[0] for key, limit in (("left", 15), ("held", 60))]
            rows.append([setting or "all defaults", name, str(len(kinds["steps"])), *cells])
    table(
        "setting | | dives | error / bound: median, worst | settled, s: median, 90 % | 95 % cover"
        " | pilot: median error | 95 % cover | coloured force: median error | 95 % cover"
        " | change: left the old value, s: median, 90 % (in 15 s) | holds the new one (in 60 s)",
        rows,
    )
    residual_corners((0.5, 1.0, 2.0, 3.0, 5.0, 10.0, 30.0))


def residual_corners(corners: tuple[float, ...], seeds: int = 8) -> None:
    """Noise of the published residual, by the corner of its filter, once the model is learnt."""
    module, rms = ESTIMATORS["rls"], defaultdict(list)
    for trial in (Trial(seed) for seed in range(seeds)):
        true = vehicle(trial)
        samples = np.concatenate(list(samples_of(true, dive_of(true, trial))))
        late = samples["t"] > samples["t"][0] + 60.0
        for corner in corners:
            config = dataclasses.replace(told(true, trial, 50), residual_corner=corner)
            task = module.problem(config)
            _, infos = module.fold(task, module.init(task), samples)
            share = infos["residual"][late] / authority(true.model)
            rms[corner].append(np.sqrt(np.mean(share**2, axis=0)))
    table(
        "residual_corner, rad/s | 90 % of a step shows after, s"
        " | noise, of the working wrench: median axis | worst axis",
        [
            # (1 + x) exp(-x) = 0.1 at x = 3.89: two equal poles
            [
                f"{corner:g}",
                f"{3.89 / corner:.2f}",
                *(f"{100 * f(r):.2f} %" for f in (np.median, np.max)),
            ]
            for corner, r in ((c, np.sqrt(np.mean(np.square(rms[c]), axis=0))) for c in corners)
        ],
    )


DIVES: dict[str, tuple[Callable[[int, int], Iterator[Trial]], Callable[[Lines, Bars], None]]] = {
    "efficiency": (_efficiency, efficiency),
    "coverage": (_coverage, coverage),
    "change": (_change, change),
    "noise": (_noise, noise),
    "settings": (_settings, settings),
}


# ------------------------------------------------------------------ the measured record

RUNS = ("11_57_50_3dof", "11_40_38_6dof")
CHANNELS = np.array([True, True, True, False, False, False])


def tank(data: Path, bars: Bars) -> None:
    """Prediction of the next seconds on one record by what was estimated on the other."""
    folder = data / "bluerov2-heavy-tank"
    if not folder.is_dir():
        print(f"\nLeft out: the measured record is not in {data} (--data or ROV_IDENT_DATA).")
        return
    config, records = configuration.load(ROOT / "config" / "bluerov2_heavy_tank.yaml"), []
    with tempfile.TemporaryDirectory() as temporary:
        for run in RUNS:
            bag = Path(temporary) / f"{run}.mcap"
            import_csv([folder / f"{run}.csv"], bag, mask_rates_above=1.5, wrench_timing="bin")
            records.append(read_record(bag, config))
    rows = []
    for fitted, tried in ((0, 1), (1, 0)):
        models = {
            "published (von Benzon 2022)": config.model,
            "batch least squares": least_squares(config, records[fitted]),
        }
        for name in ESTIMATORS:
            models[name] = fit_online([records[fitted]], config, name).model
        for horizon in (2.0, 10.0):
            errors = {
                "constant velocity": held(records[tried], horizon),
                **{k: rmse_of(m, records[tried], horizon) for k, m in models.items()},
            }
            for name, rmse in errors.items():
                text = " | ".join(f"{1e3 * e:.0f}" for e in rmse)
                if name in ESTIMATORS:
                    others = [errors["constant velocity"], errors["published (von Benzon 2022)"]]
                    text = bars.check(
                        all(np.mean(rmse**2) <= np.mean(other**2) for other in others),
                        text, f"tank, {RUNS[tried]}, {horizon:g} s, {name}",
                    )  # fmt: skip
                rows.append([RUNS[fitted], RUNS[tried], f"{horizon:g} s", name, text])
    table("estimated on | tried on | ahead | | surge, mm/s | sway, mm/s | heave, mm/s", rows)


def rmse_of(model: Model, record: Record, horizon: float) -> Array:
    """(3,) of windows simulated open loop; the rotation follows the measurement."""
    measured, samples = record.samples["measured"], record.samples
    error = predicted(model, samples, horizon, CHANNELS)[measured] - samples["nu"][measured]
    return np.sqrt(np.mean(error[:, :3] ** 2, axis=0))


def held(record: Record, horizon: float) -> Array:
    """(3,) of the same windows if every velocity stayed what it was at the window's start."""
    samples, errors = record.samples, []
    edges = np.append(np.flatnonzero(samples["restart"]), len(samples))
    for first, end in pairwise(edges):
        part = samples[first:end]
        window = np.floor((part["t"] - part["t"][0]) / horizon).astype(int)
        start = np.searchsorted(window, window)
        errors.append((part["nu"][start] - part["nu"])[part["measured"]])
    return np.sqrt(np.mean(np.concatenate(errors)[:, :3] ** 2, axis=0))


def least_squares(config: Config, record: Record) -> Model:
    """Of the wrench on the regressor, accelerations by central differences, within the prior."""
    model, prior, samples = config.dynamics, prior_of(config), record.samples
    a, b = [np.diag(1.0 / prior.std)], [prior.mean / prior.std]
    none = model.with_theta(np.where(np.isin(model.names, prior.names), 0.0, model.theta))
    # a sample's wrench is the mean since the one before: the motion in the middle between them
    nu = 0.5 * (samples["nu"][1:] + samples["nu"][:-1])
    nu_dot = np.diff(samples["nu"], axis=0) / np.diff(samples["t"])[:, None]
    std = np.hypot(config.wrench.floor_std, 0.1 * authority(model))
    for k in np.flatnonzero(~samples["restart"][1:] & samples["measured"][1:]):
        y = samples["wrench"][k + 1] - none.wrench(nu[k], nu_dot[k], samples["down"][k + 1])
        a.append(model.regressor(nu[k], nu_dot[k])[:, prior.estimated] / std[:, None])
        b.append(y / std)
    values = np.linalg.lstsq(np.vstack(a), np.concatenate(b), rcond=None)[0]
    return config.model.with_values(dict(zip(prior.names, values.tolist(), strict=True)))


# ------------------------------------------------------------------ all dives


def source() -> str:
    """The digest of what makes a line: the tables below the studies do not."""
    here = Path(__file__).read_text().split("- studies\n")[0]
    return digest(Path(bound.__file__).read_bytes(), here.encode())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    studies = (*DIVES, "tank", "windup")
    parser.add_argument("study", nargs="*", help=f"of {', '.join(studies)}; default: all")
    parser.add_argument("--seeds", type=int, default=200, help="of the 3-minute rows")
    parser.add_argument("--long-seeds", type=int, default=50, help="of the 30-minute rows")
    parser.add_argument("--few-seeds", type=int, default=50, help="of the other studies")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument(
        "--minutes", type=float, default=np.inf, help="of measuring: no dive is begun after"
    )
    parser.add_argument("--folder", type=Path, default=Path("build/accuracy"))
    parser.add_argument(
        "--data", type=Path, default=DATA,
        help="folder that holds bluerov2-heavy-tank",
    )  # fmt: skip
    parser.add_argument("--picture", type=Path, help="where to write that of the study windup")
    options = parser.parse_args()
    if wrong := set(options.study) - set(studies):
        parser.error(f"there is no study {', '.join(sorted(wrong))}: use {', '.join(studies)}")
    bars, end = Bars(), time.monotonic() + 60.0 * options.minutes
    announce()
    path = options.folder / "dives.jsonl"
    for study in options.study or studies:
        print(f"\n## {study}", flush=True)
        if study in DIVES:
            of, show = DIVES[study]
            seeds = options.seeds if study == "efficiency" else options.few_seeds
            trials = list(of(seeds, options.long_seeds))
            left = (end - time.monotonic()) / 60.0
            lines = lines_of(
                trials, measure, lambda _: path, source(), jobs=options.jobs, minutes=left
            )
            show(lines, bars)
            if len(lines) < len(trials):
                bars.missed.append(f"{study}: only {len(lines)} of {len(trials)} dives")
        elif study == "tank":
            tank(options.data, bars)
        else:
            windup.report(windup.SAMPLES, options.picture, bars)
    return bars.status()


if __name__ == "__main__":
    sys.exit(main())
