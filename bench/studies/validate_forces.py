"""Force tables: drawn structures found again, measured captive runs; the tables of docs/forces.md.

Drawn structures stand in a design of speeds, flow angles, turning circles, fin angles, with noise
that grows with the force. Measured: 81 captive runs of the KVLCC2, where ROV_IDENT_DATA has them.
"""

import numpy as np
from numpy.typing import NDArray

from bench import DATA, ROOT
from bench.harness import announce, table
from rov_ident import config
from rov_ident.model.coefficients import AXES
from rov_ident.offline import captive_tests as force_tables
from rov_ident.steering import autopilot

CAPTIVE = DATA / "kvlcc2-model" / "captive.csv"
DRAWS = 6
DEGREE = np.pi / 180.0
Array = NDArray[np.float64]

TERMS = {
    "X": "X_uu X_vv X_ww X_qq X_rr X_vr X_wq X_uudrdr X_uudsds",
    "Y": "Y_uv Y_vv Y_ur Y_rr Y_uudr Y_v Y_r",
    "Z": "Z_uw Z_ww Z_uq Z_qq Z_uuds Z_w Z_q Z_uu",
    "M": "M_uw M_ww M_uq M_qq M_uuds M_w M_q M_uu",
    "N": "N_uv N_vv N_ur N_rr N_uudr N_v N_r",
}


def design() -> tuple[Array, dict[str, Array]]:
    """States nu (n, 6) and fins: speeds x (alpha, beta, turning circles, fin angles)."""
    rows: list[tuple[float, ...]] = []
    for speed in (0.5, 1.0, 1.5, 2.0):
        for angle in DEGREE * np.array([-12, -8, -4, 0, 4, 8, 12]):
            rows += [(speed, angle, 0, 0, 0, 0, 0), (speed, 0, angle, 0, 0, 0, 0)]
        for radius in (5, 10, 20, -5, -10, -20):
            for angle in DEGREE * np.array([-6, 0, 6]):
                rows.append((speed, 0, angle, 0, speed / radius, 0, 0))
                rows.append((speed, angle, 0, speed / radius, 0, 0, 0))
        for fin in DEGREE * np.array([-20, -10, 10, 20]):
            rows += [(speed, 0, 0, 0, 0, fin, 0), (speed, 0, 0, 0, 0, 0, fin)]
    speeds, alpha, beta, q, r, rudder, stern = np.array(rows, dtype=float).T
    nu = np.zeros((len(speeds), 6))
    nu[:, 0] = speeds * np.cos(alpha) * np.cos(beta)
    nu[:, 1] = speeds * np.sin(beta)
    nu[:, 2] = speeds * np.sin(alpha) * np.cos(beta)
    nu[:, 4], nu[:, 5] = q, r
    return nu, {"r": rudder, "s": stern}


def round_trip() -> None:
    """Whether drawn structures are found again, and their values within the intervals."""
    nu, fins = design()
    rows = []
    for share, what in ((1.0, f"{len(nu)} rows"), (0.35, f"a third of them, {len(nu) // 3}")):
        for noise in (0.01, 0.03, 0.1):
            rng = np.random.default_rng(11)
            right = extra = missing = tried = 0
            inside: list[bool] = []
            errors: list[float] = []
            for _ in range(DRAWS):
                for axis, names in TERMS.items():
                    pool = names.split()
                    count = rng.integers(2, len(pool))
                    chosen = [pool[0], *rng.choice(pool[1:], count, replace=False)]
                    force = np.zeros(len(nu))
                    truth = {}
                    for name in map(str, chosen):
                        column = force_tables.column(name, nu, fins)
                        truth[name] = -rng.uniform(3.0, 10.0) / np.abs(column).max()
                        force += truth[name] * column
                    size = noise * np.sqrt(force**2 + (0.2 * np.std(force)) ** 2)
                    force = force + size * rng.standard_normal(len(nu))
                    rest = rng.random(len(nu)) < share
                    kept = {k: v[rest] for k, v in fins.items()}
                    fit = force_tables.fit_axis(axis, nu[rest], kept, force[rest])
                    tried += 1
                    right += set(fit.names) == set(truth)
                    extra += len(set(fit.names) - set(truth))
                    missing += len(set(truth) - set(fit.names))
                    for name, value, half in zip(fit.names, fit.values, fit.quantile * fit.std):
                        if name in truth and set(fit.names) == set(truth):
                            inside.append(abs(value - truth[name]) <= half)
                            errors.append(abs(value / truth[name] - 1.0))
            rows.append([what, f"{noise:.0%}", f"{right} of {tried}", str(extra), str(missing),
                         f"{np.mean(inside):.1%}", f"{np.median(errors):.2%}"])  # fmt: skip
    head = ["table", "noise", "structure found", "terms too many", "terms missing",
            "values in their 95 % intervals", "median error"]  # fmt: skip
    table(head, rows, "Drawn structures, 3 to 9 terms an axis")


