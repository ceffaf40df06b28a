"""What both estimators make of noise, doubt, outliers and changes of the vehicle."""

import numba
import numpy as np
import pytest

from rov_ident.config.prior import prior_of
from rov_ident.core.whiteness import BY_CHANCE, LARGEST
from rov_ident.estimation import rls, ukf
from rov_ident.estimation.innovation_monitor import NIS_TIME, TIME, first_monitor, lost, watch
from rov_ident.estimation.process_noise import process
from rov_ident.sampling.records import samples_of
from rov_ident.simulation.virtual_sensors import dive

ESTIMATORS = {"rls": rls, "ukf": ukf}


@pytest.fixture(scope="module")
def noisy(heavy):
    parts = samples_of(heavy, dive(heavy, "steps", 40.0, seed=12))
    return np.concatenate([part for part in parts if len(part)])


@numba.njit(cache=True)
def watched(monitor, constants, i, innovations, moving, considered=0.0):
    """Normalised innovations of axis i, twenty a second; how many were outliers."""
    count = 0
    for e in innovations:
        monitor[i].since = 0.05
        monitor[i].acting = 10.0 * monitor[i].density
        count += watch(monitor[i], constants[0], i, 1.5, moving, moving, 5.0, e, considered)
    return count


@pytest.mark.parametrize("axis", [0, 4])
def test_the_density_stays_within_its_bounds(heavy, axis):
    """However large the innovations, coefficients can still be learnt; and noise never ends."""
    constants = process(heavy)
    for innovation, bound in ((LARGEST, "largest"), (0.0, "floor")):
        monitor = first_monitor(constants)
        watched(monitor, constants, axis, np.full(20_000, innovation), True)
        assert monitor["density"][axis] == constants[bound][0, axis]
    assert (constants["floor"] < constants["first"]).all()
    assert (constants["first"] < constants["largest"]).all()


def test_a_single_kick_is_no_change_of_the_vehicle(heavy):
    """It counts for three standard deviations, however large; what lasts is seen in a second."""
    constants = process(heavy)
    monitor = first_monitor(constants)
    assert watched(monitor, constants, 2, np.array([1e3]), True) == 1
    assert monitor["nis"][2] == pytest.approx(1.0 + 0.05 / NIS_TIME * (LARGEST**2 - 1.0))
    assert watched(monitor, constants, 2, np.full(20, 4.0), True) == 0
    assert 3.0 < monitor["nis"][2] < LARGEST**2
    assert (np.delete(monitor["nis"], 2) == 1.0).all()


def test_white_innovations_are_no_change_and_no_outliers(heavy):
    """Their NIS is 1 in the average, and what is added for noise stays below what it began with."""
    constants = process(heavy)
    monitor = first_monitor(constants)
    white = np.random.default_rng(0).standard_normal(20_000)
    assert watched(monitor, constants, 1, white, True) == 0
    assert monitor["nis"][1] == pytest.approx(1.0, abs=0.6)
    assert monitor["density"][1] < constants["first"][0, 1]


def test_the_error_of_what_is_only_considered_is_no_noise(heavy):
    """It is the same in all innovations of a filter that does not learn it: their correlation with
    it is known, and so is the power of their sums."""
    constants, rng, powers = process(heavy), np.random.default_rng(5), []
    correlation = 0.4
    for known in (correlation, 0.0):
        found = []
        for error in rng.standard_normal(100):
            monitor = first_monitor(constants)
            white = np.sqrt(1.0 - correlation**2) * rng.standard_normal(40 * 20)
            watched(monitor, constants, 5, white + correlation * error, True, known)
            found.append(monitor["power"][5])
        powers.append(np.mean(found))
    # a sum with fading memory holds 10 white ones, and of the error 20, squared: 0.84 + 0.16 x 40
    assert powers == pytest.approx([1.0, 7.2], rel=0.3)


def test_what_lasts_a_second_in_motion_is_told_from_noise(heavy):
    """By the power of sums: also where the NIS of each innovation hardly differs from 1."""
    constants, rng = process(heavy), np.random.default_rng(4)
    for lasting, least, most in ((0.0, 0.4, 2.0), (0.6, 4.0, 20.0)):
        monitor = first_monitor(constants)
        pushed = np.repeat(rng.choice([-1.0, 1.0], 240), 20)  # for a second each
        e = rng.standard_normal(len(pushed)) + lasting * pushed
        watched(monitor, constants, 3, e[: 24 * 20], True)
        assert monitor["judged"][3] == pytest.approx(24.0 - TIME, abs=0.1)
        watched(monitor, constants, 3, 3.0 * e, False)  # nor does rest say anything
        assert monitor["judged"][3] == pytest.approx(24.0 - TIME, abs=0.1)
        watched(monitor, constants, 3, e, True)
        assert least < monitor["power"][3] < most
        assert monitor["nis"][3] < 2.5


def test_a_model_that_fails_now_and_then_is_not_learnt_from_as_if_it_were_right(heavy):
    """In two of ten seconds innovations have something in common; in the others there is so little
    noise that on average all seems well. Chance does not do that, so noise is added."""
    constants, rng = process(heavy), np.random.default_rng(6)
    pushed = np.tile(np.repeat([2.0, 0.0], [40, 160]), 12)  # s / 20
    for misfit, grows in ((0.0, False), (1.0, True)):
        monitor = first_monitor(constants)
        e = 0.5 * rng.standard_normal(len(pushed)) + misfit * pushed
        watched(monitor, constants, 1, e, True)
        assert (monitor["power"][1] > BY_CHANCE**2) == grows
        assert (monitor["density"][1] > constants["first"][0, 1]) == grows


@numba.njit(cache=True)
def counted(monitor, first, outlier):
    return lost(monitor, first, outlier)


def test_outliers_count_in_a_row_and_rest_teaches_no_noise(heavy):
    constants = process(heavy)
    monitor = first_monitor(constants)
    assert watched(monitor, constants, 3, np.array([9.0, 1.0, -9.0, 9.0]), True) == 3
    refused = [True, False, True, True]
    assert [counted(monitor, 3, outlier) for outlier in refused] == [False, False, False, True]
    before = monitor.copy()
    watched(monitor, constants, 3, np.full(400, 2.0), False)
    assert monitor["density"][3] == before["density"][3]
    assert monitor["nis"][3] == pytest.approx(1.0, abs=1e-3)


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
