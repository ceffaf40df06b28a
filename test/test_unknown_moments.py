"""A wrench in which no moment was recorded: what turned the vehicle is unknown, not zero.

The dives come from a simulator that shares no code with the estimators (bench/simulators/sea.py).
"""

from functools import cache

import numpy as np
import pytest
import yaml
from tiers import more

import rov_ident as ri
from bench.simulators import sea
from rov_ident.config.prior import prior_of
from rov_ident.core.messages import Wrench
from rov_ident.core.states import State
from rov_ident.io.write_messages import write_messages
from rov_ident.sampling.raw_streams import gather
from rov_ident.sampling.records import read_record
from rov_ident.sampling.sample import NO_MOMENT, free_axes

TURNING = [name for name in sea.NOMINAL if name[0] in "KMN"]
MOVING = [name for name in sea.NOMINAL if name[0] in "XYZ"]


@cache
def drawn(seed):
    """A vehicle that all its thrusters drive, and of whose wrench the forces alone are recorded."""
    rng, unknown = np.random.default_rng([7, seed]), sea.Sea(odometry_rate=10.0)
    vehicle = sea.draw_vehicle(rng)
    truth = sea.dive(vehicle, unknown, "six-axis", 60.0, rng)
    told, messages = sea.told(vehicle, unknown, rng), sea.measured(truth, unknown, rng)
    return vehicle, {"/**": {"ros__parameters": told}}, messages


def without_moments(messages, since=np.inf, rounding=0.0):
    """The messages, without the moments of the wrench; from ``since`` [s] on with them.

    ``rounding``: of the largest force [N], is left of a moment [N m], as an allocation leaves it.
    """
    rng = np.random.default_rng(0)
    for arrival, role, message in messages:
        if isinstance(message, Wrench) and message.stamp < sea.EPOCH + 1e9 * since:
            left = rounding * np.abs(message.force).max() * rng.integers(-2, 3, 3)
            message = message._replace(torque=left)
        yield arrival, role, message


KINDS = ("rls", "ukf", "ml")


@pytest.fixture
def dive(tmp_path):
    def written(seed, since=np.inf, seconds=60.0):
        vehicle, document, messages = drawn(seed)
        bag, file = tmp_path / "dive.mcap", tmp_path / "vehicle.yaml"
        messages = [row for row in messages if row[0] < sea.EPOCH + 1e9 * seconds]
        write_messages(bag, list(without_moments(messages, since)))
        file.write_text(yaml.safe_dump(document))
        return vehicle, bag, file

    return written


@pytest.mark.parametrize(
    ("kind", "seed"), [*((k, 0) for k in KINDS), *more(*((k, 1) for k in KINDS))]
)
def test_what_turns_it_is_unknown(dive, kind, seed):
    """Forces are learnt, along the turns that were measured; of moments nothing is said."""
    vehicle, bag, file = dive(seed, seconds=30.0 if kind == "ml" else 60.0)  # it takes longest
    fit = ri.fit(bag, file, kind)
    if kind != "rls":  # thrust that is late and velocities that are early look alike at first
        assert fit.consistency.consistent, fit.consistency.sentence
    assert any(NO_MOMENT in note for note in fit.notes)
    found = dict(zip(fit.names, zip(fit.values, fit.std, fit.states), strict=True))
    off = {n: (found[n][0] - vehicle.theta[n]) / found[n][1] for n in MOVING}
    assert max(map(abs, off.values())) < 3.0, off
    given = dict(zip(fit.names, prior_of(fit.given, effects=True).std, strict=True))
    for name in TURNING:
        value, std, state = found[name]
        assert state is State.HELD and std > 0.9 * given[name], name
        assert abs(value - fit.given.value(name)) < 0.2 * given[name], name
    # the UKF doubts its scale of the thrust, and with it all forces
    if kind != "ukf" and fit.consistency.consistent:
        known = [found[n][1] < 0.15 * abs(vehicle.theta[n]) for n in MOVING]
        # not added mass that is little beside the mass, nor linear damping, for which Coriolis
        # forces stand if the thrust of one axis is off
        assert sum(known) >= len(MOVING) - 4, {n: found[n] for n in MOVING}
    assert not any("righting arm" in advice for advice in fit.advice)
    assert np.isnan(fit.rmse[3:]).all() and np.isfinite(fit.rmse[:3]).all()


