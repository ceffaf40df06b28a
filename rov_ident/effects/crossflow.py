"""Drag across the flow of a hull that turns while it drifts: each section meets the water anew.

The integral of ``|v + x r| (v + x r)`` along the hull, as products of both velocities (Fossen 2021,
eq. 6.91); in heave and pitch alike.
"""

from rov_ident.effects.base import Effect

EFFECT = Effect(
    place="wrench",
    summary="Drag across the flow depends on drifting and turning at once.",
    manoeuvre="turning while swaying, and pitching while heaving, both ways",
    source="Fossen (2021), Handbook of Marine Craft Hydrodynamics and Motion Control, sec. 6.4",
    coefficients=(
        *("Y_v_abs_r", "Y_r_abs_v", "Y_rr", "N_v_abs_r", "N_r_abs_v", "N_vv"),
        *("Z_w_abs_q", "Z_q_abs_w", "Z_qq", "M_w_abs_q", "M_q_abs_w", "M_ww"),
    ),
)
