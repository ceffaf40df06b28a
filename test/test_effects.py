"""What every effect must keep, over all that there are; then each against its own equation."""

import math

import numpy as np
import pytest

from rov_ident.effects import EFFECTS
from rov_ident.effects.base import Array, Effect

INPUT_EFFECTS = [effect for effect in EFFECTS.values() if effect.place == "input"]

DEMAND = np.array([40.0, -30.0, 0.0, 1.0, -2.0, 5.0])
BEFORE = np.array([-10.0, 20.0, 15.0, 0.0, 3.0, 5.0])

every_effect = pytest.mark.parametrize("effect", EFFECTS.values(), ids=EFFECTS)
every_input_effect = pytest.mark.parametrize("effect", INPUT_EFFECTS, ids=lambda e: e.name)


def choices(effect: Effect) -> list[dict[str, float]]:
    """All parameters through their ranges together, then each alone with the others at null."""
    shares = (0.0, 0.01, 0.1, 0.5, 1.0)
    null = {p.name: p.null for p in effect.parameters}
    ranges = {
        p.name: [p.lower + f * (p.upper - p.lower) for f in shares] for p in effect.parameters
    }
    together = [dict(zip(ranges, values)) for values in zip(*ranges.values())]
    alone = [null | {name: value} for name, values in ranges.items() for value in values]
    return [null, *together, *alone]


def run(effect: Effect, demands: list[Array], dt: float, **parameters: float) -> Array:
    """What acts (n, 6) in n steps, from equilibrium with BEFORE."""
    state, acting = effect.start(BEFORE), []
    for demand in demands:
        state, mean = effect.step(state, demand, dt, **parameters)
        acting.append(mean)
    return np.array(acting)


# ------------------------------------------------------------------ every effect


def test_the_folder_is_the_list():
    assert "thruster_lag" in EFFECTS
    assert "base" not in EFFECTS


@every_effect
def test_the_name_is_that_of_the_file_and_everything_is_said(effect):
    assert EFFECTS[effect.name] is effect
    assert effect.place in ("input", "motion", "wrench")
    assert effect.summary.endswith(".")
    assert effect.source
    assert effect.parameters
    assert all(p.name and p.unit and p.meaning for p in effect.parameters)
    assert len({p.name for p in effect.parameters}) == len(effect.parameters)


@every_effect
def test_bounds_are_finite_and_contain_the_null(effect):
    """The null may lie on a bound: where an effect ends, the search begins."""
    for p in effect.parameters:
        assert math.isfinite(p.lower) and math.isfinite(p.upper)
        assert p.lower < p.upper
        assert p.lower <= p.null <= p.upper


# ------------------------------------------------------------------ effects on the input


@every_input_effect
@pytest.mark.parametrize("dt", [0.002, 0.1, 10.0])
def test_at_null_what_is_demanded_acts(effect, dt):
    null = {p.name: p.null for p in effect.parameters}
    demands = [DEMAND, BEFORE, 2.0 * DEMAND, np.zeros(6)]
    np.testing.assert_array_equal(run(effect, demands, dt, **null), demands)


@every_input_effect
def test_close_to_null_nearly_what_is_demanded_acts(effect):
    """No jump at the null: a search may pass through it."""
    near = {
        p.name: p.null + 1e-9 * (p.upper - p.lower) * (1 if p.null < p.upper else -1)
        for p in effect.parameters
    }
    demands = [DEMAND, BEFORE, 2.0 * DEMAND, np.zeros(6)]
    np.testing.assert_allclose(run(effect, demands, 0.02, **near), demands, atol=1e-4)


@every_input_effect
def test_a_step_is_finite_keeps_shapes_and_writes_into_nothing(effect):
    for parameters in choices(effect):
        for dt in (0.0, 1e-6, 0.02, 3600.0):
            demand = DEMAND.copy()
            demand.setflags(write=False)
            state = effect.start(BEFORE)
            state.setflags(write=False)
            new, acting = effect.step(state, demand, dt, **parameters)
            assert np.shape(new) == np.shape(state)
            assert np.shape(acting) == (6,)
            assert np.isfinite(new).all() and np.isfinite(acting).all()
            # The state is all there is: the same step again does the same.
            again, _ = effect.step(state, demand, dt, **parameters)
            np.testing.assert_array_equal(new, again)


@every_input_effect
def test_starting_makes_a_state_of_its_own(effect):
    demand = BEFORE.copy()
    effect.start(demand)[...] = 0.0
    np.testing.assert_array_equal(demand, BEFORE)


@every_input_effect
@pytest.mark.parametrize("parts", [2, 7])
def test_a_split_step_has_the_same_mean_and_end(effect, parts):
    """What acts is exact, however the demand is sampled."""
    for parameters in choices(effect):
        start = effect.start(BEFORE)
        end, mean = effect.step(start, DEMAND, 0.2, **parameters)
        state, means = start, []
        for _ in range(parts):
            state, acting = effect.step(state, DEMAND, 0.2 / parts, **parameters)
            means.append(acting)
        np.testing.assert_allclose(state, end, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(np.mean(means, axis=0), mean, rtol=1e-11, atol=1e-11)


# ------------------------------------------------------------------ thruster_lag

LAG = EFFECTS["thruster_lag"]


@pytest.mark.parametrize("time_constant", [0.05, 0.24, 3.0])
def test_lag_is_the_first_order_response(time_constant):
    """``acting = demand + (before - demand) exp(-t/T)``, and its mean is the integral over dt."""
    dt, n = 0.02, 100
    t = dt * np.arange(n)[:, None]
    state, ends = LAG.start(BEFORE), []
    for _ in range(n):
        ends.append(state)
        state, _ = LAG.step(state, DEMAND, dt, time_constant=time_constant)
    expected = DEMAND + (BEFORE - DEMAND) * np.exp(-t / time_constant)
    np.testing.assert_allclose(ends, expected, rtol=1e-12, atol=1e-12)
    integral = DEMAND * dt + (BEFORE - DEMAND) * time_constant * (
        np.exp(-t / time_constant) - np.exp(-(t + dt) / time_constant)
    )
    acting = run(LAG, [DEMAND] * n, dt, time_constant=time_constant)
    np.testing.assert_allclose(acting, integral / dt, rtol=1e-10, atol=1e-10)


def test_lag_keeps_the_impulse_of_a_pulse():
    """However coarse the steps: what was demanded is all delivered in the end."""
    for dt in (0.01, 0.5):
        demands = [BEFORE] + [DEMAND] * round(2.0 / dt) + [BEFORE] * round(20.0 / dt)
        acting = run(LAG, demands, dt, time_constant=0.3)
        np.testing.assert_allclose(
            np.sum(acting - BEFORE, axis=0) * dt, (DEMAND - BEFORE) * 2.0, rtol=1e-10
        )


def test_lag_reaches_63_percent_after_its_time_constant():
    state, _ = LAG.step(np.zeros(6), np.full(6, 100.0), 0.24, time_constant=0.24)
    np.testing.assert_allclose(state, 100.0 * (1.0 - math.exp(-1.0)), rtol=1e-14)
