"""Drag along one axis that grows with the speed along another.

A bluff body drags against its motion, with the square of its speed: ``-k |V| V`` (Morison's drag in
vector form). Along one axis alone that is ``A_bb |b| b``. While the vehicle still coasts along that
axis, and already moves faster along another, it is ``-k |c| b``.
"""

from rov_ident.effects.base import Effect

EFFECT = Effect(
    place="wrench",
    summary="Drag along an axis grows with the speed along another.",
    beyond="quadratic_damping",
    manoeuvre="runs along two axes at once, and from one axis into another without a stop between",
    source="Faltinsen (1990), Sea Loads on Ships and Offshore Structures, ch. 7",
    coefficients=("X_u_abs_v", "X_u_abs_w", "Y_v_abs_u", "Y_v_abs_w", "Z_w_abs_u", "Z_w_abs_v"),
)
