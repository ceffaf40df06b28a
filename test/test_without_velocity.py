"""A bag of a vehicle without a velocity sensor: one sentence says what is impossible."""

from itertools import islice

import numpy as np
import pytest

import rov_ident as ri
from bench import HEAVY, ROOT
from rov_ident.cli.program import main
from rov_ident.core.messages import Odometry
from rov_ident.io import topics
from rov_ident.io.bag_reader import Bag
from rov_ident.io.write_messages import write_messages
from rov_ident.sampling.without_velocity import refuse_without_velocity

NOT_MEASURED = {
    "large variance": (0.0, 1e6),
    "variance of minus one": (0.0, -1.0),
    "NaN": (np.nan, 0.0),
    "zeros": (0.0, 0.0),
}


@pytest.fixture(scope="module")
def messages():
    """The first messages of the shipped dive."""
    bag, config = Bag(ROOT / "bags" / "demo.mcap"), ri.load(HEAVY)
    return list(islice(topics.messages(bag, topics.select(bag, config), config), 300))


def written(path, messages, linear, variance, every=1):
    """The messages, of whose velocities one of ``every`` is replaced; None leaves a field."""
    rows = []
    for k, (role, message) in enumerate(messages):
        if isinstance(message, Odometry) and k % every == 0:
            given = message.twist_variance.copy()
            given[:3] = given[:3] if variance is None else variance
            velocity = message.linear if linear is None else np.full(3, linear)
            message = message._replace(linear=velocity, twist_variance=given)
        rows.append((message.stamp, role, message))
    write_messages(path, rows)
    return path


def refuse(path):
    bag, config = Bag(path), ri.load(HEAVY)
    refuse_without_velocity(bag, topics.select(bag, config), config)


@pytest.mark.parametrize("how", NOT_MEASURED)
def test_velocities_that_were_not_measured(messages, tmp_path, how):
    path = written(tmp_path / "dive.mcap", messages, *NOT_MEASURED[how])
    with pytest.raises(ri.UserError, match=r"Surge and sway, .* are impossible to identify so"):
        refuse(path)


@pytest.mark.parametrize(
    ("linear", "variance", "every"),
    [
        (None, None, 1),
        (None, -1.0, 1),  # a driver that knows no variance
        (np.nan, 0.0, 2),  # a DVL that loses the ground now and then
    ],
)
def test_velocities_that_were(messages, tmp_path, linear, variance, every):
    refuse(written(tmp_path / "dive.mcap", messages, linear, variance, every))


def test_a_vehicle_at_rest_is_another_matter(messages, tmp_path):
    still = [
        (role, m._replace(position=np.zeros(3)) if isinstance(m, Odometry) else m)
        for role, m in messages
    ]
    refuse(written(tmp_path / "rest.mcap", still, *NOT_MEASURED["zeros"]))


def test_every_command_says_so(messages, tmp_path, capsys):
    path = str(written(tmp_path / "dive.mcap", messages, *NOT_MEASURED["large variance"]))
    given, out = ["--config", str(HEAVY)], str(tmp_path / "out")
    for command in (
        ["fit", path, *given, "--estimator", "ml"],
        ["fit", path, *given, "--estimator", "rls"],
        ["check", path, *given],
        ["identify", path, *given, "--out", out],
        ["explain", path, *given, "--out", out],
        ["plan", "--bag", path, *given],
    ):
        assert main(command) == 2, command
        shown = capsys.readouterr()
        assert "dive.mcap has no linear velocity: /odom marks" in shown.err, command
        assert "record a velocity sensor (DVL)" in shown.err and not shown.out
