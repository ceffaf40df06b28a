"""Forces across the flow: products of the forward velocity with another one.

Hull, fins and frame at an angle to the flow are wings. The Munk moments and the other products that
come from the added mass are in the equations of motion already; these are beyond them.
"""

from rov_ident.effects.base import Effect

EFFECT = Effect(
    place="wrench",
    summary="Hull and fins lift when they meet the flow at an angle while moving ahead.",
    manoeuvre="steady runs ahead while swaying, heaving or turning, at two speeds ahead",
    source="Prestero (2001), Verification of a six-degree of freedom simulation model for the "
    "REMUS autonomous underwater vehicle, MIT, ch. 4",
    coefficients=(*("Y_uv", "Z_uw", "M_uw", "N_uv"), *("Y_ur", "Z_uq", "M_uq", "N_ur", "K_uv")),
)
