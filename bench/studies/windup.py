"""What a million samples without excitation do to recursive least squares that forgets.

    python -m bench.studies.windup [--samples N] [--picture FILE]

A linear regression with 24 coefficients, driven on all of them; then N samples in which a single
direction is driven, as when a vehicle goes straight ahead, and all other regressors are noise of
the sensors; then all of them again, with one coefficient 30 % larger. Seven rules of forgetting, in
textbook form, and the rule of this library; then the library itself, with a vehicle that rests so
long. Prints a table; exit status 1 where the library misses its bars.
"""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bench import HEAVY
from bench.harness import Bars, announce, table
from rov_ident import config as configuration
from rov_ident.config.prior import prior_of
from rov_ident.core.jit import kernel
from rov_ident.estimation.online import ESTIMATORS
from rov_ident.reports import plots
from rov_ident.sampling import records
from rov_ident.sampling.sample import SAMPLE
from rov_ident.simulation import virtual_sensors as sensors
from rov_ident.simulation.manoeuvres import manoeuvre

Array = NDArray[np.float64]

SAMPLES = 1_000_000
N = 24
FACTOR = 0.98
NOISE = 0.05  # of the output
SLIGHT = 1e-3  # noise of each regressor
BEFORE, AFTER = 2000, 2000  # samples with excitation
GROWN = 1.3  # the first coefficient after the silence, times what it was
RECOVERED = 0.1  # of a value: an error that counts as recovered
SECONDS = 60.0  # bar of the library for that

RULES = (
    "plain exponential",
    "Fortescue 1981",
    "Kulhavy 1987 (directional)",
    "exponential resetting (Salgado 1988)",
    "trace-bounded",
    "SIFt (Lai and Bernstein 2024)",
    "on evidence (ours)",
)
PLAIN, FORTESCUE, KULHAVY, RESETTING, BOUNDED, SIFT, EVIDENCE = range(len(RULES))


# ------------------------------------------------------------------ rules, one row a sample
#
# All with theta (n,), P (n, n) in units of the output's variance, a row phi (n,) and the error e in
# standard deviations of the output. g = P phi, r = phi' P phi.


@kernel
def _less(p, g, f):
    """P - f g g', exactly symmetric: forgetting multiplies what rounding would leave."""
    for i in range(len(g)):
        for j in range(len(g)):
            p[i, j] -= f * (g[i] * g[j])


@kernel
def _times(p, f):
    for i in range(len(p)):
        for j in range(len(p)):
            p[i, j] *= f


@kernel
def _step(rule, theta, p, information, phi, e, surprise):
    """One sample into theta, P (and R = P^-1, ``information``, of SIFt); the surprise of ours."""
    n = len(theta)
    g = p @ phi
    r = phi @ g
    if rule in (PLAIN, BOUNDED):
        forget = rule == PLAIN or np.trace(p) / FACTOR <= n  # the prior's trace
        kept = FACTOR if forget else 1.0
        theta += g * (e / (kept + r))
        _less(p, g, 1.0 / (kept + r))
        _times(p, 1.0 / kept)
    elif rule == FORTESCUE:
        # the weighted sum of squared errors is held at that of 1 / (1 - FACTOR) samples
        theta += g * (e / (1.0 + r))
        _less(p, g, 1.0 / (1.0 + r))
        _times(p, 1.0 / max(1.0 - (1.0 - FACTOR) * e * e / (1.0 + r), 0.5))
    elif rule == KULHAVY:
        theta += g * (e / (1.0 + r))
        if r > 0.0:
            epsilon = FACTOR - (1.0 - FACTOR) / r
            _less(p, g, epsilon / (1.0 + epsilon * r))
    elif rule == RESETTING:
        alpha, beta, delta = 0.5, 0.005, 0.005
        square = p @ p
        theta += g * (alpha * e / (1.0 + r))
        for i in range(n):
            for j in range(n):
                p[i, j] = (
                    p[i, j] / FACTOR - alpha * (g[i] * g[j]) / (1.0 + r) - delta * square[i, j]
                )
            p[i, i] += beta
    elif rule == SIFT:
        seen = information @ phi
        size = phi @ seen
        if phi @ phi > 16.0 * n * (SLIGHT / NOISE) ** 2:
            _less(information, seen, (1.0 - FACTOR) / size)
            _less(p, phi, -(1.0 - FACTOR) / FACTOR / size)
            g = p @ phi
            r = phi @ g
            theta += g * (e / (1.0 + r))
            _less(p, g, 1.0 / (1.0 + r))
            _less(information, phi, -1.0)
    else:
        # Coefficients whose regressor is noise are considered, not estimated (Schmidt); variances
        # grow up to the prior's while errors are larger than they should be.
        surprise += 0.01 * (min(e * e / (1.0 + r), 25.0) - surprise)
        for i in range(n):
            still_i = abs(phi[i]) <= 4.0 * SLIGHT / NOISE
            if not still_i:
                theta[i] += g[i] * e / (1.0 + r)
            for j in range(n):
                if not (still_i and abs(phi[j]) <= 4.0 * SLIGHT / NOISE):
                    p[i, j] -= (g[i] * g[j]) / (1.0 + r)
        if surprise > 3.0:
            for i in range(n):
                p[i, i] += 0.001 * max(1.0 - p[i, i], 0.0)
    return surprise


