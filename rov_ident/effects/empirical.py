"""What has no name: a force or moment on one axis, as a smooth function of one or two variables.

``scale sum_ij w_ij B_i(a) B_j(b)``, with cubic B-splines B whose knots lie evenly between ``low``
and ``high`` of each variable; beyond them the function keeps its value. The heading and the time in
a period close upon themselves. A function of a velocity alone may also jump where that changes its
sign, as dry friction does, which splines would need ten times as many knots for. On axes of the
body, or along an axis of the world. Numbers of axes and variables are their places in :data:`ON`
and :data:`OF`; the weights are N or N m.
"""

import math

from rov_ident.core.jit import kernel, lean
from rov_ident.effects.base import Effect, EffectParameter

ON = ("X", "Y", "Z", "K", "M", "N", "north", "east", "down")
VELOCITY, ANGLE, PLACE = ("u", "v", "w", "p", "q", "r"), ("roll", "pitch", "heading"), ON[6:8]
OF = ("nothing", *VELOCITY, *ANGLE, *PLACE, "depth", "thrust", "time")
ROLL, PITCH, HEADING, NORTH, THRUST, TIME = 7, 8, 9, 10, 13, 14
ALONE, EACH = 24, 6  # splines of a function of one variable; for each of two
_WIDTH = 0.03  # of a jump, over the largest velocity: a third of the distance between two knots
_SHAPE = 8  # parameters before the weights


@lean
def variable(which, axis, t, position, nu, rotation, thrust):
    """The value of a variable of OF [SI; rad]; thrust is that on the same axis."""
    if which < ROLL:
        return nu[which - 1]
    if which == ROLL:
        return math.atan2(rotation[2, 1], rotation[2, 2])
    if which == PITCH:
        return -math.asin(min(max(rotation[2, 0], -1.0), 1.0))
    if which == HEADING:
        return math.atan2(rotation[1, 0], rotation[0, 0])
    if which < THRUST:
        return position[which - NORTH]
    return thrust[min(axis, 5)] if which == THRUST else t


@lean
def splines(x, low, high, count, wraps):
    """The first of ``count`` cubic B-splines that x meets, and the values of it and the next three;
    where x ``wraps`` the last is followed by the first."""
    pieces = count if wraps else count - 3
    y = (x - low) / (high - low) * pieces
    if wraps:
        y -= math.floor(y / pieces) * pieces
    y = min(max(y, 0.0), float(pieces)) if y - y == 0.0 else 0.0
    i = min(int(y), pieces - 1)
    f = y - i
    g = 1.0 - f
    middle = (f * f * (3.0 * f - 6.0) + 4.0) / 6.0, (g * g * (3.0 * g - 6.0) + 4.0) / 6.0
    return i, (g * g * g / 6.0, middle[0], middle[1], f * f * f / 6.0)


@lean
def jump(x, low, high):
    """A jump from -1 to 1 where x changes its sign, steep beside the range of x."""
    return math.tanh(x / (_WIDTH * max(abs(low), abs(high), 1e-9)))


@kernel
def wrench(p, t, position, nu, rotation, thrust, out):
    axis, first, second = int(p[1]), int(p[2]), int(p[3])
    if p[0] == 0.0 or first == 0:
        return
    count = EACH if second else ALONE
    x = variable(first, axis, t, position, nu, rotation, thrust)
    i, a = splines(x, p[4], p[5], count, first in (HEADING, TIME))
    j, b = 0, (1.0, 0.0, 0.0, 0.0)
    if second:
        x = variable(second, axis, t, position, nu, rotation, thrust)
        j, b = splines(x, p[6], p[7], count, second in (HEADING, TIME))
    force = 0.0
    for m in range(4):
        row = (i + m) % count
        if second:
            for n in range(4):
                force += p[_SHAPE + EACH * row + (j + n) % EACH] * a[m] * b[n]
        else:
            force += p[_SHAPE + row] * a[m]
    if not second and first < ROLL:
        force += p[_SHAPE + ALONE] * jump(x, p[4], p[5])
    force *= p[0]
    if axis < 6:
        out[axis] += force
    else:
        for k in range(3):
            out[k] += force * rotation[axis - 6, k]


def _shape(
    name: str, meaning: str, most: float, null: float = 0.0, least: float = 0.0
) -> EffectParameter:
    return EffectParameter(name, "1", meaning, null, least, most, 1.0, role="shape")


EFFECT = Effect(
    place="wrench",
    summary="A smooth function of the motion, the place or the time, without a name, is missing.",
    manoeuvre="the variables that it depends on, one after the other, through their whole range",
    source="Eilers, Marx (1996), Flexible smoothing with B-splines and penalties, Statistical "
    "Science 11",
    parameters=(
        EffectParameter("scale", "1", "times the function", 0.0, -10.0, 10.0, 1.0),
        _shape("axis", "place in " + " ".join(ON), len(ON) - 1),
        _shape("first", "place of a variable in " + " ".join(OF), len(OF) - 1),
        _shape("second", "the same of another; 0: there is none", len(OF) - 1),
        _shape("first_low", "lowest value of the first", 1e9, least=-1e9),
        _shape("first_high", "highest value of the first", 1e9, 1.0, -1e9),
        _shape("second_low", "lowest value of the second", 1e9, least=-1e9),
        _shape("second_high", "highest value of the second", 1e9, 1.0, -1e9),
        *(_shape(f"w{i}", "weight [N, N m]", 1e6, least=-1e6) for i in range(EACH * EACH)),
    ),
    wrench=wrench,
)
