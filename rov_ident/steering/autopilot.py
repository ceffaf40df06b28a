"""Closed-loop simulation of a vehicle with fins: zigzag, turn, heading change, dive to depth.

A law looks at the motion and orders fin angles; servos follow at a limited rate; the fins' wrench
``u^2 delta`` acts beside the propeller's. The equations of motion are those of
:mod:`rov_ident.simulation.open_loop`, run from control step to control step.
"""

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from rov_ident.core.errors import UserError
from rov_ident.core.frames import quaternion_to_euler, wrap_angle
from rov_ident.core.messages import Array
from rov_ident.model.equations import Model
from rov_ident.simulation.open_loop import simulate
from rov_ident.steering.zigzag import Zigzag


class Now(NamedTuple):
    """What a law sees: time [s], position (3,) NED [m], roll pitch yaw (3,) [rad, yaw continuous],
    nu (6,)."""

    t: float
    position: Array
    angles: Array
    nu: Array


Law = Callable[[Now], Mapping[str, float]]
"""Orders fin angles [rad] by letter: s, r, a; a letter left out stays at zero."""


@dataclass(frozen=True)
class Servo:
    """What the fins can do: rate [rad/s], limit [rad]."""

    rate: float = float(np.radians(20.0))
    limit: float = float(np.radians(35.0))


@dataclass(frozen=True)
class Run:
    """t (n,), position (n, 3), angles (n, 3) roll pitch yaw, nu (n, 6), fins {letter: (n,)}."""

    t: Array
    position: Array
    angles: Array
    nu: Array
    fins: Mapping[str, Array]

    def zigzag(self, name: str = "simulated") -> Zigzag:
        """Heading and rudder."""
        return Zigzag(name, self.t, self.angles[:, 2], self.fins["r"])


def steer(
    model: Model,
    law: Law,
    duration: float,
    speed: float,
    servo: Servo = Servo(),
    step: float = 0.02,
    depth: float = 0.0,
) -> Run:
    """Run a law for ``duration`` [s] from straight level motion at ``speed`` [m/s].

    The propeller keeps the thrust of that speed. Fin angles are linear within a step, of which
    their wrench takes the middle.

    Raises UserError if the vehicle has no fins in its coefficients, or the motion diverges.
    """
    if not model.fins:
        raise UserError(
            "the vehicle has no fin coefficients: add N_uudr, Y_uudr (rudder) and M_uuds, Z_uuds "
            "(stern planes) to coefficients"
        )
    n = round(duration / step) + 1
    position, orientation = np.array([0.0, 0.0, depth]), np.array([1.0, 0.0, 0.0, 0.0])
    nu, surge = np.eye(6)[0] * speed, np.eye(6)[0]
    thrust = surge * model.wrench(nu, np.zeros(6), np.array([0.0, 0.0, 1.0]))
    angles = np.zeros(3)
    fins = dict.fromkeys("sra", 0.0)
    out = np.empty((n, 15))
    for i in range(n):
        out[i] = np.concatenate([position, angles, nu, [fins["s"], fins["r"], fins["a"]]])
        ordered = law(Now(i * step, position, angles, nu))
        middle = {}
        for letter, now in fins.items():
            wanted = np.clip(ordered.get(letter, 0.0), -servo.limit, servo.limit)
            fins[letter] = now + float(np.clip(wanted - now, -servo.rate * step, servo.rate * step))
            middle[letter] = 0.5 * (now + fins[letter])
        push = thrust + model.fin_wrench(nu[0], middle)
        both = np.array([0.0, step]), np.tile(push, (2, 1))
        run = simulate(model, *both, nu, position, orientation)
        position, orientation, nu = run.position[1], run.orientation[1], run.nu[1]
        yaw = angles[2]
        angles = np.array(quaternion_to_euler(orientation))
        angles[2] = yaw + wrap_angle(angles[2] - yaw)
    t: Array = step * np.arange(n, dtype=np.float64)
    return Run(t, out[:, :3], out[:, 3:6], out[:, 6:12], dict(zip("sra", out[:, 12:].T)))


_STEEPEST = float(np.radians(25.0))  # pitch on the way to a depth


