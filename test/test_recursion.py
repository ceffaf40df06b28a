"""What both estimators make of noise, doubt and surprise."""

import numba
import numpy as np
import pytest

from rov_ident import rls, ukf
from rov_ident.estimate import prior_of
from rov_ident.process_noise import LARGEST, adapt, first_adaptation, process
from rov_ident.recursion import SURPRISE_TIME, add_surprise
from rov_ident.sensors import dive, samples_of

ESTIMATORS = {"rls": rls, "ukf": ukf}


@pytest.fixture(scope="module")
def noisy(heavy):
    parts = samples_of(heavy, dive(heavy, "steps", 40.0, seed=12))
    return np.concatenate([part for part in parts if len(part)])


@numba.njit
def adapted(adaptation, constants, i, room, innovation, count):
    for _ in range(count):
        adaptation[i].since = 0.05
        adaptation[i].acting = 10.0 * adaptation[i].density
        adapt(adaptation[i], constants[0], i, room, innovation)


@pytest.mark.parametrize("axis", [0, 4])
def test_the_density_stays_within_its_bounds(heavy, axis):
    """However large the innovations, coefficients can still be learnt; and noise never ends."""
    constants = process(heavy)
    for innovation, bound in ((LARGEST, "largest"), (0.0, "floor")):
        adaptation = first_adaptation(constants)
        adapted(adaptation, constants, axis, 1.5, innovation, 20_000)
        assert adaptation["density"][axis] == constants[bound][0, axis]
    assert (constants["floor"] < constants["first"]).all()
    assert (constants["first"] < constants["largest"]).all()


@numba.njit
def surprised(surprise, ratios, since):
    for ratio in ratios:
        add_surprise(surprise, 2, ratio, since)


def test_a_single_kick_is_no_change_of_the_vehicle():
    """It counts for three standard deviations, however large; what lasts is seen in a second."""
    surprise = np.ones(6)
    surprised(surprise, np.array([1e6]), 0.05)
    assert surprise[2] == pytest.approx(1.0 + 0.05 / SURPRISE_TIME * (LARGEST**2 - 1.0))
    surprised(surprise, np.full(20, 1e6), 0.05)
    assert 3.0 < surprise[2] < LARGEST**2
    assert (np.delete(surprise, 2) == 1.0).all()


@pytest.mark.parametrize("kind", ESTIMATORS)
@pytest.mark.parametrize("where", [10, 40, 70])
def test_a_wrench_in_doubt_teaches_nothing(heavy, noisy, kind, where):
    """A force that never acted moves what is learnt a tenth as far where the sample says so."""
    module, prior = ESTIMATORS[kind], prior_of(heavy)
    task = module.problem(heavy)
    before, _ = module.fold(task, module.init(task), noisy[:-100])

    def learnt(force, doubt):
        rows = noisy[-100:].copy()
        rows["wrench"][where : where + 2, 2] += force  # one demand
        rows["wrench_doubt"][where : where + 2, 2] = doubt**2
        state, _ = module.fold(task, before, rows)
        return module.estimate(task, state, prior)

    def moved(doubt):
        clean, wrong = learnt(0.0, doubt), learnt(30.0, doubt)
        return np.abs((wrong.values - clean.values) / clean.std).max()

    assert moved(0.0) > 0.25
    assert moved(30.0) < 0.1 * moved(0.0)
