"""Dives made by another hand: PythonVehicleSimulator's REMUS 100, unmodified (docs/offline.md).

    python -m bench.studies.another_hand PATH_OF_A_CHECKOUT [--explain]

The simulator is T. I. Fossen's (github.com/cybergalactic/PythonVehicleSimulator, MIT licence); its
class `remus100` steers itself to depths and courses, which change during a dive. Its equations are
not ours: no Munk moment in yaw, lift and drag of the hull by angle of attack, strip-wise cross-flow
drag, a propeller by K_T(J), fins with a lag of 0.1 s, Euler's method at 50 Hz. Velocities, attitude
and depth get noise; fins and shaft are those that act. Fitted on two dives, judged on others.
"""

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import rov_ident as ri
from bench.harness import announce, table
from rov_ident import config as configuration
from rov_ident.config import Config
from rov_ident.core.frames import quaternion_from_euler
from rov_ident.core.messages import DRIVE, ODOMETRY, WRENCH, Array, Joints, Odometry, Wrench
from rov_ident.io.write_messages import write_messages
from rov_ident.model.added_mass import cylinder

STEP = 0.02  # s, as the simulator's main program has it
DURATION = 150.0  # s
SECOND = 1_000_000_000
DIVES = {
    "a, fitted": (1, 0.0), "b, fitted": (2, 0.0), "c": (3, 0.0), "d": (4, 0.0),
    "e, current 0.3 m/s": (5, 0.3),
}  # fmt: skip


def dive(vehicle: Any, attitude: Any, seed: int) -> tuple[Array, Array, Array]:
    """nu (N, 6), eta (N, 6) and rudder, stern planes, rpm (N, 3) as they act, every STEP."""
    rng = np.random.default_rng(seed)
    eta, nu, actual = np.zeros(6), vehicle.nu, vehicle.u_actual
    out, change = [], np.zeros(3)
    for k in range(round(DURATION / STEP)):
        t = k * STEP
        for i, longest in enumerate((25.0, 15.0, 20.0)):
            if t >= change[i]:
                change[i] = t + rng.uniform(0.4, 1.0) * longest
                drawn = (rng.uniform(1.0, 15.0), rng.uniform(-90.0, 90.0), rng.uniform(700, 1500))
                setattr(vehicle, ("ref_z", "ref_psi", "ref_n")[i], drawn[i])
        asked = vehicle.depthHeadingAutopilot(eta, nu, STEP)
        most = np.array([vehicle.deltaMax_r, vehicle.deltaMax_s, vehicle.nMax])
        out.append(np.concatenate([nu, eta, np.clip(actual, -most, most)]))
        nu, actual = vehicle.dynamics(eta, nu.copy(), actual, asked, STEP)
        eta = attitude(eta, nu, STEP)
    rows = np.array(out)
    return rows[:, :6], rows[:, 6:12], rows[:, 12:]


def write(path: Path, nu: Array, eta: Array, actual: Array, seed: int) -> None:
    """The dive as a bag: odometry at 25 Hz, joints at 50 Hz, and a wrench of zero."""
    rng = np.random.default_rng([seed, 1])
    frames, none, messages = ("odom_ned", "base_link_frd"), np.zeros(3), []
    variance = np.repeat([0.008**2, 0.003**2], 3)
    for k, (v, pose, given) in enumerate(zip(nu, eta, actual, strict=True)):
        at = SECOND + round(k * STEP * SECOND)
        noise = rng.standard_normal(12)
        drives = Joints(
            at, "", ("rudder", "stern_planes", "propeller"), np.array([*given[:2], 0.0]),
            np.array([0.0, 0.0, given[2] / 60.0 * 2.0 * np.pi]),
        )  # fmt: skip
        messages += [(at, WRENCH, Wrench(at, frames[1], none, none)), (at, DRIVE, drives)]
        if k % 2 == 0:
            q = quaternion_from_euler(*(pose[3:] + 0.002 * noise[:3]))
            p = pose[:3] + 0.02 * noise[3:6]
            moved = v + np.sqrt(variance) * noise[6:]
            odometry = Odometry(at, *frames, p, q, moved[:3], moved[3:], variance)
            messages.append((at, ODOMETRY, odometry))
    write_messages(path, messages)


