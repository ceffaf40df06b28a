"""What the nodes say of a model that lacks something, and of one that lacks nothing.

The dives come from ``bench/simulators/hidden.py``, which knows none of the package's equations.
"""

import dataclasses

import numpy as np
import pytest
from tiers import more

from bench.simulators import hidden
from bench.studies.watch import said
from rov_ident import config as configuration
from rov_ident.core.messages import Array
from rov_ident.discrepancy.held_out import WINDOW
from rov_ident.discrepancy.live_windows import MEMORY, is_watched
from rov_ident.discrepancy.monitor import ALARM, Monitor, exercise, penalty, suspicions
from rov_ident.effects import EFFECTS
from rov_ident.estimation.online import OnlineEstimator
from rov_ident.sampling.sample import SAMPLE
from rov_ident.simulation.manoeuvres import manoeuvre
from rov_ident.simulation.virtual_sensors import Suite, dive, measure

LEAN = {"odometry_rate": 10.0, "imu_rate": 50.0}


def watching(config, kind="rls"):
    online = OnlineEstimator(config, kind)
    online.attach(Monitor(config))
    return online


def play(online, messages):
    """Push all messages; the suspicions after each window."""
    seen, last = [], None
    for _, role, message in messages:
        online.push(role, message)
        if online.monitor.suspicions is not last:
            last = online.monitor.suspicions
            seen.append(last)
    return seen


@pytest.mark.parametrize(
    "effect, axes",
    [("quadratic_damping", "XY"), *more(("constant_force", "XYZ"), ("thruster_deadband", "NY"))],
)
def test_what_is_missing_is_named(effect, axes):
    case = hidden.draw(200, (effect,), 0.5, conditions=hidden.Conditions(duration=90.0, **LEAN))
    found = play(watching(case.config), case.messages)[-1]
    assert found and found[0].effect == effect
    assert set(found[0].axes) <= set(axes)
    assert effect.replace("_", " ") in found[0].sentence
    if effect == "quadratic_damping":
        plain = "residual in surge follows |u| u: quadratic damping missing?"
        assert plain in [suspicion.sentence for suspicion in found]
    truth = case.effects[effect]
    # To first order: linear damping, which is estimated, has taken up some of the quadratic.
    lowest = 0.5 if effect == "quadratic_damping" else 0.7
    for name, value in found[0].parameters.items():
        assert lowest < value / truth[name] < 1.3


def test_a_vehicle_that_does_not_move_at_all_is_watched():
    """No velocity ever changes, so that all follow the measurement: kernels are compiled so."""
    exercise()


@pytest.mark.parametrize("kind", ["rls", *more("ukf")])  # both have the same monitor
def test_nothing_is_said_of_a_model_that_lacks_nothing(kind):
    case = hidden.draw(102, conditions=hidden.Conditions(duration=150.0, **LEAN))
    assert not any(play(watching(case.config, kind), case.messages))


@pytest.mark.parametrize("seed", [7110, *more(9101, *range(9117, 9122))])
def test_noise_of_the_reading_is_not_taken_for_a_cause(seed):
    """No thruster gives it: it moves the simulated vehicle only. As the nodes run by default."""
    assert not said(seed, 120.0, known=False)


def test_what_is_missing_is_named_under_noise_of_the_reading():
    conditions = hidden.Conditions(duration=90.0, reading=(0.5, 0.06))
    case = hidden.draw(200, ("constant_force",), 0.5, conditions=conditions)
    found = play(watching(case.config), case.messages)[-1]
    assert found and found[0].effect == "constant_force"


