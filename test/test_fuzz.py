"""Messages that nobody should send: bytes and fields, offline and over DDS to a live node."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.studies import torture
from rov_ident.core.messages import IMU, ODOMETRY, WRENCH, Imu, Odometry, Wrench
from rov_ident.estimation.online import OnlineEstimator
from rov_ident.io import cdr
from rov_ident.nodes.conversions import from_diagnostics
from rov_ident.sampling.sampler import Sampler

KINDS = ["rls", "ukf"]
TYPES = {Odometry: cdr.ODOMETRY_TYPE, Imu: cdr.IMU_TYPE, Wrench: cdr.WRENCH_TYPE}


@pytest.mark.parametrize("kind", KINDS)
def test_wild_messages(heavy, short_dive, kind):
    """`make torture` has a million of them."""
    done = torture.abused(heavy, kind, short_dive, 5000, seed=3)
    assert done.bad_reports == 0
    assert done.uncounted == 0
    assert done.undecodable > 100
    assert done.taken > 100
    assert len(done.refusals) > 10
    # and it goes on as if nothing had been
    first = done.online.sampler.counts[ODOMETRY]
    for _, role, m in short_dive:
        late = m._replace(stamp=m.stamp + 10**18)
        info = done.online.push(role, late)
    assert done.online.sampler.counts[ODOMETRY] > first + 0.9 * sum(
        role == ODOMETRY for _, role, _ in short_dive
    )
    assert (info["reason"] == 0).all()
    assert torture.is_fit(done.online.report())


numbers = st.floats(width=64) | st.sampled_from([1e300, -1e300, 5e-324, 1e-320, 1e12, -0.0, 1e6])
stamps = st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1) | st.integers(0, 10**10)
texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=60)


def vector(size):
    return st.lists(numbers, min_size=size, max_size=size).map(np.array)


odometries = st.builds(
    Odometry, stamps, texts, texts, vector(3), vector(4), vector(3), vector(3), vector(6)
)
imus = st.builds(Imu, stamps, texts, vector(4), vector(3), vector(3), vector(3), vector(3))
wrenches = st.builds(Wrench, stamps, texts, vector(3), vector(3))


@settings(max_examples=60, deadline=None)
@given(messages=st.lists(odometries | imus | wrenches, max_size=30))
def test_any_fields(heavy, messages):
    """Straight into an estimator that has seen nothing yet: its first message may be wild, too."""
    online = OnlineEstimator(heavy, "rls")
    roles = {Odometry: ODOMETRY, Imu: IMU, Wrench: WRENCH}
    for message in messages:
        before = online.sampler.counts.copy()
        online.push(roles[type(message)], message)
        assert torture.is_counted(roles[type(message)], before, online.sampler.counts)
    online.flush()
    assert torture.is_fit(online.report())


def test_as_many_names_of_refusals_as_one_can_read(heavy, short_dive):
    """Frame ids that change with each message fill neither memory nor /diagnostics."""
    sampler = Sampler(heavy)
    wrench = next(m for _, role, m in short_dive if role == WRENCH)
    sampler.push(WRENCH, wrench)
    for k in range(1000):
        sampler.push(WRENCH, wrench._replace(stamp=wrench.stamp + k + 1, frame_id=f"{k}\n" * 1000))
    assert len(sampler.counts) < 110
    assert sampler.counts["wrench: refused for yet another reason"] > 800
    assert max(map(len, sampler.counts)) < 150
    assert not any("\n" in name for name in sampler.counts)


def test_times_that_are_none(heavy, short_dive):
    wrench = next(m for _, role, m in short_dive if role == WRENCH)
    data = bytearray(cdr.encode(wrench))
    data[8:12] = struct.pack("<I", 10**9)
    with pytest.raises(ValueError, match="no part of a second"):
        cdr.decode_wrench(bytes(data))
    sampler = Sampler(heavy)
    sampler.push(WRENCH, wrench._replace(stamp=2**31 * 10**9 - 1))
    assert sampler.counts == {"wrench: stamp at the end of time": 1}


@pytest.mark.parametrize("variance", [5e-324, 1e-300, 1e-20])
def test_a_sensor_that_is_too_sure_of_itself(heavy, short_dive, variance):
    """A variance of next to nothing is not believed: it would stop all learning."""
    plain, sure = Sampler(heavy), Sampler(heavy)
    for _, role, m in short_dive:
        before = plain.push(role, m)
        if isinstance(m, Odometry):
            m = m._replace(twist_variance=np.full(6, variance))
        if isinstance(m, Imu):
            m = m._replace(angular_variance=np.full(3, variance))
        after = sure.push(role, m)
        assert len(after) == len(before)
        assert (after["odometry_variance"] >= 0.99e-4 * heavy.odometry.angular_std**2).all()
        assert (after["gyro_variance"] >= 0.99e-4 * heavy.imu.gyro_std**2).all()


def test_wild_messages_to_a_live_node(live, heavy, short_dive):
    """Over DDS, bytes and fields: all are counted, and what the node publishes is finite."""
    vehicle = live()
    rng = np.random.default_rng(7)
    sent = dict.fromkeys((ODOMETRY, IMU, WRENCH), 0)
    for k, (_, role, data) in enumerate(torture.wild_bytes(short_dive, 1500, rng)):
        vehicle.publish(role, data)
        sent[role] += 1
        if k % 200 == 0:
            vehicle.executor.spin_once(timeout_sec=0.01)

    def counted():
        """By role, of what /diagnostics counts by name."""
        status = vehicle.diagnostics[-1].status[0]
        assert status.name == "rls_node: inputs"
        values = {value.key: value.value for value in status.values}
        return {role: torture.accounted(role, values) for role in sent}

    vehicle.until(lambda: vehicle.diagnostics and sum(counted().values()) >= sum(sent.values()))
    assert counted() == sent
    vehicle.coefficients.clear()
    vehicle.until(lambda: len(vehicle.coefficients) > 2)
    for message in vehicle.values + vehicle.covariance:
        assert np.isfinite(message.data).all()
    for message in vehicle.residuals:
        force, torque = message.wrench.force, message.wrench.torque
        assert np.isfinite([force.x, force.y, force.z, torque.x, torque.y, torque.z]).all()
    for message in vehicle.coefficients:
        assert np.isfinite(from_diagnostics(message).values).all()
