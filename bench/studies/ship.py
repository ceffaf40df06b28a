"""A measured ship in three axes: KVLCC2, 7 m model, free zigzags of the HSVA (docs/offline.md).

    python -m bench.studies.ship [--figure FILE.svg]

Where ROV_IDENT_DATA has the runs. By the commands a user would type: `import` with columns in
degrees, `fit` of surge, sway and yaw on the zigzags 20/5 and 25/5, `simulate` on those and on
10/5 and 10/1, which no fit has seen. X, Y, N with rudder and propeller; other axes were not
measured. Mass and inertia are those of the model's displacement and of a radius of gyration of a
quarter of its length (SIMMAN 2008: 312,622 m3 at 320 m, 11.2 m ahead of the middle).
"""

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np
from scipy.signal import savgol_filter

from bench import DATA
from bench.harness import announce, table
from rov_ident import config as configuration
from rov_ident.cli import main as program

FITTED, OTHERS = ("hsva_Z_20_05", "hsva_Z_25_05"), ("hsva_Z_10_05", "hsva_Z_10_01")
SCALE = 320.0 / 7.0
MASS = 1000.0 * 312_622.0 / SCALE**3  # kg
COLUMNS = (
    *("u=u_mps", "v=v_mps", "r=r_degps", "w=0", "p=0", "q=0", "x=x_m", "y=y_m", "z=0"),
    *("roll=0", "pitch=0", "yaw=heading_deg", "delta_r=rudder_deg", "rpm=prop_rps"),
)


def begun() -> configuration.Config:
    """Magnitudes alone: added mass of half a cylinder, a drag of 40 N at 1.2 m/s and the propeller
    against it, linear damping and a rudder of a ship's size; no product of velocities."""
    turn = MASS * (0.25 * 7.0) ** 2
    coefficients = {
        "X_udot": -0.05 * MASS, "Y_vdot": -0.8 * MASS, "N_rdot": -0.7 * turn, "Y_rdot": 0.0,
        "X_uu": -28.0, "X_vv": 0.0, "X_rr": 0.0, "X_vr": 0.0, "X_uudrdr": -30.0, "X_nn": 0.38,
        "Y_uv": -700.0, "Y_ur": 1000.0, "N_uv": -2000.0, "N_ur": -3000.0,
        "Y_vv": -1000.0, "N_rr": -3000.0, "Y_v_abs_r": 0.0, "N_v_abs_r": 0.0,
        "Y_uudr": 100.0, "N_uudr": -350.0,
    }  # fmt: skip
    return configuration.from_parameters(
        {
            "vehicle": {
                "name": "kvlcc2_7m", "frame": "frd", "mass": MASS, "weight": 9.81 * MASS,
                "buoyancy": 9.81 * MASS, "cog": [11.2 / SCALE, 0.0, 0.0], "cob": [0.245, 0.0, 0.0],
                "inertia": [0.1 * turn, turn, turn, 0.0, 0.0, 0.0],
            },
            "coefficients": coefficients,
            # revolutions a second stand in a column of revolutions a minute
            "inputs": {"delta_r": {"joint": "delta_r"}, "n": {"joint": "n", "scale": 9.5493}},
        }
    )  # fmt: skip


def along_track(source: Path, out: Path) -> None:
    """The log with surge and sway from its track and heading, over 2 s: its own `v_mps` is none of
    them. It is as large as the whole velocity across the first course, and hardly follows the rate
    of turn (correlation -0.4), where the track drifts outwards in every turn (-0.83 to -0.91)."""
    lines = [line for line in source.read_text().splitlines() if not line.startswith("#")]
    head, rows = lines[0].split(","), np.array([line.split(",") for line in lines[1:]], dtype=float)
    at = {name: head.index(name) for name in ("x_m", "y_m", "heading_deg", "u_mps", "v_mps")}
    heading = np.radians(rows[:, at["heading_deg"]])
    north, east = (savgol_filter(rows[:, at[n]], 41, 2, 1, 0.05) for n in ("x_m", "y_m"))
    rows[:, at["u_mps"]] = north * np.cos(heading) + east * np.sin(heading)
    rows[:, at["v_mps"]] = east * np.cos(heading) - north * np.sin(heading)
    np.savetxt(out, rows[40:-40], "%.7g", ",", header=",".join(head), comments="")


def command(*words: object) -> None:
    if program([str(word) for word in words]):
        raise SystemExit(1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--figure", type=Path, help="predicted against measured, of the first run")
    options = parser.parse_args()
    announce()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        configuration.dump(begun(), folder / "begun.yaml", "Magnitudes alone.")
        for run in (*FITTED, *OTHERS):
            log = folder / f"{run}.csv"
            along_track(DATA / "kvlcc2-model" / log.name, log)
            command("import", log, "--out", folder / f"{run}.mcap", "--map", *COLUMNS,
                    "--degrees", "r", "yaw", "delta_r")  # fmt: skip
        bags = [folder / f"{run}.mcap" for run in FITTED]
        command("fit", *bags, "--config", folder / "begun.yaml", "--estimator", "ml",
                "--channels", "surge,sway,yaw", "--save", folder / "fitted.yaml")  # fmt: skip
        rows = []
        for run in (*FITTED, *OTHERS):
            for model in ("begun", "fitted"):
                out = folder / f"{run}_{model}"
                command("simulate", "--config", folder / f"{model}.yaml", "--channels",
                        "surge,sway,yaw", "--bag", folder / f"{run}.mcap", "--out", f"{out}.mcap",
                        "--json", f"{out}.json")  # fmt: skip
                told = json.loads(Path(f"{out}.json").read_text())["velocities"]
                what = "fitted" if run in FITTED else "not fitted"
                cells = [f"{told[c][k]:.4f}" for k in ("rmse", "rmse_windows") for c in "uvr"]
                cells += [f"{told[c]['r2']:.2f}" for c in "uvr"]
                rows.append([run, what, model, *cells])
        head = ["run", "", "model", "u, whole run", "v", "r", "u, 10 s", "v", "r", "R2 u", "v", "r"]
        table(head, rows, "RMSE in open loop (m/s, rad/s)")
        if options.figure:
            import rov_ident as ri

            shown = ri.simulate(
                folder / "fitted.yaml", bag=folder / f"{OTHERS[0]}.mcap", channels="surge,sway,yaw"
            )
            shown.save(options.figure)


if __name__ == "__main__":
    main()
