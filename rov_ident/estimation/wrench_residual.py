"""The published wrench residual, measured minus model, without measuring an acceleration.

Wrench and momentum go through one low-pass filter ``F(s) = (w / (s + w))^2``, and the derivative of
the momentum P is exact: ``s w/(s + w) P = w (P - x)`` where x is the filtered P. Started with
``x(0) = P(0)`` there is no transient, so that a gap in the data costs nothing but itself.
"""

import numpy as np

from rov_ident.core.jit import inlined, inner
from rov_ident.model.equations import extend_inputs, generalized_force, six, symmetric_product


@inlined
def filtered_residual(task, theta, s, filters, sample, restarted, out):
    """out (6,) [N, N m] of the coefficients theta (m, 1).

    filters (4, 6) of :func:`two_stages` are carried from sample to sample. The record s has the
    ``wrench`` (6,) that acts, the mass matrix ``one_mass`` (6, 6, 1) of the coefficients, and as
    work space ``one_nu``, ``one_h`` (6, 1) and ``one_extended``. At a restart (after a gap) out is
    left as it is.
    """
    w = task.settings[0].corner
    for i in range(6):
        s.one_nu[i, 0] = sample.nu[i]
    extend_inputs(1, task.structure, sample.inputs[1], s.one_extended)
    generalized_force(1, task.structure, s.one_mass, theta, s.one_nu, s.one_h, s.one_extended)
    momentum = symmetric_product(s.one_mass, six(s.one_nu, 0), 0)
    response = first_order(w, sample.dt)
    for i in range(6):
        p, force = momentum[i], s.one_h[i, 0]
        for j in range(3):
            force -= task.restoring[i, j] * sample.down[j]
        wrench = of_wrench(response, sample.dt, s.wrench[i], sample.wrench_slope[i])
        two_stages(filters, i, w, response, restarted, w * p - force, p, wrench)
        if not restarted:
            out[i] = filters[1, i]


@inlined
def two_stages(filters, i, corner, response, restarted, now, momentum, wrench):
    """Filter i of filters (4, n): stage 1, stage 2, last input, last momentum; after the input
    ``now`` and what the wrench adds to stage 1. The result is stage 2."""
    x, y, u, last = filters[0], filters[1], filters[2], filters[3]
    a, b0, b1 = response
    if restarted:
        x[i], y[i] = corner * momentum, 0.0
    else:
        before = x[i] - corner * last[i]
        x[i] = a * x[i] + b0 * u[i] + b1 * now + wrench
        y[i] = a * y[i] + b0 * before + b1 * (x[i] - corner * momentum)
    u[i], last[i] = now, momentum


@inner
def first_order(corner, dt):
    """a, b0, b1 of ``x = a x + b0 u_before + b1 u_now``.

    The exact response of corner / (s + corner) to an input that is linear between samples.
    """
    a = np.exp(-corner * dt)
    b1 = 1.0 - (1.0 - a) / (corner * dt)
    return a, (1.0 - a) - b1, b1


@inlined
def of_wrench(response, dt, wrench, slope):
    """What a wrench adds, which goes in a line from sample to sample, but jumps there."""
    a, b0, b1 = response
    return (1.0 - a) * wrench + 0.5 * dt * (b1 - b0) * slope
