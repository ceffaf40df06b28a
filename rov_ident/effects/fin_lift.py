"""Forces and moments of fins, ``u^2 delta``, and the drag of fins set at an angle, ``u^2 delta^2``.

For inputs whose joint the configuration names (docs/inputs.md); what a fin makes by the flow's own
angle is the lift of the hull (`lift`), with which it shares its terms.
"""

from rov_ident.effects.base import Effect

EFFECT = Effect(
    place="wrench",
    summary="Fins push across the flow by their angles, and drag where they are set.",
    manoeuvre="steps of rudder and stern planes at two speeds, from straight runs",
    source="Prestero (2001), Verification of a six-degree of freedom simulation model for the "
    "REMUS autonomous underwater vehicle, MIT, sec. 4.4",
    coefficients=(
        *("Y_uudr", "N_uudr", "Z_uuds", "M_uuds", "K_uuda", "K_uudr"),
        *("X_uudrdr", "X_uudsds"),
    ),
)
