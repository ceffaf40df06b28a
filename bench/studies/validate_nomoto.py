"""Nomoto's model from zigzags, held against the literature: the tables of docs/nomoto.md.

The REMUS 100 of config/remus100.yaml in simulated zigzags (six degrees of freedom, servo of
20 deg/s, depth held by the stern planes), sampled and densified; data of the linear model; measured
zigzags of the KVLCC2 where ROV_IDENT_DATA has them.
"""

import sys
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

import bench
from bench import ROOT
from bench.harness import announce, table
from rov_ident import config
from rov_ident.core.errors import UserError
from rov_ident.steering import autopilot, nomoto, nomoto_model
from rov_ident.steering.heading_interpolation import densify
from rov_ident.steering.nomoto_model import Nomoto
from rov_ident.steering.zigzag import Zigzag, read

DATA = bench.DATA / "kvlcc2-model"
DENSE = 0.1  # s
SEEDS = 3
DEGREE = np.pi / 180.0


def remus(rudder: float, switch: float) -> Zigzag:
    """A zigzag of the REMUS 100 every DENSE seconds; angles in deg."""
    model = config.load(ROOT / "config" / "remus100.yaml").model
    return every(
        autopilot.manoeuvre(model, "zigzag", rudder * DEGREE, switch * DEGREE).zigzag(), DENSE
    )


def every(run: Zigzag, step: float) -> Zigzag:
    k = round(step / (run.t[1] - run.t[0]))
    return replace(run, t=run.t[::k], heading=run.heading[::k], rudder=run.rudder[::k])


def blanked(run: Zigzag, step: float) -> Zigzag:
    """Headings every ``step`` only, the whole rudder."""
    rows = np.arange(len(run.t)) % round(step / (run.t[1] - run.t[0])) == 0
    return replace(run, heading=np.where(rows, run.heading, np.nan))


def noisy(run: Zigzag, degrees: float, seed: int) -> Zigzag:
    error = degrees * DEGREE * np.random.default_rng(seed).standard_normal(len(run.t))
    return replace(run, heading=run.heading + error)


def k_and_t(model: Nomoto) -> tuple[float, float]:
    return model.value("K"), model.value("T")


def errors(model: Nomoto, truth: Nomoto) -> tuple[float, float]:
    """Of K and T, in percent of another fit's."""
    (k, t), (k0, t0) = k_and_t(model), k_and_t(truth)
    return 100.0 * (k / k0 - 1.0), 100.0 * (t / t0 - 1.0)


def claims(manoeuvres: dict[str, Zigzag]) -> None:
    """The literature's comparison, each estimator against its own fit to the dense data."""
    rows = []
    for name, dense in manoeuvres.items():
        best = nomoto.fit([dense])
        for method in ("fd", "oe"):
            own = nomoto.fit([dense], method=method)
            cases: list[tuple[str, Zigzag, str]] = [("0.1 s", dense, "none")]
            cases += [(f"{s} s, as it is", every(dense, s), "none") for s in (0.2, 0.5)]
            for way in ("spline", "spiral"):
                cases.append((f"0.5 s, {way}, rudder at 0.1 s", blanked(dense, 0.5), way))
                cases.append((f"0.5 s, {way}, rudder at 0.5 s", every(dense, 0.5), way))
            for what, run, way in cases:
                model = nomoto.fit([run], method=method, interpolate=way, step=_step(run, way))
                k, t = errors(model, own)
                rmse = nomoto_model.predict(model, dense)[1]
                values = "{:.4f} | {:.4f}".format(*k_and_t(model))
                rows.append([name, method, what, values, f"{k:+.2f}", f"{t:+.2f}",
                             f"{0.5 * (abs(k) + abs(t)):.2f}", f"{rmse:.4f}",
                             f"{rmse / best.rmse:.2f}"])  # fmt: skip
    head = ["zigzag", "by", "data", "K [1/s] | T [s]", "K %", "T %", "mean %",
            "heading RMSE on the dense data [rad]", "over the best"]  # fmt: skip
    table(head, rows, "REMUS 100: errors against the same estimator's fit to the 0.1 s data")