@kernel
def _run(rule, samples, looks, rng, traces, errors, others):
    """The whole experiment; at each of ``looks`` trace of P, error of the first coefficient and
    the largest of the others, relative. Returns the sample at which P is no longer finite, or -1.
    """
    truth = np.empty(N)
    for i in range(N):
        truth[i] = 1.0 + rng.random()
    theta, p, information = np.zeros(N), np.eye(N), np.eye(N)
    phi, measured = np.empty(N), np.empty(N)
    surprise, look = 1.0, 0
    for k in range(BEFORE + samples + AFTER):
        driven = k < BEFORE or k >= BEFORE + samples
        if k == BEFORE + samples:
            truth[0] *= GROWN
        for i in range(N):
            phi[i] = rng.standard_normal() if driven else (0.5 if i < 4 else 0.0)
            measured[i] = (phi[i] + SLIGHT * rng.standard_normal()) / NOISE
        y = phi @ truth / NOISE + rng.standard_normal()
        e = y - measured @ theta
        surprise = _step(rule, theta, p, information, measured, e, surprise)
        if look < len(looks) and k == looks[look]:
            traces[look] = np.trace(p) / N
            errors[look] = abs(theta[0] / truth[0] - 1.0)
            others[look] = np.max(np.abs(theta[1:] / truth[1:] - 1.0))
            look += 1
        total = np.sum(p) + np.sum(theta)
        if total - total != 0.0:
            return k
    return -1


@dataclass(frozen=True)
class Course:
    """One rule's way: at ``looks``, relative to the start of the silence."""

    name: str
    traces: Array  # of the covariance, 1 for the prior's
    errors: Array  # of the coefficient that changes
    others: Array  # the largest of the others
    broken: int  # samples into the silence at which it is no longer finite, or -1
    to_recover: float  # samples, or seconds; infinite: not

    @property
    def spoilt(self) -> bool:
        return self.broken >= 0


def looks_of(samples: int) -> NDArray[np.int64]:
    """Samples at which to look: evenly in the driven parts, by logarithm in the silence."""
    silent = np.unique(np.geomspace(1, samples - 1, 400).astype(int))
    before = np.arange(0, BEFORE, 5)
    after = np.arange(0, AFTER)
    return np.concatenate([before, BEFORE + silent, BEFORE + samples + after])


def courses(samples: int, seed: int = 1) -> list[Course]:
    """Every textbook rule through the same experiment."""
    looks, out = looks_of(samples), []
    returned = looks >= BEFORE + samples
    for rule, name in enumerate(RULES):
        traces, errors, others = np.full((3, len(looks)), np.nan)
        broken = _run(rule, samples, looks, np.random.default_rng(seed), traces, errors, others)
        worst = np.where(np.isfinite(errors), np.maximum(errors, others), np.inf)[returned]
        out.append(
            Course(
                name,
                traces,
                errors,
                others,
                broken - BEFORE if broken >= 0 else -1,
                _recovered(worst, looks[returned] - looks[returned][0] + 1.0),
            )
        )
    return out


