"""The short form of `make torture`: faults and outliers of a dive, to both estimators."""

import pytest
from tiers import more

from bench.studies import torture


@pytest.mark.parametrize(
    "what",
    [
        "IMU gone",
        "hour back",
        "demands lost",
        *more("0.3 s", "velocity frozen", "wrench 300 ms late"),
    ],
)
def test_faults_in_time(what):
    """Held, used again within seconds, and the coefficients end where they would have."""
    rows = list(torture.faults(1, what))
    assert len(rows) == 4
    assert [row for row in rows if not row.met] == []


@pytest.mark.parametrize(
    "channel",
    [
        "odom linear u",
        *more(
            "imu angular_velocity x", "wrench force X", "odom angular r", "odom orientation y",
            "imu linear_acceleration z", "wrench torque N",
        ),
    ],
)  # fmt: skip
def test_outliers(channel):
    """Five per cent gross ones move no coefficient by more than a standard deviation."""
    rows = list(torture.outliers(1, channel))
    assert len(rows) == 2
    assert [row for row in rows if not row.met] == []


@pytest.mark.parametrize(
    "what", ["linear of odometry 1 wrong", *more("orientation of odometry 1 and 3")]
)
def test_begun_wrong(what):
    """What a first odometry message taught is given up when the next ones contradict it."""
    rows = list(torture.firsts(1, what))
    assert len(rows) == 2
    assert [row for row in rows if not row.met] == []


@pytest.mark.study
def test_no_excitation():
    """The covariance stays positive definite and bounded, and what is learnt later is the same."""
    rows = list(torture.rest(1, "at rest", 20_000))
    assert len(rows) == 12
    assert [row for row in rows if not row.met] == []