def test_least_squares_does_not_take_it_for_zero(dive):
    _, bag, file = dive(0)
    fit = ri.fit(bag, file, "ls")
    found = dict(zip(fit.names, fit.values, strict=True))
    assert {n: found[n] for n in TURNING} == pytest.approx({n: fit.given.value(n) for n in TURNING})


def test_records_with_moments_and_without(dive, tmp_path):
    """Together: what turns the vehicle is learnt, and judged, where it is known."""
    vehicle, bag, file = dive(0)
    whole = tmp_path / "whole.mcap"
    write_messages(whole, drawn(0)[2])
    for kind in ("rls", "ls"):
        fit = ri.fit([bag, whole], file, kind)
        assert np.isfinite(fit.rmse).all()
        found = dict(zip(fit.names, zip(fit.values, fit.std, fit.states), strict=True))
        assert [n for n in ("K_pdot", "M_qdot", "N_rdot") if found[n][2] is State.HELD] == []
        off = {n: (found[n][0] - vehicle.theta[n]) / found[n][1] for n in sea.NOMINAL}
        assert max(map(abs, off.values())) < 3.5, off


def test_until_a_moment_is_heard(dive):
    """Most dives begin with some seconds in which no thruster turns."""
    vehicle, bag, file = dive(0, since=20.0)
    samples = read_record(bag, ri.load(file)).samples
    unknown = np.isinf(samples["wrench_doubt"])
    assert not unknown[:, :3].any() and free_axes(samples).all()
    assert np.ptp(unknown[:, 3:].sum(axis=0)) == 0
    assert samples["t"][unknown[:, 3]].max() == pytest.approx(20.0, abs=0.3)
    assert unknown[samples["t"] < 19.5, 3].all()
    fit = ri.fit(bag, file, "rls")
    found = dict(zip(fit.names, zip(fit.values, fit.std), strict=True))
    off = {n: (found[n][0] - vehicle.theta[n]) / found[n][1] for n in sea.NOMINAL}
    assert fit.consistency.consistent and max(map(abs, off.values())) < 3.5, off


@pytest.mark.parametrize("precision", [np.float64, np.float32])
def test_rounding_is_no_moment(dive, tmp_path, precision):
    """Thrusters in pairs leave 1e-16 or 1e-7 of their force; what turns it stays unknown."""
    _, _, file = dive(0)
    bag, config = tmp_path / "rounded.mcap", ri.load(file)
    messages = list(without_moments(drawn(0)[2], rounding=np.finfo(precision).eps))
    write_messages(bag, messages)
    assert np.isinf(read_record(bag, config).samples["wrench_doubt"][:, 3:]).all()
    streams = gather(((role, message) for _, role, message in messages), config)
    np.testing.assert_array_equal(streams.guided, [False] * 3 + [True] * 3)


def test_a_simulation_turns_as_measured(dive):
    _, bag, file = dive(1)
    run = ri.simulate(file, bag=bag)
    measured = read_record(bag, ri.load(file)).samples["nu"]
    np.testing.assert_allclose(run.nu[:, 3:], measured[:, 3:], atol=1e-9)
    assert not np.allclose(run.nu[:, :3], measured[:, :3], atol=1e-3)


def test_filterpy_turns_the_same_way(dive):
    """The textbook's filter on the same samples."""
    from rov_ident.estimation.reference_ukf import compare

    _, bag, file = dive(0)
    config = ri.load(file)
    found = compare(config, read_record(bag, config).samples[:150])
    apart = [abs(entry["apart_in_std"]) for entry in found["coefficients"].values()]
    assert max(apart) < 1e-3, found["coefficients"]
