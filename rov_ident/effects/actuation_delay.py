"""Commands act later: ``acting(t) = command(t - delay)``.

Exact for commands that are held between calls: what is returned is the mean of the past commands
over the step, each for as long as it acted. The first command is taken to have acted for long.
"""

from rov_ident.core.jit import kernel
from rov_ident.effects.base import MEMORY, Effect, EffectParameter

_ROOM = (MEMORY - 1) // 7
# Past commands with their instants: half a second of changes at 290 Hz. Beyond that the oldest is
# forgotten, as if the next one had acted in its place.
_LONGEST = 0.5  # s; what is remembered does not depend on the delay (rov_ident.effects.base)


@kernel
def act(p, state, t, dt, wrench):
    delay = p[0]  # none, too, remembers: an estimate may come back from there
    queue = state[1 : 1 + 7 * _ROOM].reshape(_ROOM, 7)  # instant, command; oldest first
    count = int(state[0])
    new = count == 0
    for i in range(6):
        new = new or wrench[i] != queue[count - 1, 1 + i]
    if new:
        if count == _ROOM:
            _forget(queue, 1, count)
            count -= 1
        queue[count, 0] = t
        queue[count, 1:] = wrench
        count += 1
    past = _ended_before(queue, count, t - _LONGEST)
    _forget(queue, past, count)
    count -= past
    state[0] = count
    begin, end = t - delay, t + dt - delay
    first = _ended_before(queue, count, begin)
    wrench[:] = queue[first, 1:]
    if count == first + 1 or not queue[first + 1, 0] < end:
        return
    wrench *= (queue[first + 1, 0] - begin) / dt
    for k in range(first + 1, count):
        until = min(queue[k + 1, 0], end) if k + 1 < count else end
        if until > queue[k, 0]:
            for i in range(6):
                wrench[i] += (until - queue[k, 0]) / dt * queue[k, 1 + i]


@kernel
def _ended_before(queue, count, t):
    """How many commands had ended before t."""
    ended = 0
    while ended + 1 < count and queue[ended + 1, 0] <= t:
        ended += 1
    return ended


@kernel
def _forget(queue, entries, count):
    if entries > 0:
        for k in range(entries, count):
            queue[k - entries] = queue[k]


EFFECT = Effect(
    place="input",
    summary="The thrusters follow their command a little later.",
    traits=("late",),
    manoeuvre="sharp steps of thrust from rest, one axis at a time, with fast odometry",
    source="Fossen (2021), Handbook of Marine Craft Hydrodynamics and Motion Control, sec. 9.5",
    parameters=(EffectParameter("delay", "s", "from command to thrust", 0.0, 0.0, _LONGEST, 0.05),),
    act=act,
    order=10,
)
