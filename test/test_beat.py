"""Demands that got lost: how many, when, and what they may have been."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from test_samples import moments

from rov_ident import sensors
from rov_ident.beat import Beat, between, completed
from rov_ident.samples import WRENCH, Sampler


def heard(intervals):
    beat = Beat()
    for interval in intervals:
        beat.hear(float(interval))
    return beat


def nothing_lost(intervals):
    beat = Beat()
    for interval in intervals:
        if beat.lost(float(interval)):
            return False
        beat.hear(float(interval))
    return True


@settings(deadline=None, max_examples=60)
@given(
    period=st.floats(0.005, 0.5),
    share=st.floats(0.0, 0.25),
    jitter=st.floats(0.0, 0.03),
    seed=st.integers(0, 10**6),
)
@example(period=0.5, share=0.25, jitter=0.0, seed=14086)  # many lost within a few seconds
def test_what_is_lost_is_counted(period, share, jitter, seed):
    """However fast the publisher, whatever share is lost, and with some jitter in its stamps."""
    rng = np.random.default_rng(seed)
    came = np.flatnonzero(rng.random(600) >= share)
    t = period * (came + jitter * rng.uniform(-1.0, 1.0, len(came)))
    beat, right = heard(np.diff(t)[:200]), 0
    for lost, interval in zip(np.diff(came)[200:] - 1, np.diff(t)[200:], strict=True):
        right += beat.lost(interval) == (lost if lost <= 9 else 0)
        beat.hear(interval)
    assert right >= 0.97 * (len(came) - 201)


@given(seed=st.integers(0, 10**6), longest=st.integers(6, 40))
def test_silence_that_is_meant(seed, longest):
    """Who publishes when something changes, or keeps no time, has lost nothing."""
    rng = np.random.default_rng(seed)
    for intervals in (0.02 * rng.integers(1, longest, 200), rng.uniform(0.01, 0.05, 200)):
        assert nothing_lost(intervals)


@pytest.mark.parametrize("seed", range(20))
def test_means_over_one_beat_or_two(seed):
    """As in a record whose rows hold the mean demand since the row before, some of them dropped."""
    rng = np.random.default_rng(seed)
    assert nothing_lost(
        0.1 * rng.choice([1, 2], 1000, p=[0.45, 0.55]) + rng.uniform(0, 0.001, 1000)
    )


@pytest.mark.parametrize("first, then", [(0.02, 0.05), (0.05, 0.02), (0.02, 0.04), (0.04, 0.02)])
def test_another_rate(first, then):
    """It is followed; what is guessed until then are a few dozen demands."""
    beat, guessed = heard([first] * 200), []
    for _ in range(200):
        guessed.append(beat.lost(then))
        beat.hear(then)
    assert not any(guessed[60:])
    assert beat.lost(3 * then) == 2


def test_what_a_lost_demand_may_have_been():
    """One step, with any of the demands to come: mean and variance are those of all cases."""
    before, after, count = np.arange(6.0), np.array([3.0, 1.0, -4.0, 3.0, 0.0, 5.0]), 3
    guesses = between(2.0, before, 4.0, after, count)
    for j, (t, value, variance) in enumerate(guesses, 1):
        cases = np.array([after if step <= j else before for step in range(1, count + 2)])
        assert t == pytest.approx(2.0 + 0.5 * j)
        np.testing.assert_allclose(value, cases.mean(axis=0), atol=1e-12)
        np.testing.assert_allclose(variance, cases.var(axis=0), atol=1e-12)


def test_a_record_is_completed():
    rng = np.random.default_rng(2)
    t, demands = 0.02 * np.arange(500), rng.standard_normal((500, 6))
    same = completed(t, demands)
    assert np.array_equal(same[0], t) and np.array_equal(same[1], demands)
    kept = rng.random(500) > 0.2
    kept[[0, -1]] = True
    filled_t, filled = completed(t[kept], demands[kept])
    late = filled_t > 2.0  # before, nobody knows that it keeps time
    np.testing.assert_allclose(filled_t[late], t[t > 2.0], atol=1e-9)
    came = np.isin(np.round(filled_t / 0.02), np.flatnonzero(kept))
    assert np.array_equal(filled[came], demands[kept])


@pytest.mark.parametrize("seed", range(4))
def test_the_wrench_is_not_late(heavy, seed):
    """Nor early, and as doubtful as is said; against demands that are held until the next."""
    rng = np.random.default_rng(seed)
    suite = sensors.Suite().scaled(0.0)
    messages = sensors.dive(heavy, "multisine", 30.0, suite, seed).messages
    share = rng.uniform(0.05, 0.25)
    partly = [m for m in messages if m[1] != WRENCH or rng.random() >= share]

    def samples(messages):
        """Those from 5 s on, as before it is not known that the publisher keeps time; demands."""
        sampler = Sampler(heavy)
        sampler.demands = []
        parts = [sampler.push(role, message) for _, role, message in messages]
        taken = np.concatenate([*parts, sampler.flush()])
        late = (sampler.origin - sensors.START) * 1e-9
        taken["t"] += late
        demands = [(round(t + late, 6), wrench) for t, wrench in sampler.demands]
        return taken[taken["t"] > 5.0], dict(demands)

    (whole, demands), (part, _) = samples(messages), samples(partly)
    t, i, j = np.intersect1d(np.round(whole["t"], 6), np.round(part["t"], 6), False, True)
    assert len(t) > 0.99 * len(whole)
    whole, part = whole[i], part[j]
    came = {round((m.stamp - sensors.START) * 1e-9, 6) for _, role, m in partly if role == WRENCH}
    instants = np.array(sorted(came & demands.keys()))
    kept = np.array([demands[at] for at in instants])
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
