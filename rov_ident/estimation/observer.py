"""A Kalman filter of the velocities that works with a model, and its sensitivity to coefficients.

Used by recursive least squares, by maximum likelihood and by the Cramer-Rao bound (bench/bound.py).
Over an interval the mean moves by a Runge-Kutta step; covariance P and sensitivities
``S = d nu / d theta`` move by the linearised motion (Ljung 1999, sec. 7.4 and 11.4)::

    nu_dot = M^-1 (tau - h(nu)) + noise,      J = d nu_dot / d nu in the middle of the interval
    P <- Phi P Phi' + Q,                      Phi = 1 + J dt + ... + (J dt)^4 / 24
    S <- Phi S - Gamma Y(nu, nu_dot),         Gamma = dt (1 + J dt / 2 + ... + (J dt)^3 / 24) M^-1

with the regressor Y of ``tau = known + Y theta``. A measurement corrects nu, P and S alike.
"""

from rov_ident.core.jit import floats, inlined, reordered
from rov_ident.core.runge_kutta import NODES, linear_step, multiply, runge_kutta
from rov_ident.model.coefficients import EXTENDED_SIZE
from rov_ident.model.equations import columns, extend_inputs, generalized_force

LANES = 8  # a velocity and its displacements along six axes, side by side; one is spare
_SHIFT = 1e-6  # m/s, rad/s; of a displacement: it loses to rounding what it gains in curvature

OBSERVER = [
    *floats((6, LANES), "nu h"),
    *floats((6, 6, LANES), "mass"),  # the same in each lane
    *floats((EXTENDED_SIZE, LANES), "extended"),
    *floats((6, 1), "one_nu one_h"),
    *floats((6, 6, 1), "one_mass"),
    *floats((EXTENDED_SIZE, 1), "one_extended"),
    # wrench less restoring in mid-interval, and its slope; nu_dot of components that are guided,
    # zero for the others; nu_dot of a stage; nu after the step, and in mid-step
    *floats((6,), "force slope guide nu_dot end middle middle_nu_dot"),
    # of the mass matrix, zero for components that are guided; d nu_dot / d nu; Phi; Gamma, from a
    # wrench in the step to the velocity at its end
    *floats((6, 6), "inverse jacobian held transition into product"),
]
"""Fields of the work space. The caller sets mass, one_mass, inverse, force, slope and guide, and
the inputs by :func:`take_inputs`."""


@inlined
def force_of(sample, wrench, restoring, force, slope):
    """Wrench (6,) less restoring force in the middle of the sample's interval, and its slope."""
    for i in range(6):
        force[i], slope[i] = wrench[i], sample.wrench_slope[i]
        for j in range(3):
            middle = sample.down[j] - 0.5 * sample.dt * sample.down_slope[j]
            force[i] += restoring[i, j] * middle
            slope[i] += restoring[i, j] * sample.down_slope[j]


@inlined
def take_inputs(structure, inputs, s):
    """The inputs (4,) of an interval, in which they count as constant: their mean."""
    extend_inputs(LANES, structure, inputs, s.extended)
    extend_inputs(1, structure, inputs, s.one_extended)


@inlined
def take_guide(s):
    """Take off the force what guided components add to the other equations of motion."""
    for i in range(6):
        for j in range(6):
            s.force[i] -= s.one_mass[i, j, 0] * s.guide[j]


