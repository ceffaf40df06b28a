"""Rows of RLS about poor estimates are taken again about better ones."""

import numpy as np
import pytest
import yaml
from tiers import more

from bench.studies.at_sea import dive_of
from rov_ident.estimation import iterated_update, rls
from rov_ident.estimation.online import OnlineEstimator
from rov_ident.io import topics
from rov_ident.io.bag_reader import Bag
from rov_ident.sampling.sample import after_reset

SCALE = "thrust_scale.scale"


@pytest.fixture(scope="module", params=[0, *more(6, 15, 16)])
def dived(request, tmp_path_factory):
    """A minute of a pilot's driving by the independent simulator: the estimator after it, all
    samples since it last began anew, and the true coefficients."""
    dive = dive_of("clean", "pilot", request.param, 60.0)
    folder = tmp_path_factory.mktemp("dive")
    (folder / "dive.mcap").write_bytes(dive.bag)
    document = {"/**": {"ros__parameters": dive.parameters}}
    (folder / "vehicle.yaml").write_text(yaml.safe_dump(document))
    estimator = OnlineEstimator(folder / "vehicle.yaml", "rls")
    samples = []

    class Window(iterated_update.IteratedUpdate):
        def begin(self, state):
            super().begin(state)
            if state.scalars["t"] == 0.0:  # nothing is learnt
                samples.clear()

        def after(self, task, state, new):
            samples.append(new.copy())
            return super().after(task, state, new)

    estimator._update = Window(estimator._state)
    bag = Bag(folder / "dive.mcap")
    for role, message in topics.messages(
        bag, topics.select(bag, estimator.config), estimator.config
    ):
        estimator.push(role, message)
    estimator.flush()
    return estimator, after_reset(np.concatenate(samples)), dive.vehicle.theta


def true_solution(estimator, theta):
    """The coordinates of the true coefficients: the thrust scale is one."""
    prior, task = estimator.prior, estimator._task
    values = prior.mean.copy()
    for name, value in theta.items():
        values[prior.names.index(name)] = value
    i, start = task.thrust, prior.mean
    values[i] = 1.0
    ratio = values[i] / start[i]
    out = (np.where(task.per_thrust, values / ratio, values) - start) / task.scale
    out[i] = start[i] * (1.0 - 1.0 / ratio) / task.scale[i]
    np.testing.assert_allclose(rls._values(task, out), values, rtol=1e-12)
    return out


def test_it_claims_no_more_than_rows_about_the_truth(dived):
    """What rows about poor estimates claim to know, of the thrust scale most of all, is not there:
    without looking back the claim is half as wide as the truth's."""
    estimator, samples, theta = dived
    task = estimator._task
    state = rls.fold_about(task, rls.init(task), samples, true_solution(estimator, theta))
    i = estimator.prior.names.index(SCALE)
    honest = rls.estimate(task, state, estimator.prior).std[i]
    claimed = rls.estimate(task, estimator._state, estimator.prior)
    assert claimed.std[i] > 0.75 * honest
    assert abs(claimed.values[i] - 1.0) < 3.0 * claimed.std[i]


def test_only_stamps_decide(dived):
    """The same numbers, to the last bit, whether samples come one by one or all at once."""
    estimator, samples, _ = dived
    states = []
    for size in (1, 977, len(samples)):
        one = OnlineEstimator(estimator.config, "rls")
        for first in range(0, len(samples), size):
            one._fold(samples[first : first + size])
        states.append(one.state)
    for other in states[1:]:
        for a, b in zip(states[0], other, strict=True):
            np.testing.assert_array_equal(a, b)


def test_a_window_is_folded_about_one_estimate_and_given_up(dived):
    """Twice as many samples as come in are folded again at most; nothing is kept for good."""
    estimator, samples, _ = dived
    task, state = estimator._task, rls.init(estimator._task)
    update, again, most = iterated_update.IteratedUpdate(state), 0, 0
    fold_about = rls.fold_about

    def counted(task, state, samples, solution):
        nonlocal again
        again += len(samples)
        return fold_about(task, state, samples, solution)

    rest = samples
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rls, "fold_about", counted)
        while len(rest):
            count = update.until_due(rest)
            state, _ = rls.fold(task, state, rest[:count])
            state = update.after(task, state, rest[:count])
            most = max(most, sum(len(part) for part in update._samples))
            rest = rest[count:]
    assert 0 < again < 2 * len(samples)
    assert most <= 1.1 * 30.0 / np.median(samples["dt"])


def test_while_disabled_nothing_is_looked_back_on(dived):
    estimator, samples, _ = dived
    one = OnlineEstimator(estimator.config, "rls")
    one._fold(samples[:700])  # 7 s: the first look is due after 7.5
    one.enabled = False
    before = one.state
    one.flush()
    assert one.state is before
    one.enabled = True
    one.flush()
    assert one.state is not before
