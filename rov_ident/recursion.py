"""What the two recursive estimators share beside their process noise and the published residual."""

import numpy as np

from rov_ident.jit import inlined, inner, record
from rov_ident.process_noise import LARGEST

MAX_STEP = 0.05  # s; of one step of the prediction
LIGHTEST = 0.2  # of the rigid body's own inertia: no model that is tried is lighter
FASTEST = 50.0  # m/s, rad/s; no sane model gets there
LAG = 4.0  # s; of the window over the score's correlation
SURPRISE_TIME = 2.0  # s; over which normalised innovations squared are averaged
RELEARNING_TIME = 20.0  # s; after a change: coefficients become as uncertain as at first

INFO = record(
    [
        ("t", "f8"),
        ("reason", "i8"),  # index into the estimator's REASONS
        ("residual", "f8", (6,)),  # N, N m: filtered wrench, measured minus model
        ("ratio", "f8", (6,)),  # squared innovation over its predicted variance
        ("forgetting", "f8"),
        ("condition", "f8"),  # as of condition(), before the sample; NaN: not looked at
    ],
)
"""What happened to a sample."""


@inner
def begin(info, sample):
    """Nothing has happened yet to the sample: whether nothing in it would spoil a state.

    NaN where not measured is no harm.
    """
    info.t = sample.t
    info.forgetting = 1.0
    info.condition = np.nan
    for i in range(6):
        info.residual[i] = np.nan
        info.ratio[i] = np.nan
    total = sample.t + sample.dt
    for i in range(6):
        total += sample.nu[i] + sample.wrench[i] + sample.wrench_slope[i]
    for i in range(3):
        total += sample.down[i] + sample.down_slope[i]
    return np.isfinite(total)


@inlined
def steps_of(dt):
    """Into how many steps an interval is divided."""
    return max(1, int(np.ceil(dt / MAX_STEP - 1e-9)))


@inlined
def add_surprise(surprise, i, ratio, since):
    """Average an innovation's square over its variance, so many seconds after the last one.

    A single kick counts for no more than LARGEST: what has changed shows again and again.
    """
    surprise[i] += min(since / SURPRISE_TIME, 1.0) * (min(ratio, LARGEST**2) - surprise[i])


@inlined
def add_score(g, lagged, score, since):
    """Add g (n,) to the covariance (n, n) of the summed score, its correlation in time included.

    With an exponential lag window (Newey and West 1987), of which ``lagged`` (n,) holds the past;
    the last g was ``since`` seconds ago.
    """
    n, decay = len(lagged), np.exp(-since / LAG)
    for a in range(n):
        lagged[a] *= decay
    for a in range(n):
        for b in range(n):
            score[a, b] += g[a] * (g[b] + lagged[b]) + lagged[a] * g[b]
    for a in range(n):
        lagged[a] += g[a]