def captive() -> None:
    """The measured captive runs of the KVLCC2."""
    if not CAPTIVE.exists():
        print("\n(The measured captive runs are not here: set ROV_IDENT_DATA.)")
        return
    columns = {"U_mps": "Speed(m/s)", "beta_deg": "beta(deg)", "rudder_deg": "delta(deg)"}
    read = force_tables.read_table(CAPTIVE, columns, {"rho": 1000.0, "L": 7.0})
    rows = []
    for axis, f in force_tables.fit(read).items():
        values = ", ".join(
            f"{n} = {v:.4g} ± {h:.2g}" for n, v, h in zip(f.names, f.values, f.quantile * f.std)
        )
        best = f.candidates[0]
        rows.append([axis, values, f"{f.cv_rmse:.3g}", f"{best.cv_rmse:.3g} ({len(best.terms)})",
                     f"{f.r2:.4f}"])  # fmt: skip
    head = ["axis", "chosen, ± half of the 95 % interval", "cross-validated error [N, N m]",
            "least of all (terms)", "R2"]  # fmt: skip
    table(head, rows, "KVLCC2, 81 captive runs, rho 1000 kg/m3, L 7 m")


def vehicle() -> None:
    """The REMUS 100 as a table, fitted, and the fitted vehicle's manoeuvres beside its own."""
    own = config.load(ROOT / "config" / "remus100.yaml")
    nu, fins = design()
    rng = np.random.default_rng(2)
    down, still = np.array([0.0, 0.0, 1.0]), np.zeros(6)
    forces = np.empty((len(nu), 6))
    body = config.load(ROOT / "config" / "remus100.yaml").model.body.mass_matrix
    for i, state in enumerate(nu):
        p = body @ state
        rigid = np.append(
            np.cross(state[3:], p[:3]), np.cross(state[3:], p[3:]) + np.cross(state[:3], p[:3])
        )
        push = own.model.input_wrench(
            state, np.array([fins[k][i] if k in fins else 0.0 for k in "sran"])
        )
        needed = own.model.wrench(state, still, down) - own.model.restoring_force(down)
        forces[i] = rigid - needed + push
    forces += 0.02 * np.abs(forces) * rng.standard_normal(forces.shape)
    measured = {axis: forces[:, AXES.index(axis)] for axis in "XYZMN"}
    fits = force_tables.fit(force_tables.ForceTable("REMUS 100", nu, fins, measured), own.model)
    made = force_tables.configured(own, fits).model
    known = own.model.values
    rows = []
    for axis, f in fits.items():
        cells = [f"{n} {v:.4g} ± {h:.2g} ({known.get(n, 0.0):g})"
                 for n, v, h in zip(f.names, f.values, f.quantile * f.std)]  # fmt: skip
        hidden = [n for n in known if n[0] == axis and n in f.pool and n not in f.names]
        rows.append([axis, ", ".join(cells), ", ".join(f"{n} ({known[n]:g})" for n in hidden)])
    head = ["axis", "found ± half of the interval (true)", "not found (true)"]
    table(head, rows, "REMUS 100 from its own table, 2 % noise, added mass known")

    laws: dict[str, autopilot.Law] = {
        "dive to 5 m": autopilot.to_depth(5.0, -1.0),
        "heading change by 60 deg": autopilot.to_heading(60.0 * DEGREE, -1.0),
        "turn, rudder 10 deg": autopilot.turn(10.0 * DEGREE),
    }
    rows = []
    for name, law in laws.items():
        a, b = (autopilot.steer(m, law, 60.0, 1.5) for m in (own.model, made))
        far = np.linalg.norm(a.position - b.position, axis=1)
        turn = np.degrees(np.abs(a.angles[:, 2] - b.angles[:, 2]))
        rows.append([name, f"{a.position[-1, 2]:.2f} / {b.position[-1, 2]:.2f}",
                     f"{np.degrees(a.angles[-1, 2]):.1f} / {np.degrees(b.angles[-1, 2]):.1f}",
                     f"{far.max():.2f}", f"{turn.max():.2f}"])  # fmt: skip
    head = ["60 s at 1.5 m/s", "depth at the end [m], true / fitted", "heading at the end [deg]",
            "largest distance apart [m]", "largest heading apart [deg]"]  # fmt: skip
    table(head, rows, "The vehicle from the table beside the true one")


if __name__ == "__main__":
    announce()
    round_trip()
    captive()
    vehicle()
