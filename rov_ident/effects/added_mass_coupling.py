"""Added mass off the diagonal: accelerating along one axis pushes along another.

One name for each entry of the symmetric matrix that port/starboard symmetry allows; its Coriolis
terms come with it.
"""

from rov_ident.effects.base import Effect

EFFECT = Effect(
    place="wrench",
    summary="Accelerating along one axis takes force along another.",
    manoeuvre="quick reversals of thrust on one axis at a time, from rest",
    source="Fossen (2021), Handbook of Marine Craft Hydrodynamics and Motion Control, sec. 6.3",
    coefficients=("Y_rdot", "Z_qdot", "X_qdot", "Y_pdot", "X_wdot", "K_rdot"),
)