def _recovered(errors: Array, elapsed: Array) -> float:
    """When they fall below RECOVERED for good."""
    bad = np.flatnonzero(~(errors < RECOVERED))
    if len(bad) == 0:
        return float(elapsed[0])
    return float(elapsed[bad[-1] + 1]) if bad[-1] + 1 < len(elapsed) else np.inf


# ------------------------------------------------------------------ the library itself


def library(samples: int) -> list[dict[str, Any]]:
    """Both estimators on a BlueROV2 Heavy that is driven, rests, and comes back changed."""
    true = configuration.load(HEAVY)
    dt, rng = 0.02, np.random.default_rng(0)
    suite = sensors.Suite(odometry_rate=1.0 / dt, imu_rate=0.0, wrench_rate=1.0 / dt)
    heavier = true.model.with_values(
        {"X_uu": GROWN * true.model.theta[true.model.names.index("X_uu")]}
    )
    first = np.concatenate(
        list(records.samples_of(true, sensors.dive(true, "steps", 120.0, suite, 1)))
    )
    changed = true.with_model(heavier)
    t = np.arange(0.0, 120.0, dt)
    demand = manoeuvre("steps", true.model, t, rng)
    run = sensors.measure(changed, t, demand, 120.0, suite, rng)
    last = np.concatenate(list(records.samples_of(true, run)))

    rest = np.zeros(samples, dtype=SAMPLE)
    rest["t"], rest["dt"], rest["measured"] = (
        first["t"][-1] + dt * np.arange(1, samples + 1),
        dt,
        True,
    )
    std = np.repeat([suite.linear_std, suite.angular_std], 3)
    rest["restart"][0] = True
    rest["nu"] = std * rng.standard_normal((samples, 6))
    rest["odometry"], rest["odometry_variance"], rest["gyro"] = rest["nu"], std**2, np.nan
    rest["down"], rest["orientation"] = [0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0]
    rest["wrench"] = true.model.restoring_force(np.array([0.0, 0.0, 1.0]))
    last["t"] += rest["t"][-1] + 1.0

    rng = np.random.default_rng(2)
    wrong = true.model.theta * (1.0 + 0.3 * rng.uniform(-1.0, 1.0, len(true.model.theta)))
    config = true.with_model(true.model.with_theta(wrong))
    prior, out = prior_of(config), []
    i = prior.names.index("X_uu")
    for name, module in ESTIMATORS.items():
        task = module.problem(config)
        state, _ = module.fold(task, module.init(task), first)
        begun = module.estimate(task, state, prior)
        share, finite = [], True
        for part in np.array_split(rest, 100):
            state, _ = module.fold(task, state, part)
            estimate = module.estimate(task, state, prior)
            share.append(np.mean(np.diag(estimate.covariance) / prior.std**2))
            finite = finite and bool(np.linalg.eigvalsh(estimate.covariance)[0] > 0.0)
        moved = float(np.max(np.abs(estimate.values - begun.values) / begun.std))
        errors, at = [], []
        for part in np.array_split(last, len(last) // 25):
            state, _ = module.fold(task, state, part)
            estimate = module.estimate(task, state, prior)
            errors.append(abs(estimate.values[i] / heavier.theta[i] - 1.0))
            at.append(part["t"][-1] - last["t"][0])
        out.append(
            {
                "name": name,
                "before": float(np.mean(np.diag(begun.covariance) / prior.std**2)),
                "trace": max(share),
                "definite": finite,
                "moved": moved,
                "to_recover": _recovered(np.array(errors), np.array(at)),
                "error": errors[-1],
            }
        )
    return out


# ------------------------------------------------------------------ table and picture


def picture(all_courses: list[Course], samples: int) -> Figure:
    """Trace and error, in the silence and after it."""
    looks = looks_of(samples)
    silent = (looks > BEFORE) & (looks < BEFORE + samples)
    returned = looks >= BEFORE + samples
    figure = Figure(figsize=(11.0, 7.0), layout="constrained")
    axes = figure.subplots(2, 2)
    for number, course in enumerate(all_courses):
        style = {
            "color": f"C{number}", "lw": 2.6 if number == EVIDENCE else 1.3, "label": course.name,
            "zorder": 3 if number == EVIDENCE else 2,
        }  # fmt: skip
        worst = np.maximum(course.errors, course.others)
        for row, values in enumerate((course.traces, worst)):
            axes[row, 0].loglog(
                looks[silent] - BEFORE + 1, np.minimum(values[silent], 1e12), **style
            )
            axes[row, 1].semilogy(looks[returned] - BEFORE - samples, values[returned], **style)
    for ax, title in zip(
        axes.flat,
        (
            "mean variance over the prior's: silence", "... driven again, one coefficient + 30 %",
            "largest relative error of a coefficient: silence", "... driven again",
        ),
        strict=True,
    ):  # fmt: skip
        ax.set_title(title, loc="left", fontsize=9)
        ax.set_xlabel("samples")
        ax.grid(alpha=0.3)
    for ax in axes[0]:
        ax.set_ylim(1e-7, 1e8)
    for ax in axes[1]:
        ax.set_ylim(1e-4, 1e3)
    axes[0, 1].set_xlim(0, 1000)
    axes[1, 1].set_xlim(0, 1000)
    axes[1, 1].axhline(RECOVERED, color="black", lw=0.8, ls=":")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8)
    return figure


