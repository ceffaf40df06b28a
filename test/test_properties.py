"""What must not matter to an estimator: units, order, which side is port, when it is, which run."""

import dataclasses

import numpy as np
import pytest

from rov_ident import config as configuration
from rov_ident.core.messages import Imu, Odometry, Wrench
from rov_ident.estimation.online import OnlineEstimator
from rov_ident.model.equations import build

KINDS = ["rls", "ukf"]
SIDE = np.array([1.0, -1.0, 1.0])  # of a vector in a mirror
TURN = -SIDE  # of a rotation
SECOND = 1_000_000_000


def result(config, kind, messages):
    online = OnlineEstimator(config, kind)
    for role, message in messages:
        online.push(role, message)
    online.flush()
    report = online.report()
    assert report.excitation.max() > 0.5  # something has been learnt
    return report


def assert_same(report, other, factor=1.0, to=1e-7):
    """As far as rounding: in the other's standard deviations, and these relatively."""
    if to == 0.0:
        np.testing.assert_array_equal(report.values, other.values)
        np.testing.assert_array_equal(report.covariance, other.covariance)
        return
    assert np.max(np.abs(report.values - factor * other.values) / report.std) < to
    np.testing.assert_allclose(report.std, factor * other.std, rtol=to)


@pytest.fixture(scope="module")
def off(heavy):
    """With something to learn; and inertia enough for products of the axes."""
    factors = 1.0 + 0.2 * np.random.default_rng(4).uniform(-1.0, 1.0, len(heavy.model.theta))
    return heavy.with_model(heavy.model.with_theta(heavy.model.theta * factors))


@pytest.fixture(scope="module")
def messages(short_dive):
    return [(role, m) for _, role, m in short_dive]


@pytest.fixture(scope="module", params=KINDS)
def plain(request, off, messages):
    return request.param, result(off, request.param, messages)


def test_the_same_bag_gives_the_same_bits(plain, off, messages):
    kind, report = plain
    assert_same(result(off, kind, messages), report, to=0.0)


@pytest.mark.parametrize("shift", [3600 * SECOND, 1_700_000_000 * SECOND + 123_456_789])
def test_any_time(plain, off, messages, shift):
    kind, report = plain
    late = [(role, m._replace(stamp=m.stamp + shift)) for role, m in messages]
    other = result(off, kind, late)
    assert_same(other, report, to=0.0)
    assert other.stamp == report.stamp + shift


@pytest.mark.parametrize("unit", [1e-3, 8.0, 2204.62])
def test_any_unit_of_mass(plain, off, messages, unit):
    """Kilograms or tonnes: masses, forces and coefficients all scale alike."""
    kind, report = plain
    body = off.model.body
    scaled = dataclasses.replace(
        body, mass=unit * body.mass, weight=unit * body.weight, buoyancy=unit * body.buoyancy,
        inertia=unit * body.inertia,
    )  # fmt: skip
    model = dataclasses.replace(off.model, body=scaled).with_theta(unit * off.model.theta)
    pushed = [
        (role, m._replace(force=unit * m.force, torque=unit * m.torque))
        if isinstance(m, Wrench)
        else (role, m)
        for role, m in messages
    ]
    other = result(dataclasses.replace(off, model=model), kind, pushed)
    assert_same(other, report, factor=unit)


def test_any_order_of_coefficients(plain, off, messages):
    """Of the UKF only as far as its sigma points are exact: they follow a Cholesky factor, which is
    another one in another order, and the third moments with it."""
    kind, report = plain
    names = list(np.random.default_rng(5).permutation(off.model.names))
    values = dict(zip(off.model.names, off.model.theta.tolist(), strict=True))
    model = build(off.model.body, {name: values[name] for name in names})
    other = result(dataclasses.replace(off, model=model, estimate=model.names), kind, messages)
    place = [other.names.index(name) for name in report.names]
    shuffled = dataclasses.replace(
        other, values=other.values[place], std=other.std[place],
        covariance=other.covariance[np.ix_(place, place)],
    )  # fmt: skip
    assert_same(shuffled, report, to=1e-7 if kind == "rls" else 0.02)


def mirrored(message):
    """Port for starboard."""
    if isinstance(message, Odometry):
        return message._replace(
            position=SIDE * message.position,
            orientation=np.array([1.0, -1.0, 1.0, -1.0]) * message.orientation,
            linear=SIDE * message.linear,
            angular=TURN * message.angular,
        )
    if isinstance(message, Imu):
        return message._replace(
            angular_velocity=TURN * message.angular_velocity,
            linear_acceleration=SIDE * message.linear_acceleration,
        )
    return message._replace(force=SIDE * message.force, torque=TURN * message.torque)


def test_a_mirrored_vehicle(plain, off, messages):
    kind, report = plain
    other = result(off, kind, [(role, mirrored(m)) for role, m in messages])
    # The Jacobian of RLS is a forward difference over 1e-6, which the mirror turns backward.
    assert_same(other, report, to=1e-5 if kind == "rls" else 1e-7)


def test_configurations_written_in_any_order(plain, off, messages, tmp_path):
    """What the file says counts, not where."""
    kind, report = plain
    configuration.dump(off, tmp_path / "off.yaml")
    assert_same(result(configuration.load(tmp_path / "off.yaml"), kind, messages), report, to=0.0)