@pytest.mark.parametrize("acts", [False, True])
def test_a_command_that_trembles_is_told_from_noise_of_the_reading(heavy, acts):
    """What looks alike where it is read, a vehicle follows or does not."""
    exact = dataclasses.replace(heavy.wrench, relative_std=0.0)
    heavy = dataclasses.replace(heavy, wrench=exact)
    t, std = np.arange(0.0, 75.0, 0.02), np.repeat([0.5, 0.06], 3)
    rng = np.random.default_rng(4)
    demand = manoeuvre("steps", heavy.dynamics, t, rng)
    noise = {f"std_{axis}": value for axis, value in zip("XYZKMN", std, strict=True)}
    noisy = dataclasses.replace(heavy, effects={"wrench_noise": noise})
    if acts:
        demand = demand + std * rng.standard_normal(demand.shape)
    suite = Suite(wrench_std=0.0, **LEAN)
    run = measure(heavy if acts else noisy, t, demand, 75.0, suite, rng)
    online = watching(heavy)
    assert not any(play(online, run.messages))
    reading = online.monitor._state.reading
    assert reading.std == pytest.approx(std, rel=0.15)
    assert (reading.is_noise[3:] == (not acts)).all()  # forces move little: they may stay untold


@pytest.mark.parametrize("every", [True, False])
def test_what_a_single_window_says_proves_nothing(every):
    """A knock or a gust fills one window, and something always fits that."""
    case = hidden.draw(102, conditions=hidden.Conditions(duration=85.0, **LEAN))
    watcher = (online := watching(case.config)).monitor
    play(online, case.messages)
    task, state = watcher._task, watcher._state
    at = [*task.base, *(key for unit in task.units for key in unit)].index(("buoyancy", "delta"))
    windows, lacking = list(state.windows), 20.0 if every else 80.0  # N
    for i in range(len(windows)) if every else [7]:
        old = windows[i].sums
        change = lacking * old.normal[at]
        power = old.power + 2.0 * lacking * old.moment[at] + lacking * change[at]
        sums = old._replace(moment=old.moment + change, power=power)
        windows[i] = windows[i]._replace(sums=sums, doubt=None)
    found = suspicions(task, state._replace(windows=windows))
    assert bool(found) == every


def test_a_tilt_of_the_attitude_is_not_taken_for_a_cause():
    """A milliradian turns a slender vehicle at 0.03 rad/s within a window."""
    slender = hidden.Conditions(duration=80.0, family="auv")
    case = hidden.draw(502, conditions=slender)
    assert not any(play(watching(case.config), case.messages))


def test_what_ends_is_forgotten(heavy):
    """Pulled by something for a minute, then let go."""
    pulled = dataclasses.replace(
        heavy, effects={"constant_force": {"fx": 6.0, "fy": 0.0, "fz": 0.0}}
    )
    online = watching(heavy)
    first = play(online, dive(pulled, "steps", 70.0, Suite(**LEAN), 1).messages)
    assert first[-1] and "constant_force" in (first[-1][0].effect, *first[-1][0].rivals)
    memory = MEMORY * WINDOW
    later = [
        (arrival, role, message._replace(stamp=message.stamp + 80_000_000_000))
        for arrival, role, message in dive(heavy, "steps", memory + 20.0, Suite(**LEAN), 2).messages
    ]
    assert not play(online, later)[-1]


def test_watching_changes_no_estimate():
    case = hidden.draw(200, ("lift",), 0.5, conditions=hidden.Conditions(duration=70.0, **LEAN))
    online, alone = watching(case.config), OnlineEstimator(case.config, "rls")
    play(online, case.messages)
    for _, role, message in case.messages:
        alone.push(role, message)
    np.testing.assert_array_equal(online.report().values, alone.report().values)
    np.testing.assert_array_equal(online.report().covariance, alone.report().covariance)


def test_which_effects_are_watched():
    """Sensors disagree among themselves, waves need a frequency, a limit of thrust or of fins a
    search, a battery fades too slowly, and what has no name has no size."""
    sensors = {name for name, effect in EFFECTS.items() if effect.of_sensors}
    left = {name for name, effect in EFFECTS.items() if not is_watched(effect)}
    assert left == sensors | {
        "wave",
        "battery_sag",
        "thruster_saturation",
        "fin_saturation",
        "empirical",
    }