def report(samples: int, out: Path | None, bars: Bars) -> None:
    """Print the tables."""
    looks = looks_of(samples)
    silent = (looks > BEFORE) & (looks < BEFORE + samples)
    returned = looks >= BEFORE + samples
    every, rows = courses(samples), []
    for course in every:
        worst = np.maximum(course.errors, course.others)
        trace, error = np.nanmax(course.traces[silent]), np.nanmax(worst[silent])
        if course.spoilt:
            cells = [f"overflows after {course.broken:,} samples", f"{error:.2g}", "-", "never"]
        else:
            cells = [
                f"{trace:.2g}", f"{error:.2g}", f"{np.nanmax(worst[returned]):.2g}",
                f"{course.to_recover:,.0f}" if np.isfinite(course.to_recover) else "never",
            ]  # fmt: skip
        rows.append([course.name, *cells])
    print(f"\n24 coefficients, forgetting factor {FACTOR}, {samples:,} samples without excitation:")
    table(
        "rule | mean variance over the prior's, largest | largest error in the silence"
        " | largest after it | samples to recover",
        rows,
    )
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_bytes(plots.to_png(picture(every, samples)))
    ours = every[EVIDENCE]
    bounded = not ours.spoilt and np.nanmax(ours.traces[silent]) <= 1.0
    bars.check(bool(bounded and np.isfinite(ours.to_recover)), ours.name, "windup")
    rows = []
    for row in library(samples):
        cells = [
            f"{row['before']:.2g}, {row['trace']:.2g}", f"{row['moved']:.2f}",
            f"{row['to_recover']:.1f}", f"{100 * row['error']:.2f} %",
        ]  # fmt: skip
        met = row["definite"] and row["trace"] <= 1.0 and row["moved"] <= 1.0
        met = met and row["to_recover"] <= SECONDS
        rows.append([bars.check(met, row["name"], "windup"), *cells])
    print(f"\nThe estimators themselves, at rest for {samples:,} samples at 50 Hz:")
    table(
        " | mean variance over the prior's: before, largest at rest | moved, in std"
        " | s until X_uu + 30 % is within 10 % | off at the end",
        rows,
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=SAMPLES)
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    announce()
    bars = Bars()
    report(options.samples, options.picture, bars)
    return bars.status()


if __name__ == "__main__":
    sys.exit(main())