@inlined
def linearised_step(structure, theta, one_theta, nu, late, dt, s):
    """One step from nu (6,), beginning ``late`` seconds after mid-interval, and its linearisation.

    theta (m, LANES) and one_theta (m, 1) are the coefficients; s is a record of OBSERVER. The third
    stage is in the middle of the step: there the motion is linearised.
    """
    for i in range(6):
        s.one_nu[i, 0] = nu[i]
        s.end[i] = nu[i]
    for stage in range(4):
        if stage == 2:
            for i in range(6):
                s.middle[i] = s.one_nu[i, 0]
                for k in range(LANES):
                    s.nu[i, k] = s.middle[i] + (_SHIFT if k == i + 1 else 0.0)
            generalized_force(LANES, structure, s.mass, theta, s.nu, s.h, s.extended)
            for i in range(6):
                s.one_h[i, 0] = s.h[i, 0]
        else:
            generalized_force(
                1, structure, s.one_mass, one_theta, s.one_nu, s.one_h, s.one_extended
            )
        at = late + NODES[stage] * dt
        for i in range(6):
            total = s.guide[i]
            for j in range(6):
                total += s.inverse[i, j] * (s.force[j] + at * s.slope[j] - s.one_h[j, 0])
            s.nu_dot[i] = total
            if stage == 2:
                s.middle_nu_dot[i] = total
        runge_kutta(stage, dt, nu, s.nu_dot, s.one_nu[:, 0], s.end)
    for i in range(6):
        for k in range(6):
            total = 0.0
            for j in range(6):
                total -= s.inverse[i, j] * (s.h[j, 1 + k] - s.h[j, 0])
            s.jacobian[i, k] = total * (dt / _SHIFT)
    linear_step(s.jacobian, s.product, s.transition, s.held)
    multiply(s.held, s.inverse, dt, s.into)


@inlined
def drive_of(structure, nu, estimated, scale, n, work, out):
    """out (6, n): the wrench that a unit more of each of the n coefficients adds.

    The coefficients are theta[estimated] = scale x. ``work`` has momentum and of_motion (6, m), a
    ``scratch`` of OBSERVER, and of_rate (6, m): the caller's momentum_columns of nu_dot.
    """
    columns(structure, nu, work.momentum, work.of_motion, work.scratch[0].one_extended)
    for i in range(6):
        for a in range(n):
            e = estimated[a]
            out[i, a] = -scale[a] * (work.of_rate[i, e] + work.of_motion[i, e])


@reordered
def advance(transition, x, into, drive, out):
    """x (6, columns) = transition x + into drive; the first six rows of out are work space."""
    columns = x.shape[1]
    for i in range(6):
        a, b, c, d, e, f = (
            transition[i, 0], transition[i, 1], transition[i, 2],
            transition[i, 3], transition[i, 4], transition[i, 5],
        )  # fmt: skip
        g, h, k, l, m, n = (
            into[i, 0], into[i, 1], into[i, 2], into[i, 3], into[i, 4], into[i, 5],
        )  # fmt: skip
        for j in range(columns):
            out[i, j] = (
                a * x[0, j] + b * x[1, j] + c * x[2, j]
                + d * x[3, j] + e * x[4, j] + f * x[5, j]
                + g * drive[0, j] + h * drive[1, j] + k * drive[2, j]
                + l * drive[3, j] + m * drive[4, j] + n * drive[5, j]
            )  # fmt: skip
    for i in range(6):
        for j in range(columns):
            x[i, j] = out[i, j]


@inlined
def advance_covariance(transition, noise, dt, p, product):
    """p (6, 6) = transition p transition' + noise dt; product (6, 6) is work space."""
    for i in range(6):
        for j in range(6):
            total = 0.0
            for a in range(6):
                total += transition[i, a] * p[a, j]
            product[i, j] = total
    for i in range(6):
        for j in range(i + 1):
            total = dt * noise[i, j]
            for a in range(6):
                total += product[i, a] * transition[j, a]
            p[i, j] = total
            p[j, i] = total


@inlined
def correct(x, p, sensitivity, row, cross, total, innovation):
    """Take in one measurement: x (k,), its covariance p (k, k) and sensitivity (k, n).

    ``cross`` (k,) is the covariance of x with the ``innovation``, whose variance is ``total``, and
    ``row`` (n,) how the prediction of the measurement changes with the coefficients.
    """
    for a in range(len(x)):
        gain = cross[a] / total
        x[a] += gain * innovation
        for k in range(len(row)):
            sensitivity[a, k] -= gain * row[k]
        for b in range(len(x)):
            p[a, b] -= gain * cross[b]
