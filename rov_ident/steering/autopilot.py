"""Closed-loop simulation of a vehicle with fins: zigzag, turn, heading change, dive to depth.

A law looks at the motion and orders fin angles; servos follow at a limited rate. The equations of
motion are those of :mod:`rov_ident.simulation.open_loop`, run from control step to control step.
"""

import io
from bisect import bisect_right
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from rov_ident.core.errors import UserError
from rov_ident.core.frames import quaternion_to_euler, wrap_angle
from rov_ident.core.messages import Array
from rov_ident.effects import Values, act, compiled, memory, steering_memory
from rov_ident.effects import steer as act_on_fins
from rov_ident.model.coefficients import INPUT_LETTERS, INPUTS
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
    """t (n,), position (n, 3), angles (n, 3) roll pitch yaw, nu (n, 6), fins {letter: (n,)}.

    ``thrust`` (n,) [N] acts from each instant to the next, or the propeller turns at
    ``revolutions`` (n,) [1/s].
    """

    t: Array
    position: Array
    angles: Array
    nu: Array
    fins: Mapping[str, Array]
    thrust: Array
    revolutions: Array

    @property
    def inputs(self) -> Array:
        """(n, 4), of INPUTS."""
        return np.column_stack([*(self.fins[x] for x in "sra"), self.revolutions])

    def zigzag(self) -> Zigzag:
        """Heading and rudder."""
        return Zigzag("simulated", self.t, self.angles[:, 2], self.fins["r"])


def steer(
    model: Model,
    law: Law,
    duration: float,
    speed: float,
    servo: Servo = Servo(),
    step: float = 0.02,
    depth: float = 0.0,
    speeds: Callable[[float], float] | None = None,
    effects: Values | None = None,
) -> Run:
    """Run a law for ``duration`` [s] from straight level motion at ``speed`` [m/s].

    The propeller keeps the thrust of that speed, or of that which ``speeds`` gives for the time
    [s]; where the model knows what the propeller does, by its revolutions. Fin
    angles are linear within a step, of which the middle acts. ``effects`` act on thrust, fins and
    motion; those on sensors do not: a law sees the motion as it is.

    Raises UserError if the vehicle has no fins in its coefficients, or the motion diverges.
    """
    if not model.inputs:
        raise UserError(
            "the vehicle has no fin coefficients: add N_uudr, Y_uudr (rudder) and M_uuds, Z_uuds "
            "(stern planes) to coefficients"
        )
    n = round(duration / step) + 1
    position, orientation = np.array([0.0, 0.0, depth]), np.array([1.0, 0.0, 0.0, 0.0])
    nu, surge = np.eye(6)[0] * speed, np.eye(6)[0]
    angles = np.zeros(3)
    acting = compiled(effects or {})
    of_thrusters, of_fins = memory(), steering_memory()
    fins = dict.fromkeys("sra", 0.0)
    out = np.empty((n, 17))
    for i in range(n):
        thrust, turning = _propulsion(model, speed if speeds is None else speeds(i * step))
        driven = [fins["s"], fins["r"], fins["a"], thrust, turning]
        out[i] = np.concatenate([position, angles, nu, driven])
        ordered = law(Now(i * step, position, angles, nu))
        read = np.zeros((2, len(INPUTS)))  # the mean over the step, and at its end
        read[:, INPUTS.index("n")] = turning
        for letter, now in fins.items():
            wanted = np.clip(ordered.get(letter, 0.0), -servo.limit, servo.limit)
            fins[letter] = now + float(np.clip(wanted - now, -servo.rate * step, servo.rate * step))
            read[:, INPUT_LETTERS.index(letter)] = 0.5 * (now + fins[letter]), fins[letter]
        act_on_fins(acting, of_fins, step, read)
        wrench = thrust * surge
        act(acting, of_thrusters, i * step, step, wrench)
        run = simulate(
            model, np.array([i, i + 1]) * step, np.tile(wrench, (2, 1)), nu, position, orientation,
            effects=acting, inputs=np.tile(read[0], (2, 1)),
        )  # fmt: skip
        position, orientation, nu = run.position[1], run.orientation[1], run.nu[1]
        yaw = angles[2]
        angles = np.array(quaternion_to_euler(orientation))
        angles[2] = yaw + wrap_angle(angles[2] - yaw)
    t: Array = step * np.arange(n, dtype=np.float64)
    found = dict(zip("sra", out[:, 12:15].T))
    return Run(t, out[:, :3], out[:, 3:6], out[:, 6:12], found, out[:, 15], out[:, 16])


