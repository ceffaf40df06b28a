"""What is learnt again once a time has moved, and what stays."""

import numpy as np
import pytest
from tiers import more

from bench.studies.at_sea import dive_of
from rov_ident import config as configuration
from rov_ident.estimation import recent_messages
from rov_ident.estimation.online import OnlineEstimator
from rov_ident.io import topics
from rov_ident.io.bag_reader import Bag


@pytest.fixture(scope="module")
def dived(tmp_path_factory):
    """A minute on six axes by the independent simulator: its configuration and its messages."""
    dive = dive_of("thruster lag", "six-axis", 5, 60.0)
    path = tmp_path_factory.mktemp("dive") / "dive.mcap"
    path.write_bytes(dive.bag)
    config = configuration.from_parameters(dive.parameters)
    bag = Bag(path)
    return config, list(topics.messages(bag, topics.select(bag, config), config))


def information(estimator):
    """Per coefficient (n,), over that of the prior."""
    variance = estimator._module.variance(estimator._task, estimator._state)
    return estimator.prior.std**2 / variance


@pytest.mark.parametrize("kind", [*more("rls"), "ukf"])
def test_what_older_messages_told_stays(kind, dived, monkeypatch):
    """Of a minute only the last 20 s are kept, which alone tell less."""
    config, messages = dived
    monkeypatch.setattr(recent_messages, "LOOK_BACK", 20.0)
    estimator = OnlineEstimator(config, kind)
    estimator.follow(messages)
    known = information(estimator)
    estimator._learn_again()
    assert np.median(information(estimator) / known) == pytest.approx(1.0, abs=0.2)

    stamp = messages[-1][1].stamp - 20 * 10**9
    late = OnlineEstimator(config, kind)
    late.follow([(role, m) for role, m in messages if m.stamp > stamp])
    assert np.median(information(late) / known) < 0.7


@pytest.mark.parametrize("kind", ["rls", *more("ukf")])
def test_what_an_earlier_record_told_stays(kind, dived):
    config, messages = dived
    estimator = OnlineEstimator(config, kind)
    estimator.follow(messages)
    known = information(estimator)
    estimator.next_record()
    estimator.follow(messages[: len(messages) // 10])
    estimator._learn_again()
    assert np.median(information(estimator) / known) > 0.95


def test_counts_and_commands_go_on_with_another_record(dived):
    config, messages = dived
    part = messages[: len(messages) // 10]
    estimator = OnlineEstimator(config, "rls")
    estimator.sampler.commands = []
    estimator.follow(part)
    first, commands = estimator.counts, len(estimator.sampler.commands)
    estimator.next_record()
    assert estimator.counts == first
    estimator.follow(part)
    assert estimator.counts == first + first and len(estimator.sampler.commands) == 2 * commands


@pytest.mark.parametrize("kind", ["rls", *more("ukf")])
def test_what_was_told_before_a_pause_stays(kind, dived):
    config, messages = dived
    estimator = OnlineEstimator(config, kind)
    estimator.follow(messages[: len(messages) // 2])
    known = information(estimator)
    estimator.enabled = False
    estimator.enabled = True
    estimator.follow(messages[len(messages) // 2 :])
    estimator._learn_again()
    assert np.median(information(estimator) / known) > 0.95


def test_messages_of_a_clock_that_was_set_back_are_forgotten(dived):
    """As where a bag is played in a loop: a later time of the first round is none before now."""
    _, messages = dived
    recent = recent_messages.RecentMessages()
    for now in (*range(100), *range(50)):
        recent.forget(float(now), memory=now)
        recent.add(*messages[0])
    assert len(recent._kept) == 50
    assert max(t for t, _ in recent._known) < 50.0 and not recent._whole
