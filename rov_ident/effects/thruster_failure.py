"""A thruster fails at a time: from then on it gives only a share of its command.

Thruster j has the share ``p_j`` of a commanded wrench, a row of the pseudo-inverse of the
allocation B, and makes the wrench ``b_j``, a column of B, per newton. With a factor on that::

    wrench = command - (1 - gain) b_j (p_j . command)

which is of rank one. Where no allocation is known, each axis gives a share of its command.
"""

import numpy as np

from rov_ident.core.jit import kernel
from rov_ident.effects.base import ONSET, Array, Effect, EffectParameter, per_axis
from rov_ident.model.coefficients import AXES

_GAIN, _PUSH, _SHARE = 7, 9, 15  # where these begin among the parameters


@kernel
def act(p, state, t, dt, wrench):
    onset = p[6]
    if t + dt <= onset and t < onset:
        return
    after = 1.0 if t >= onset else (t + dt - onset) / dt  # share of the step
    lost = 0.0  # newtons of the one thruster
    for i in range(6):
        lost += after * (1.0 - p[_GAIN]) * p[_SHARE + i] * wrench[i]
    for i in range(6):
        wrench[i] *= 1.0 - after * (1.0 - p[i])
        wrench[i] -= lost * p[_PUSH + i]


def of_thrusters(allocation: Array) -> list[dict[str, float]]:
    """Number, wrench per newton and share of the command of each thruster of an allocation (6, n),
    counted from one."""
    inverse = np.linalg.pinv(allocation)
    inverse[np.abs(inverse) < 1e-9 * np.abs(inverse).max()] = 0.0  # rounding
    each = zip(allocation.T.tolist(), inverse.tolist(), strict=True)
    return [
        {"thruster": float(number)}
        | {f"push_{axis}": b for axis, b in zip(AXES, push, strict=True)}
        | {f"share_{axis}": p for axis, p in zip(AXES, share, strict=True)}
        for number, (push, share) in enumerate(each, 1)
    ]


def _shape(prefix: str, meaning: str, unit: str) -> list[EffectParameter]:
    return [
        EffectParameter(
            f"{prefix}_{axis}", unit, f"{meaning} {axis}", 0.0, -1e3, 1e3, 1.0, axis, "shape"
        )
        for axis in AXES
    ]


EFFECT = Effect(
    place="input",
    summary="From a time on, or from the start, a part of the thrust is missing.",
    lasting=("thruster_gain",),
    traits=("neglecting",),
    manoeuvre="the same steps of thrust on every axis at the beginning and at the end of the bag",
    source="Sarkar, Podder, Antonelli (2002), Fault-accommodating thruster force allocation of an "
    "AUV considering thruster redundancy and saturation, IEEE Trans. Robotics and Automation 18(2)",
    parameters=(
        *per_axis("gain", "factor after the failure, on the command", 1.0, 0.0, 5.0, 0.2),
        ONSET,
        EffectParameter("gain", "1", "the same of a single thruster", 1.0, -2.0, 5.0, 0.2),
        EffectParameter("thruster", "1", "its number", 0.0, 0.0, 1e3, 1.0, role="shape"),
        *_shape("push", "what it makes per newton of", "N/N or m"),
        *_shape("share", "its force per unit commanded of", "N/N or 1/m"),
    ),
    act=act,
    of_thrusters=of_thrusters,
    order=42,
)