def _propulsion(model: Model, speed: float) -> tuple[float, float]:
    """Thrust [N], or revolutions [1/s] of a propeller in the model, for straight motion."""
    nu, known = np.eye(6)[0] * speed, model.values
    thrust = float(model.wrench(nu, np.zeros(6), np.array([0.0, 0.0, 1.0]))[0])
    square, linear = known.get("X_nn", 0.0), known.get("X_n", 0.0)
    linear += speed * known.get("X_un", known.get("X_nu", 0.0))
    if square > 0.0:
        return 0.0, float((np.sqrt(linear**2 + 4.0 * square * thrust) - linear) / (2.0 * square))
    return (0.0, thrust / linear) if linear > 0.0 else (thrust, 0.0)


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


def alternating(
    values: tuple[float, ...], shortest: float, longest: float, rng: np.random.Generator
) -> Callable[[float], float]:
    """One of the values after the other, each held for a random time [s] within the limits."""
    ends = [0.0]

    def at(t: float) -> float:
        while ends[-1] <= t:
            ends.append(ends[-1] + rng.uniform(shortest, longest))
        return values[(bisect_right(ends, t) - 1) % len(values)]

    return at


MANOEUVRES = ("zigzag", "turn", "heading", "dive", "waypoints")
"""Of vehicles with fins. `waypoints`: the autopilot is given other headings, depths and speeds in
turn, so that fins swing between their limits by themselves (Zhao, Xie and Qiao 2018)."""


def manoeuvre(
    model: Model,
    name: str,
    angle: float,
    switch: float | None = None,
    depth: float = 5.0,
    duration: float = 100.0,
    speed: float = 1.5,
    servo: Servo = Servo(),
    step: float = 0.02,
    seed: int = 0,
    effects: Values | None = None,
) -> Run:
    """A manoeuvre by name, the depth held where the vehicle has stern planes.

    ``angle`` [rad] is the rudder's for `zigzag` (reversed at ``switch``, its size by default) and
    `turn`, the course for `heading`; `dive` goes to ``depth`` [m]. `waypoints` go to either side
    by ``angle``, down to ``depth`` and up, at times drawn by ``seed``.

    Raises UserError for an unknown name, or fins that the vehicle lacks for it.
    """
    yaw, pitch = (float(np.sign(model.fins.get(key, 0.0))) for key in ("N_uudr", "M_uuds"))
    if not (pitch if name == "dive" else yaw):
        lacking = "M_uuds" if name == "dive" else "N_uudr"
        raise UserError(f"the vehicle has no {lacking}: add it to coefficients for a {name}")
    if name == "waypoints":
        rng = np.random.default_rng(seed)
        course = alternating((angle, -angle), 6.0, 15.0, rng)
        level = alternating((depth, 0.0), 10.0, 25.0, rng)
        speeds = alternating((speed, 0.7 * speed, 1.2 * speed), 8.0, 20.0, rng)

        def waypoints(now: Now) -> Mapping[str, float]:
            there = to_heading(course(now.t), yaw)(now)
            return {**there, **to_depth(level(now.t), pitch)(now)} if pitch else there

        return steer(model, waypoints, duration, speed, servo, step, speeds=speeds, effects=effects)
    laws: dict[str, Law] = {
        "zigzag": Kempf(angle, abs(angle) if switch is None else switch),
        "turn": turn(angle),
        "heading": to_heading(angle, yaw),
        "dive": to_depth(depth, pitch),
    }
    if name not in laws:
        raise UserError(f"there is no manoeuvre '{name}': choose one of {', '.join(MANOEUVRES)}")
    law = laws[name]
    if name != "dive" and pitch:
        law = both(law, to_depth(0.0, pitch))
    return steer(model, law, duration, speed, servo, step, effects=effects)


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