@pytest.mark.parametrize("size", [1, 3, 6])
def test_chance_passes_the_penalty_as_rarely_as_it_should(size):
    """Against the chi-squared distribution, whose tail the penalty bounds."""
    from scipy.stats import chi2

    chance = 100 * chi2.sf(penalty(size, 100), size)
    # Chernoff's bound on one squared normal x is sqrt(e pi / 2) x too large, and x is some 30.
    assert ALARM / 100.0 < chance <= ALARM


def test_at_rest_and_in_gaps_nothing_is_said(heavy):
    online = watching(heavy)
    run = dive(heavy, "steps", 100.0, Suite(), 3)
    kept = [m for m in run.messages if (m[2].stamp // 1_000_000_000) % 7 > 1]
    assert not any(play(online, kept))


@pytest.mark.parametrize("effect", ["thruster_lag", *more("actuation_delay")])
def test_a_lag_remembers_the_commands_before_a_window(effect, heavy):
    """What remained of each window was four times the noise, and hid half of what is missing."""
    (parameter,) = EFFECTS[effect].parameters
    effects = {effect: {parameter.name: 0.4}}
    config = configuration.from_parameters(
        configuration.to_parameters(heavy) | {"effects": effects}
    )
    online = watching(config)
    play(online, dive(config, "steps", 40.0, Suite(**LEAN), 1).messages)
    left = online.monitor._state.noise
    assert (left < 1.5 * np.repeat([0.008, 0.0035], 3)).all()  # of the sensors, and the rounding


def test_windows_do_not_reach_across_gaps(heavy):
    watcher = Monitor(heavy)
    rows = np.zeros(10, dtype=SAMPLE)
    rows["t"] = np.arange(10)
    demands: list[tuple[float, Array]] = [(0.0, np.zeros(6))]
    assert watcher.take(rows[:4], demands) is None
    assert demands == []
    again = rows[4:].copy()
    again["restart"][0] = True
    window = watcher.take(again, [])
    assert window is not None and window[0]["t"][0] == 4.0


def test_commands_are_not_hoarded_where_no_window_gets_full(heavy):
    """Odometry at 1 Hz without an IMU: each sample is beyond a gap."""
    watcher, row = Monitor(heavy), np.zeros(1, dtype=SAMPLE)
    row["restart"] = True
    for second in range(600):
        row["t"] = second
        demands = [(t, np.ones(6)) for t in second - 1.0 + np.arange(0.02, 1.01, 0.02)]
        assert watcher.take(row.copy(), demands) is None and not demands
    assert len(watcher._demands) < 50 * (WINDOW + 2.0)  # of the window before and this one


@pytest.mark.parametrize("told_first", [True, False])
@pytest.mark.parametrize("batch", [1, 3, 7])
def test_a_bag_that_starts_again_starts_a_window(heavy, batch, told_first):
    """What was demanded before the clock jumped back belongs to no window after it."""
    watcher = Monitor(heavy)
    rows = np.zeros(20, dtype=SAMPLE)
    rows["t"] = [*np.arange(100.0, 104.0, 0.5), *np.arange(1.0, 7.0, 0.5)]
    rows["restart"][8] = True
    again = [(t, np.ones(6)) for t in np.arange(0.5, 7.0, 0.25)]
    demands = [(t, np.zeros(6)) for t in np.arange(99.5, 104.5, 0.25)]
    windows = []
    for i in range(0, len(rows), batch):
        last = rows["t"][i : i + batch][-1]
        if last < 50.0:
            while again and again[0][0] <= last + 0.25 * told_first:
                demands.append(again.pop(0))
        windows.append(watcher.take(rows[i : i + batch], demands))
    [(samples, told)] = [window for window in windows if window is not None]
    assert samples["t"][0] == 1.0 and (np.diff(samples["t"]) > 0.0).all()
    assert (np.diff(told[:, 0]) > 0.0).all() and (told[:, 1:] == 1.0).all()
