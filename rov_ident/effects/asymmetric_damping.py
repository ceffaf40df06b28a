"""Drag that differs between the two directions of an axis, such as diving and rising.

``Z_ww |w| w + Z_ww_neg |w| min(w, 0)``: an open frame under a closed hull, a skirt of floats.
"""

from rov_ident.effects.base import Effect

EFFECT = Effect(
    place="wrench",
    summary="Drag backwards, to port or upwards is not that of the other direction.",
    manoeuvre="the same thrust both ways along the axis, then coasting to rest",
    source="Caccia, Indiveri, Veruggio (2000), Modeling and identification of open-frame variable "
    "configuration unmanned underwater vehicles, IEEE J. Oceanic Eng. 25(2)",
    coefficients=(
        *("X_uu_neg", "Y_vv_neg", "Z_ww_neg", "K_pp_neg", "M_qq_neg", "N_rr_neg"),
        *("X_u_neg", "Y_v_neg", "Z_w_neg", "K_p_neg", "M_q_neg", "N_r_neg"),
    ),
)