def _step(run: Zigzag, way: str) -> float | None:
    return DENSE if way != "none" and run.known.all() else None


def spline_or_spiral(dense: Zigzag) -> None:
    """With noise, from other rates, in other units: heading error and errors of K and T."""
    own = {method: nomoto.fit([dense], method=method) for method in ("fd", "oe")}
    rows = []
    for step in (0.2, 0.5, 1.0):
        for noise in (0.0, 0.05, 0.2):
            for way, scale in (("none", 1.0), ("spline", 1.0), ("spiral", 1.0), ("spiral", 57.3)):
                found = [_one(dense, own, step, noise, way, scale, seed)
                         for seed in range(SEEDS if noise else 1)]  # fmt: skip
                heading, fd_k, fd_t, oe_k, oe_t = np.median(np.abs(found), axis=0)
                unit = (
                    ""
                    if way != "spiral"
                    else ", in rad and s"
                    if scale == 1.0
                    else ", in deg and s"
                )
                rows.append([f"{step} s", f"{noise} deg", way + unit, f"{1e3 * heading:.2f}",
                             f"{fd_k:.2f} / {fd_t:.2f}", f"{oe_k:.2f} / {oe_t:.2f}"])  # fmt: skip
    head = ["heading every", "noise", "densified by", "heading error, RMS [mrad]",
            "K / T % by differences", "K / T % by output error"]  # fmt: skip
    table(head, rows, f"Spline or spiral? (15/15, rudder at 0.1 s, medians of {SEEDS} seeds)")


def _one(
    dense: Zigzag,
    own: dict[str, Nomoto],
    step: float,
    noise: float,
    way: str,
    scale: float,
    seed: int,
) -> list[float]:
    sparse = blanked(noisy(dense, noise, seed), step)
    known = sparse.known
    last = int(np.flatnonzero(known)[-1]) + 1
    heading = densify(sparse.t[known], sparse.heading[known], sparse.t[:last], way, scale)
    out = [float(np.sqrt(np.mean((heading - dense.heading[:last]) ** 2)))]
    filled = replace(sparse, t=sparse.t[:last], heading=heading, rudder=sparse.rudder[:last])
    for method in ("fd", "oe"):
        try:
            out += errors(nomoto.fit([filled], method=method), own[method])
        except UserError:
            out += [np.nan, np.nan]
    return out


def linear() -> None:
    """Data of the linear model itself: every estimator at every rate."""
    rows = []
    for k, t in ((-0.92, 0.95), (0.3, 4.0)):
        run = of_the_model(k, t, 20.0 * DEGREE, 15.0 * DEGREE)
        for step in (0.1, 0.2, 0.5):
            for noise in (0.0, 0.1):
                cells = []
                for method in nomoto.METHODS:
                    found = [_relative(noisy(every(run, step), noise, seed), method, k, t)
                             for seed in range(SEEDS if noise else 1)]  # fmt: skip
                    cells.append("{:.2f} / {:.2f}".format(*np.median(np.abs(found), axis=0)))
                rows.append([f"{k}, {t}", f"{step} s", f"{noise} deg", *cells])
    head = ["K [1/s], T [s]", "sampled at", "noise", *nomoto.METHODS]
    table(head, rows, "Data of the linear model: errors of K / T in % (medians over seeds)")


def of_the_model(k: float, t: float, rate: float, angle: float) -> Zigzag:
    """A zigzag of T r' + r = K delta, 100 s every 0.01 s, by its exact solution on ramps."""
    step, n = 0.01, 10001
    heading, rudder, r = np.zeros(n), np.zeros(n), 0.0
    law = autopilot.Kempf(angle, angle, begin=2.0)
    decay = np.exp(-step / t)
    for i in range(n - 1):
        now = autopilot.Now(i * step, np.zeros(3), np.array([0.0, 0.0, heading[i]]), np.zeros(6))
        wanted = law(now)["r"]
        rudder[i + 1] = rudder[i] + np.clip(wanted - rudder[i], -rate * step, rate * step)
        slope = (rudder[i + 1] - rudder[i]) / step
        # r = K (delta - slope T) + transient
        transient = r - k * (rudder[i] - slope * t)
        mean = k * (0.5 * (rudder[i] + rudder[i + 1]) - slope * t)
        heading[i + 1] = heading[i] + mean * step + transient * t * (1.0 - decay)
        r = k * (rudder[i + 1] - slope * t) + transient * decay
    return Zigzag("linear", step * np.arange(n), heading, rudder)


