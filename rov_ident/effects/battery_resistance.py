"""The battery's voltage falls under load: one gain on all thrust, ``1 - loss * load``.

The battery's resistance and that of its cables take a share of the voltage that grows with the
current. By the momentum theory of a propeller power, and so current, grows with thrust^1.5::

    load = sum over X Y Z of (|c| / 50 N)^1.5 + sum over K M N of (|c| / 10 N m)^1.5

How the thrusters share the wrench is not known here: load counts axes as if each had its own.
"""

from rov_ident.core.jit import kernel
from rov_ident.effects.base import FORCE, MOMENT, Effect, EffectParameter


@kernel
def act(p, state, t, dt, wrench):
    load = 0.0
    for i in range(3):
        load += (abs(wrench[i]) / FORCE) ** 1.5 + (abs(wrench[3 + i]) / MOMENT) ** 1.5
    gain = max(1.0 - p[0] * load, 0.0)
    for i in range(6):
        wrench[i] *= gain


EFFECT = Effect(
    place="input",
    summary="Thrust falls with the load on the battery, on all axes.",
    manoeuvre="equal steps of thrust along one axis, alone and while another axis is driven hard",
    source="McCormick (1995), Aerodynamics, Aeronautics, and Flight Mechanics, sec. 6.1: power of "
    "a propeller at rest; Blue Robotics, T200 thruster, performance charts: thrust over voltage",
    parameters=(
        EffectParameter("loss", "1", "share lost at 50 N along one axis", 0.0, 0.0, 1.0, 0.1),
    ),
    act=act,
    order=45,
)
