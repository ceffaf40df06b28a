"""Open-loop simulation, of a manoeuvre or beside a bag."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rov_ident.api.reading import File, axes, load, read
from rov_ident.config import Config
from rov_ident.core.errors import UserError, refuse_ignored, require
from rov_ident.core.messages import Array, Message
from rov_ident.core.progress import Progress
from rov_ident.core.threads import one_blas_thread
from rov_ident.effects import compiled
from rov_ident.io.write_messages import unlike_inputs, write_messages
from rov_ident.model.coefficients import VELOCITIES
from rov_ident.reports.result import Figure, Shown, as_json
from rov_ident.reports.table import Table
from rov_ident.sampling.records import (
    HORIZON,
    UNITS,
    Score,
    measured_motion,
    numbers,
    predicted,
    score,
    simulated_axes,
)
from rov_ident.simulation.virtual_sensors import Dive, Suite, dive, measure, odometry_of
from rov_ident.steering import autopilot

DURATION = 180.0  # s; of a manoeuvre, unless said otherwise
_POINTS = 2000  # of a curve in a picture
_FIN_ANGLE = float(np.radians(20.0))  # of zigzags (IMO MSC.137(76)), and of changes of course


@dataclass(frozen=True)
class Simulation(Shown):
    """A simulated motion: velocities ``nu`` (k, 6) [m/s, rad/s] over ground, in body axes
    forward-starboard-down, at ``t`` (k,) [s].

    Beside a bag: ``measured`` (k, 6) what the bag has, ``whole`` and ``windows`` the error of the
    simulation in one run and in windows of HORIZON seconds, all NaN where no velocity was measured,
    and ``free`` (6,) which axes were simulated. Of a manoeuvre, these are None, and ``messages``
    are what simulated sensors saw.
    """

    name: str
    t: Array
    nu: Array
    messages: list[tuple[int, str, Message]] = field(repr=False)
    measured: Array | None = None
    free: NDArray[np.bool_] | None = None
    whole: Score | None = None
    windows: Score | None = None
    notes: tuple[str, ...] = ()
    duration: float = 0.0  # s

    @property
    def sentence(self) -> str:
        """What was simulated."""
        if self.measured is None:
            return f"{self.name}, {self.t[-1]:.1f} s simulated, {len(self.messages)} messages."
        return f"Open-loop simulation against {self.name}, {self.t[-1] - self.t[0]:.1f} s."

    @property
    def _chosen(self) -> list[int]:
        return [i for i in range(6) if self.free is None or self.free[i]]

    def table(self) -> Table:
        """Errors against the bag; of a manoeuvre, how the vehicle moves."""
        if self.whole is None or self.windows is None:
            rows = [
                [name, f"{x.min():.3f}", f"{x.max():.3f}", f"{np.sqrt(np.mean(x**2)):.3f}", unit]
                for name, x, unit in zip(VELOCITIES, self.nu.T, UNITS)
            ]
            return Table(self.sentence, ["", "least", "most", "rms", "unit"], rows, text=(4,))
        rows = []
        for i in self._chosen:
            scores = (self.whole.r2[i], self.whole.rmse[i], self.windows.rmse[i])
            cells = [f"{x:.{d}f}" for x, d in zip(scores, (3, 4, 4))]
            if not np.isfinite(self.whole.rmse[i]):
                cells = ["not measured", "-", "-"]
            rows.append([VELOCITIES[i], *cells, UNITS[i]])
        head = ["", "R2, one run", "RMSE, one run", f"RMSE, {HORIZON:g} s windows", "unit"]
        return Table(f"open-loop simulation against {self.name}", head, rows, text=(4,))

    def plot(self) -> Figure:
        """The six velocities, simulated and measured."""
        from rov_ident.reports import plots

        keep = slice(None, None, max(1, len(self.t) // _POINTS))
        measured = None if self.measured is None else self.measured[keep]
        return plots.motions(self.t[keep], measured, {"as configured": self.nu[keep]})

    def to_json(self) -> str:
        """The errors against the bag; of a manoeuvre, its length."""
        result: dict[str, Any] = {"messages": len(self.messages), "duration_s": self.duration}
        if self.whole is not None and self.windows is not None:
            columns = {
                "r2": numbers(self.whole.r2),
                "rmse": numbers(self.whole.rmse),
                "rmse_windows": numbers(self.windows.rmse),
            }
            velocities = {
                VELOCITIES[i]: {k: by[VELOCITIES[i]] for k, by in columns.items()}
                | {"unit": UNITS[i]}
                for i in self._chosen
            }
            result = {"bag": self.name, "horizon_s": HORIZON, "velocities": velocities}
        return as_json(result)

    def _writers(self) -> dict[str, Callable[[Path], None]]:
        return super()._writers() | {".mcap": lambda path: write_messages(path, self.messages)}


@one_blas_thread()
def simulate(
    config: File | Config,
    *,
    bag: File | None = None,
    manoeuvre: str | None = None,
    channels: str | None = None,
    duration: float = DURATION,
    sensors: Suite | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Simulation:
    """Simulate the configured vehicle in open loop: driven by a bag's wrench, or in a manoeuvre.

    Parameters
    ----------
    bag
        Path of an ``.mcap`` file or a rosbag2 directory whose wrench drives the simulation.
    manoeuvre
        Instead of a bag: ``steps``, ``multisine``, ``single-axis``, ``pilot`` or ``rest``; of a
        vehicle under its fins ``waypoints``, ``zigzag``, ``turn``, ``heading`` or ``dive``.
    channels
        With a bag: simulate these axes alone (``"surge,yaw"``), the others follow the measurement.
    duration
        Of a manoeuvre, s.
    sensors
        Of a manoeuvre: rates [Hz] and noise of the simulated sensors, a ``rov_ident.Suite``.
    seed
        Of a manoeuvre: of its course and of the noise.
    config, progress
        As in :func:`rov_ident.read`.

    Returns
    -------
    Simulation
        Velocities (k, 6) [m/s, rad/s] over time, and beside a bag their errors.

    Raises
    ------
    UserError
        If not one of bag and manoeuvre is given, an option has no meaning with it, the bag cannot
        be read, there is no such manoeuvre, or the simulation diverges.
    """
    require(Real, "a number", duration=duration)
    require(str | None, "text", manoeuvre=manoeuvre)
    require(Suite | None, "a rov_ident.Suite", sensors=sensors)
    given = load(config)
    free = None if channels is None else axes(channels)
    if (bag is None) == (manoeuvre is None):
        raise UserError("give either a bag or a manoeuvre to simulate")
    beside = bag is not None
    ignored = {
        "duration (--duration)": beside and duration != DURATION,
        "seed (--seed)": beside and seed != 0,
        "sensors (rates, --noise, --delay, --jitter, --drop)": beside and sensors is not None,
        "channels (--channels)": not beside and channels is not None,
    }
    refuse_ignored(ignored, "a bag" if beside else "a manoeuvre")
    if not 0.0 < duration < math.inf:
        raise UserError(f"duration is {duration:g} s, but must be positive")
    if not (isinstance(seed, int | np.integer) and seed >= 0):
        raise UserError(f"seed is {seed!r}, but must be a whole number from 0 on")
    if progress:
        progress("simulating")
    if manoeuvre is not None:
        suite = sensors or Suite()
        if manoeuvre in autopilot.MANOEUVRES:
            run = _steered(given, manoeuvre, duration, suite, seed)
        else:
            run = dive(given, manoeuvre, duration, suite, seed)
        truth, notes = run.truth, unlike_inputs(given)
        return Simulation(
            manoeuvre, truth.t, truth.nu, run.messages, notes=notes, duration=duration
        )
    assert bag is not None
    return _beside(bag, given, free, progress)


def _beside(
    bag: File, given: Config, free: NDArray[np.bool_] | None, progress: Progress | None
) -> Simulation:
    """Driven by a bag's wrench: in one run, and anew from the measured motion each HORIZON."""
    record = read(bag, given, progress)
    samples, model, effects = record.samples, given.dynamics, compiled(given.effects)
    free = simulated_axes(samples, free)
    nu, restarted = (predicted(model, samples, h, free, effects) for h in (math.inf, HORIZON))
    if not np.isfinite(nu).all():
        raise UserError(
            f"the simulation diverges on {bag}: check the signs and sizes of the coefficients and "
            "of the wrench"
        )
    t = samples["t"]
    return Simulation(
        record.path.name,
        t,
        nu,
        odometry_of(t, nu, record.origin),
        measured_motion(samples),
        free,
        score(samples, nu),
        score(samples, restarted),
        record.notes,
        record.duration,
    )


def _steered(given: Config, name: str, duration: float, suite: Suite, seed: int) -> Dive:
    """A manoeuvre under fins, as simulated sensors see it."""
    for missing, names in given.unheard.items():
        raise UserError(
            f"{names[0]} depends on {missing}, which no joint would show: name one in "
            f"inputs.{missing}.joint"
        )
    model, step = given.dynamics, 1.0 / suite.wrench_rate
    run = autopilot.manoeuvre(model, name, _FIN_ANGLE, duration=duration, step=step, seed=seed)
    demand = run.thrust[:, None] * np.eye(6)[0]
    rng = np.random.default_rng(seed)
    return measure(given, run.t, demand, duration, suite, rng, run.inputs, run.nu[0])