def begun(vehicle: Any) -> Config:
    """What is known of such a vehicle beforehand: its rigid body, a cylinder's added mass, fins and
    drag of a textbook's size; products of velocities and linear damping at nothing."""
    shipped = configuration.load(Path(__file__).parents[2] / "config" / "remus100.yaml")
    plain = configuration.to_parameters(shipped)
    plain.pop("estimate", None)
    mass, cog = vehicle.MRB[0, 0], vehicle.r_bg
    about = [vehicle.MRB[i, i] for i in (3, 4, 5)]
    about[0], about[1] = about[0] - mass * cog[2] ** 2, about[1] - mass * cog[2] ** 2
    plain["vehicle"] |= {
        "mass": float(mass), "weight": float(vehicle.W), "buoyancy": float(vehicle.B),
        "cog": [float(x) for x in cog], "cob": [float(x) for x in vehicle.r_bb],
        "inertia": [*map(float, about), 0.0, 0.0, 0.0],
    }  # fmt: skip
    added = {**cylinder(vehicle.L, 0.5 * vehicle.diam, vehicle.rho), "K_pdot": -0.01}
    drag = {"X_uu": -3.0, "Y_vv": -100.0, "Z_ww": -100.0, "K_p": -0.1, "M_q": -5.0, "N_r": -5.0}
    products = "Y_uv Y_ur Z_uw Z_uq M_uw M_uq N_uv N_ur X_vr X_wq Y_v Z_w M_qq N_rr"
    products += " Y_v_abs_r Z_w_abs_q"
    fins = {"Y_uudr": -6.0, "N_uudr": 5.0, "Z_uuds": -6.0, "M_uuds": -5.0}
    fins |= {"X_uudrdr": -3.0, "X_uudsds": -3.0}
    propeller = {"X_nn": 0.1, "X_un": -0.5, "K_nn": 1e-3, "K_un": -5e-3}
    plain["coefficients"] = {**added, **drag, **dict.fromkeys(products.split(), 0.0), **fins}
    plain["coefficients"] |= propeller
    plain["inputs"] = {
        "delta_r": {"joint": "rudder"}, "delta_s": {"joint": "stern_planes"},
        "n": {"joint": "propeller"},
    }  # fmt: skip
    return configuration.from_parameters(plain)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checkout", type=Path, help="of PythonVehicleSimulator")
    parser.add_argument("--explain", action="store_true", help="and what explain finds")
    options = parser.parse_args()
    sys.path.insert(0, str(options.checkout / "src"))
    from python_vehicle_simulator.lib.gnc import attitudeEuler
    from python_vehicle_simulator.vehicles.remus100 import remus100

    announce()
    with tempfile.TemporaryDirectory() as folder:
        bags = {}
        for name, (seed, current) in DIVES.items():
            vehicle = remus100("depthHeadingAutopilot", 5, 0, 1200, current, 30.0)
            bags[name] = Path(folder) / f"{name[0]}.mcap"
            write(bags[name], *dive(vehicle, attitudeEuler, seed), seed)
        config = begun(remus100())
        fitted = [bags["a, fitted"], bags["b, fitted"]]
        found = ri.fit(fitted, config, "ml")
        print(found.table(), *found.notes, sep="\n", flush=True)
        models = {"as begun": config, "fitted": found.fitted}
        if options.explain:
            told = ri.explain(fitted, found.fitted)
            print(told.table())
            told.save(Path(folder) / "told")
            models["explained"] = configuration.load(Path(folder) / "told" / "extended.yaml")
        rows = []
        for name, bag in bags.items():
            for what, model in models.items():
                score = ri.simulate(model, bag=bag).windows
                rows.append([name, what, *(f"{x:.4f}" for x in score.rmse)])
        table(["dive", "model", *"uvwpqr"], rows)


if __name__ == "__main__":
    main()
