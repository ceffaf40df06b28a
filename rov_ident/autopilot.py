"""Closed-loop simulation of a vehicle with fins: zigzag, turn, heading change, dive to depth.

A law looks at the motion and orders fin angles; servos follow at a limited rate; the fins' wrench
``u^2 delta`` acts beside the propeller's. The equations of motion are those of
:mod:`rov_ident.simulate`, run from control step to control step.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from rov_ident.errors import UserError
from rov_ident.frames import quaternion_to_euler, wrap_angle
from rov_ident.messages import Array
from rov_ident.model import Model
from rov_ident.simulate import simulate
from rov_ident.zigzag import Zigzag


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


def cruise(model: Model, speed: float) -> Array:
    """The propeller's wrench (6,) that keeps a speed [m/s] straight ahead."""
    nu = np.array([speed, 0.0, 0.0, 0.0, 0.0, 0.0])
    return np.array([model.wrench(nu, np.zeros(6), np.array([0.0, 0.0, 1.0]))[0], 0, 0, 0, 0, 0])


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

    Raises
    ------
    UserError
        If the vehicle has no fins in its coefficients, or the motion diverges.
    """
    if not model.fins:
        raise UserError(
            "the vehicle has no fin coefficients: add N_uudr, Y_uudr (rudder) and M_uuds, Z_uuds "
            "(stern planes) to coefficients"
        )
    n = round(duration / step) + 1
    thrust = cruise(model, speed)
    position, orientation = np.array([0.0, 0.0, depth]), np.array([1.0, 0.0, 0.0, 0.0])
    nu = np.array([speed, 0.0, 0.0, 0.0, 0.0, 0.0])
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
        run = simulate(
            model, np.array([0.0, step]), np.tile(push, (2, 1)), nu, position, orientation
        )
        position, orientation, nu = run.position[1], run.orientation[1], run.nu[1]
        turned = np.array(quaternion_to_euler(orientation))
        turned[2] = angles[2] + wrap_angle(turned[2] - angles[2])
        angles = turned
    t: Array = step * np.arange(n, dtype=np.float64)
    return Run(t, out[:, :3], out[:, 3:6], out[:, 6:12], dict(zip("sra", out[:, 12:].T)))


# ------------------------------------------------------------------ laws


@dataclass(frozen=True)
class Depth:
    """Stern planes to a depth [m]: the error asks for a pitch, the pitch for an angle.

    ``sign`` is that of M_uuds: negative, a positive angle turns the nose down.
    """

    target: float
    sign: float
    pitch_per_metre: float = 0.2
    steepest: float = float(np.radians(25.0))
    gain: float = 1.5
    damping: float = 1.0

    def __call__(self, now: Now) -> dict[str, float]:
        wanted = -np.clip(
            self.pitch_per_metre * (self.target - now.position[2]), -self.steepest, self.steepest
        )
        moment = self.gain * (wanted - now.angles[1]) - self.damping * now.nu[4]
        return {"s": self.sign * moment}


@dataclass(frozen=True)
class Heading:
    """Rudder to a heading [rad]; ``sign`` is that of N_uudr."""

    target: float
    sign: float
    gain: float = 1.0
    damping: float = 1.0

    def __call__(self, now: Now) -> dict[str, float]:
        error = float(wrap_angle(self.target - now.angles[2]))
        return {"r": self.sign * (self.gain * error - self.damping * now.nu[5])}


@dataclass(frozen=True)
class Turn:
    """The rudder put to an angle [rad] at a time [s] and left there."""

    angle: float
    begin: float = 5.0

    def __call__(self, now: Now) -> dict[str, float]:
        return {"r": self.angle if now.t >= self.begin else 0.0}


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


@dataclass(frozen=True)
class Both:
    """Several laws, each for fins of its own."""

    laws: tuple[Law, ...]

    def __call__(self, now: Now) -> dict[str, float]:
        return {letter: x for law in self.laws for letter, x in law(now).items()}


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

    Raises
    ------
    UserError
        For an unknown name, or fins that the vehicle lacks for it.
    """
    yaw, pitch = (float(np.sign(model.fins.get(key, 0.0))) for key in ("N_uudr", "M_uuds"))
    lacking = "M_uuds" if name == "dive" and not pitch else "N_uudr" if not yaw else ""
    if lacking and not (name == "dive" and pitch):
        raise UserError(f"the vehicle has no {lacking}: add it to coefficients for a {name}")
    if name == "zigzag":
        law: Law = Kempf(angle, angle if switch is None else switch)
    elif name == "turn":
        law = Turn(angle)
    elif name == "heading":
        law = Heading(angle, yaw)
    elif name == "dive":
        law = Depth(depth, pitch)
    else:
        raise UserError(f"there is no manoeuvre '{name}': choose one of {', '.join(MANOEUVRES)}")
    if name != "dive" and pitch:
        law = Both((law, Depth(0.0, pitch)))
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
    rows = np.column_stack(list(columns.values()))[::k]
    return (
        "\n".join([",".join(columns), *(",".join(f"{x:.9g}" for x in row) for row in rows)]) + "\n"
    )