def to_depth(target: float, sign: float) -> Law:
    """Stern planes to a depth [m]: the error asks for a pitch, the pitch for an angle.

    ``sign`` is that of M_uuds: negative, a positive angle turns the nose down.
    """

    def law(now: Now) -> dict[str, float]:
        wanted = np.clip(0.2 * (now.position[2] - target), -_STEEPEST, _STEEPEST)
        return {"s": sign * (1.5 * (wanted - now.angles[1]) - now.nu[4])}

    return law


def to_heading(target: float, sign: float) -> Law:
    """Rudder to a heading [rad]; ``sign`` is that of N_uudr."""
    return lambda now: {"r": sign * (float(wrap_angle(target - now.angles[2])) - now.nu[5])}


def turn(angle: float) -> Law:
    """The rudder put to an angle [rad] after 5 s and left there."""
    return lambda now: {"r": angle if now.t >= 5.0 else 0.0}


def both(*laws: Law) -> Law:
    """Several laws, each for fins of its own."""
    return lambda now: {letter: x for law in laws for letter, x in law(now).items()}


@dataclass
class Kempf:
    """Zigzag (Kempf 1943): the rudder is reversed whenever the heading has come ``switch`` [rad]
    off the first course on the side it is turning to. Which side that is shows by itself."""

    rudder: float
    switch: float
    begin: float = 5.0
    _side: float = field(default=1.0, init=False)
    _last: float = field(default=0.0, init=False)

    def __call__(self, now: Now) -> dict[str, float]:
        if now.t < self.begin:
            return {"r": 0.0}
        off = now.angles[2]
        if abs(off) >= self.switch and np.sign(off) != self._last:
            self._side, self._last = -self._side, float(np.sign(off))
        return {"r": self._side * self.rudder}


MANOEUVRES = ("zigzag", "turn", "heading", "dive")


def manoeuvre(
    model: Model,
    name: str,
    angle: float,
    switch: float | None = None,
    depth: float = 5.0,
    duration: float = 100.0,
    speed: float = 1.5,
    servo: Servo = Servo(),
) -> Run:
    """A manoeuvre by name, the depth held where the vehicle has stern planes.

    ``angle`` [rad] is the rudder's for `zigzag` (reversed at ``switch``, the same by default) and
    `turn`, the course for `heading`; `dive` goes to ``depth`` [m].

    Raises UserError for an unknown name, or fins that the vehicle lacks for it.
    """
    yaw, pitch = (float(np.sign(model.fins.get(key, 0.0))) for key in ("N_uudr", "M_uuds"))
    if not (pitch if name == "dive" else yaw):
        lacking = "M_uuds" if name == "dive" else "N_uudr"
        raise UserError(f"the vehicle has no {lacking}: add it to coefficients for a {name}")
    laws: dict[str, Law] = {
        "zigzag": Kempf(angle, angle if switch is None else switch),
        "turn": turn(angle),
        "heading": to_heading(angle, yaw),
        "dive": to_depth(depth, pitch),
    }
    if name not in laws:
        raise UserError(f"there is no manoeuvre '{name}': choose one of {', '.join(MANOEUVRES)}")
    law = laws[name]
    if name != "dive" and pitch:
        law = both(law, to_depth(0.0, pitch))
    return steer(model, law, duration, speed, servo)


def to_csv(run: Run, step: float, heading_noise: float = 0.0, seed: int = 0) -> str:
    """The run every ``step`` [s] as a CSV that `nomoto` reads; white heading noise [rad]."""
    k = max(1, round(step / (run.t[1] - run.t[0])))
    noise = heading_noise * np.random.default_rng(seed).standard_normal(len(run.t))
    columns = {
        "t_s": run.t,
        "heading_deg": np.degrees(run.angles[:, 2] + noise),
        "rudder_deg": np.degrees(run.fins["r"]),
        "stern_deg": np.degrees(run.fins["s"]),
        **dict(zip(("x_m", "y_m", "z_m"), run.position.T)),
        **dict(zip(("roll_deg", "pitch_deg"), np.degrees(run.angles[:, :2].T))),
        **dict(zip("uvwpqr", run.nu.T)),
    }
    text = io.StringIO()
    rows = np.column_stack(list(columns.values()))[::k]
    np.savetxt(text, rows, "%.9g", ",", header=",".join(columns), comments="")
    return text.getvalue()