def _relative(run: Zigzag, method: str, k: float, t: float) -> tuple[float, float]:
    try:
        found = k_and_t(nomoto.fit([run], method=method))
    except (UserError, np.linalg.LinAlgError):
        return np.nan, np.nan
    return 100.0 * (found[0] / k - 1.0), 100.0 * (found[1] / t - 1.0)


def _from_start(model: Nomoto, run: Zigzag, window: float) -> float:
    """RMSE [rad] of a prediction whose first state is fitted to the first ``window`` s alone."""
    fine, what = run.cornered(), (model.structure, model.theta)
    seen = replace(fine, heading=np.where(fine.t <= fine.t[0] + window, fine.heading, np.nan))
    heading = nomoto_model.respond(*what, fine, *nomoto_model.first_state(*what, seen))
    return nomoto_model.rmse(fine.heading - heading)


def measured() -> None:
    """KVLCC2, model of 7 m: fitted to two zigzags, the third predicted."""
    if not DATA.is_dir():
        print("\n(The measured zigzags are not here: set ROV_IDENT_DATA.)")
        return
    runs = {a: read(DATA / f"hsva_Z_{a}_05.csv") for a in (10, 20, 25)}
    rows = []
    for fitted, judged in (((10, 25), 20), ((10, 20), 25)):
        for order in (1, 2):
            for nonlinear in (False, True):
                model = nomoto.fit([runs[a] for a in fitted], order, nonlinear)
                of_run = np.degrees(nomoto_model.predict(model, runs[judged])[1])
                of_start = np.degrees(_from_start(model, runs[judged], 20.0))
                rows.append([" + ".join(f"{a}/5" for a in fitted), f"{judged}/5", str(order),
                             "Norrbin" if nonlinear else "linear", f"{np.degrees(model.rmse):.2f}",
                             f"{of_run:.2f}", f"{of_start:.2f}"])  # fmt: skip
    head = ["fitted to", "predicted", "order", "model", "fitted [deg]", "predicted [deg]",
            "predicted, first state from 20 s alone"]  # fmt: skip
    table(head, rows, "KVLCC2, measured at HSVA: RMSE of the heading")
    full = read(DATA / "marin_zz_20_m.csv")
    rows = []
    for order in (1, 2):
        for nonlinear in (False, True):
            model = nomoto.fit([full], order, nonlinear)
            k, t = k_and_t(model)
            rows.append([str(order), "Norrbin" if nonlinear else "linear", f"{k:.4f}", f"{t:.1f}",
                         f"{np.degrees(model.rmse):.2f}"])  # fmt: skip
    title = "KVLCC2 at full scale (MARIN): fitted, RMSE of the heading"
    table(["order", "model", "K [1/s]", "T [s]", "deg"], rows, title)


def main(parts: Sequence[str]) -> None:
    """The tables, or those named: claims, spline, linear, measured."""
    announce()
    runs: dict[str, Zigzag] = {}
    if not parts or {"claims", "spline"} & set(parts):
        runs = {f"{a}/{a}": remus(float(a), float(a)) for a in (15, 10, 20)}
    tables: dict[str, Callable[[], None]] = {
        "claims": lambda: claims(runs),
        "spline": lambda: spline_or_spiral(runs["15/15"]),
        "linear": linear,
        "measured": measured,
    }
    for name, show in tables.items():
        if not parts or name in parts:
            show()


if __name__ == "__main__":
    main(sys.argv[1:])
