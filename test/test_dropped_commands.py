"""Dropped commands: how many, when, and what they may have been."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from test_samples import moments
from tiers import more

from rov_ident.core.messages import WRENCH
from rov_ident.sampling.dropped_commands import CommandPeriod, completed, estimated
from rov_ident.sampling.sample import joined
from rov_ident.sampling.sampler import Sampler
from rov_ident.simulation import virtual_sensors as sensors


def period_after(intervals):
    period = CommandPeriod()
    for interval in intervals:
        period.update(float(interval))
    return period


def nothing_dropped(intervals):
    period = CommandPeriod()
    for interval in intervals:
        if period.dropped(float(interval)):
            return False
        period.update(float(interval))
    return True


@settings(deadline=None, max_examples=60)
@given(
    period=st.floats(0.005, 0.5),
    share=st.floats(0.0, 0.25),
    jitter=st.floats(0.0, 0.03),
    seed=st.integers(0, 10**6),
)
@example(period=0.5, share=0.25, jitter=0.0, seed=14086)  # many dropped within a few seconds
def test_dropped_commands_are_counted(period, share, jitter, seed):
    """However fast the publisher, whatever share is dropped, and with some jitter in its stamps."""
    rng = np.random.default_rng(seed)
    came = np.flatnonzero(rng.random(600) >= share)
    t = period * (came + jitter * rng.uniform(-1.0, 1.0, len(came)))
    found, right = period_after(np.diff(t)[:200]), 0
    for dropped, interval in zip(np.diff(came)[200:] - 1, np.diff(t)[200:], strict=True):
        right += found.dropped(interval) == (dropped if dropped <= 9 else 0)
        found.update(interval)
    assert right >= 0.97 * (len(came) - 201)


@given(seed=st.integers(0, 10**6), longest=st.integers(6, 40))
def test_silence_that_is_meant(seed, longest):
    """Of who publishes when something changes, or at random, no command was dropped."""
    rng = np.random.default_rng(seed)
    for intervals in (0.02 * rng.integers(1, longest, 200), rng.uniform(0.01, 0.05, 200)):
        assert nothing_dropped(intervals)


@pytest.mark.parametrize("seed", range(20))
def test_means_over_one_period_or_two(seed):
    """As in a record whose rows hold the mean command since the row before, some dropped."""
    rng = np.random.default_rng(seed)
    assert nothing_dropped(
        0.1 * rng.choice([1, 2], 1000, p=[0.45, 0.55]) + rng.uniform(0, 0.001, 1000)
    )


@pytest.mark.parametrize("first, then", [(0.02, 0.05), (0.05, 0.02), (0.02, 0.04), (0.04, 0.02)])
def test_another_rate(first, then):
    """It is followed; until then at most 60 intervals are misread."""
    period, dropped = period_after([first] * 200), []
    for _ in range(200):
        dropped.append(period.dropped(then))
        period.update(then)
    assert not any(dropped[60:])
    assert period.dropped(3 * then) == 2


def test_what_a_dropped_command_may_have_been():
    """One step, with any of the commands to come: mean and variance are those of all cases."""
    before, after, count = np.arange(6.0), np.array([3.0, 1.0, -4.0, 3.0, 0.0, 5.0]), 3
    commands = estimated(2.0, before, 4.0, after, count)
    for j, (t, value, variance) in enumerate(commands, 1):
        cases = np.array([after if step <= j else before for step in range(1, count + 2)])
        assert t == pytest.approx(2.0 + 0.5 * j)
        np.testing.assert_allclose(value, cases.mean(axis=0), atol=1e-12)
        np.testing.assert_allclose(variance, cases.var(axis=0), atol=1e-12)


def test_a_record_is_completed():
    rng = np.random.default_rng(2)
    t, commands = 0.02 * np.arange(500), rng.standard_normal((500, 6))
    same = completed(t, commands)
    assert np.array_equal(same[0], t) and np.array_equal(same[1], commands)
    kept = rng.random(500) > 0.2
    kept[[0, -1]] = True
    filled_t, filled = completed(t[kept], commands[kept])
    late = filled_t > 2.0  # before, the publisher is not known to be regular
    np.testing.assert_allclose(filled_t[late], t[t > 2.0], atol=1e-9)
    came = np.isin(np.round(filled_t / 0.02), np.flatnonzero(kept))
    assert np.array_equal(filled[came], commands[kept])


@pytest.mark.parametrize("seed", [0, *more(1, 2, 3)])
def test_the_wrench_is_not_late(heavy, seed):
    """Nor early, and its error is as large as is said; against commands held until the next."""
    rng = np.random.default_rng(seed)
    suite = sensors.Suite().scaled(0.0)
    messages = sensors.dive(heavy, "multisine", 30.0, suite, seed).messages
    share = rng.uniform(0.05, 0.25)
    partly = [m for m in messages if m[1] != WRENCH or rng.random() >= share]

    def samples(messages):
        """Those from 5 s on, when the publisher is known to be regular; and the commands."""
        sampler = Sampler(heavy)
        sampler.commands = []
        parts = [sampler.push(role, message) for _, role, message in messages]
        taken = joined([*parts, sampler.flush()])
        late = (sampler.origin - sensors.START) * 1e-9
        taken["t"] += late
        commands = [(round(t + late, 6), wrench) for t, wrench in sampler.commands]
        return taken[taken["t"] > 5.0], dict(commands)

    (whole, commands), (part, _) = samples(messages), samples(partly)
    t, i, j = np.intersect1d(np.round(whole["t"], 6), np.round(part["t"], 6), False, True)
    assert len(t) > 0.99 * len(whole)
    whole, part = whole[i], part[j]
    came = {round((m.stamp - sensors.START) * 1e-9, 6) for _, role, m in partly if role == WRENCH}
    instants = np.array(sorted(came & commands.keys()))
    kept = np.array([commands[at] for at in instants])
    held = [moments(instants, kept, end - s["dt"], end)[0] for end, s in zip(t, whole, strict=True)]

    def compared(wrench):
        """Lateness (6,) [s] of a mean wrench, and the mean square (6,) of its error."""
        error, slope = wrench - whole["wrench"], np.gradient(whole["wrench"], t, axis=0)
        late = -np.sum(error * slope, axis=0) / np.sum(slope**2, axis=0)
        return late, np.mean(error**2, axis=0)

    (late, error), (late_held, error_held) = compared(part["wrench"]), compared(np.array(held))
    assert np.abs(late).max() < 0.1 * late_held.min(), (late, late_held)
    assert np.all(error < 0.3 * error_held)
    assert np.all(error < 1.5 * np.mean(part["wrench_doubt"], axis=0))
