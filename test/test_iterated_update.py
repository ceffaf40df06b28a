"""What samples told about poor estimates is taken again about better ones."""

import numpy as np
import pytest
import yaml
from tiers import more

from bench.studies.at_sea import dive_of
from rov_ident.estimation import iterated_update
from rov_ident.estimation.online import OnlineEstimator
from rov_ident.estimation.thrust_coordinates import values_of
from rov_ident.io import topics
from rov_ident.io.bag_reader import Bag
from rov_ident.sampling.sample import after_reset

SCALE = "thrust_scale.scale"


CASES = [("rls", 0), ("ukf", 0), *more(*[((k, n),) for k in ("rls", "ukf") for n in (6, 15, 16)])]


@pytest.fixture(scope="module", params=CASES)
def dived(request, tmp_path_factory):
    """A minute of a pilot's driving by the independent simulator: the estimator after it, all
    samples since it last began anew, and the true coefficients."""
    kind, seed = request.param
    dive = dive_of("clean", "pilot", seed, 60.0)
    folder = tmp_path_factory.mktemp("dive")
    (folder / "dive.mcap").write_bytes(dive.bag)
    document = {"/**": {"ros__parameters": dive.parameters}}
    (folder / "vehicle.yaml").write_text(yaml.safe_dump(document))
    estimator = OnlineEstimator(folder / "vehicle.yaml", kind)
    samples = []

    class Window(iterated_update.IteratedUpdate):
        def begin(self, state):
            super().begin(state)
            if state.scalars["t"] == 0.0:  # nothing is learnt
                samples.clear()

        def after(self, task, state, new):
            samples.append(new.copy())
            return super().after(task, state, new)

    estimator._update = Window(estimator._module, estimator._state)
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
    np.testing.assert_allclose(values_of(task, out), values, rtol=1e-12)
    return out if estimator.kind == "rls" else task.start + out


def test_it_claims_no_more_than_rows_about_the_truth(dived):
    """What rows about poor estimates claim to know, of the thrust scale most of all, is not there:
    without looking back the claim is half as wide as the truth's."""
    estimator, samples, theta = dived
    task, module = estimator._task, estimator._module
    state = module.fold_about(task, module.init(task), samples, true_solution(estimator, theta))
    i = estimator.prior.names.index(SCALE)
    honest = module.estimate(task, state, estimator.prior).std[i]
    claimed = module.estimate(task, estimator._state, estimator.prior)
    assert claimed.std[i] > 0.75 * honest
    assert abs(claimed.values[i] - 1.0) < 3.0 * claimed.std[i]


def test_only_stamps_decide(dived):
    """The same numbers, to the last bit, whether samples come one by one or all at once."""
    estimator, samples, _ = dived
    states = []
    for size in (1, 977, len(samples)):
        one = OnlineEstimator(estimator.config, estimator.kind)
        for first in range(0, len(samples), size):
            one._fold(samples[first : first + size])
        states.append(one.state)
    for other in states[1:]:
        for a, b in zip(states[0], other, strict=True):
            np.testing.assert_array_equal(a, b)


def test_a_window_is_folded_about_one_estimate_and_given_up(dived):
    """Twice as many samples as come in are folded again at most; nothing is kept for good."""
    estimator, samples, _ = dived
    task, module = estimator._task, estimator._module
    state = module.init(task)
    update, again, most = iterated_update.IteratedUpdate(module, state), 0, 0
    fold_about = module.fold_about

    def counted(task, state, samples, solution):
        nonlocal again
        again += len(samples)
        return fold_about(task, state, samples, solution)

    rest = samples
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "fold_about", counted)
        while len(rest):
            count = update.until_due(rest)
            state, _ = module.fold(task, state, rest[:count])
            state = update.after(task, state, rest[:count])
            most = max(most, sum(len(part) for part in update._samples))
            rest = rest[count:]
    assert 0 < again < 2 * len(samples)
    assert most <= 1.1 * 30.0 / np.median(samples["dt"])


def test_a_clock_that_is_set_back_begins_a_new_window(dived):
    """Samples would gather until the old time comes again, and none be taken about better ones."""
    estimator, samples, _ = dived
    one = OnlineEstimator(estimator.config, estimator.kind)
    part = samples[samples["t"] < samples["t"][0] + 20.0]
    for start in (0.0, -3600.0):
        moved = part.copy()
        moved["t"] += start
        moved["restart"][0] = True
        one.take(moved)
    kept = [t for held in one._update._samples for t in held["t"]]
    assert not kept or max(kept) < 0.0


def test_while_disabled_nothing_is_looked_back_on(dived, monkeypatch):
    estimator, samples, _ = dived
    one, looks = OnlineEstimator(estimator.config, estimator.kind), []
    monkeypatch.setattr(one._update, "iterate", lambda task, state: looks.append(state) or state)
    one._fold(samples[:700])  # 7 s: the first look is due after 7.5
    one.enabled = False
    one.flush()
    assert not looks
    one.enabled = True
    one.flush()
    assert len(looks) == 1


def test_what_walks_is_no_reason_to_look_back(dived):
    """A current is where it is now, and has not been there all the time."""
    estimator, samples, _ = dived
    task, module = estimator._task, estimator._module
    window = samples[samples["t"] > samples["t"][-1] - 15.0]
    before = module.init(task)
    update = iterated_update.IteratedUpdate(module, before)
    update.until_due(window)
    state, _ = module.fold(task, before, window)
    update._samples.append(window)
    solution, std = module.solution_of(state)
    walks = task.drift * (window["t"][-1] - window["t"][0]) > std**2
    assert walks.any() and not walks.all()
    looks = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "fold_about", lambda *_: looks.append(True))
        for moved in (walks, ~walks):
            update._about = solution + np.where(moved, 3.0 * std, 0.0)
            assert update.iterate(task, state) is state
            assert bool(looks) == (not moved[walks].any())
