"""How sure `explain` is: which findings something else may have made, what is left of the motion,
and what the whole says."""

from collections.abc import Mapping, Sequence

import numpy as np

from rov_ident.config import Config
from rov_ident.discrepancy.findings import undecided, unsure
from rov_ident.discrepancy.held_out import MOTIONS, is_surely_practical
from rov_ident.discrepancy.hypothesis import THRUST_SCALE
from rov_ident.discrepancy.prepared import Prepared
from rov_ident.discrepancy.results import Finding, Residual, Verdict
from rov_ident.discrepancy.sensor_choice import LATENCY
from rov_ident.effects import EFFECTS
from rov_ident.estimation.consistency import SUPPOSED
from rov_ident.model.coefficients import AXES, VELOCITIES
from rov_ident.model.equations import Array
from rov_ident.sampling.raw_streams import Streams

_FAR_OFF = 0.5  # of the standard deviation of a motion: three quarters of its power are explained
_SLIGHT = 0.1  # of the same: 99 % of its power are explained
_NEAR_NOISE = 3.0  # times what noise makes of a prediction: coefficients are not exact, either

_DOUBTFUL_FILTER = "what a filter of the velocities does besides delaying them looks like any cause"
_DOUBTFUL_HEADING = "the heading may drift with the gyro whose bias was taken off"
_IN_PROPORTION = (
    "it is in proportion to a thrust that is further off than wrench.scale_std takes for possible"
)
_BETWEEN_READINGS = "it is less than half an interval of the IMU"
_BLURRED = "another finding blurs it"
_SLIGHT_GAIN = "the interval of its gain begins below 2 %"
_BESIDE_REST = "what is left of the motion may have made it"


def doubted(data: Prepared, found: list[Finding], left: Mapping[str, float]) -> list[Finding]:
    """What is found, not sure where what the sensors do beside it, or what is ``left``, may have
    made it, or where its gain may have no practical weight."""
    if data.late:  # a filter does more than delay, and what it does besides looks like any cause
        found = [f if EFFECTS[f.effect].late else unsure(f, _DOUBTFUL_FILTER) for f in found]
    if data.may_drift:
        found = [unsure(f, _DOUBTFUL_HEADING) for f in found]
    found = [
        unsure(f, _BETWEEN_READINGS) if is_between_readings(f, data.streams) else f for f in found
    ]
    if any(is_beyond_the_file(f, data.recorded.config) for f in found):
        found = [f if EFFECTS[f.effect].of_sensors else unsure(f, _IN_PROPORTION) for f in found]
    found = list(map(data.clocks.beside, found))
    found = beside_each_other(found)
    found = [f if is_surely_practical(f.gain) else unsure(f, _SLIGHT_GAIN) for f in found]
    return [unsure(f, _BESIDE_REST) if _acts_on(f, left) else f for f in found]


def verdict(
    found: Sequence[Finding],
    minor: Sequence[Finding],
    residual: Sequence[Residual],
    left: Mapping[str, float],
    retuning_improves: bool,
) -> Verdict:
    any_sure = any(f.separable and not EFFECTS[f.effect].of_sensors for f in found)
    if residual or any(share > _FAR_OFF or not any_sure for share in left.values()):
        return "unexplained"
    if found:
        return "explained"
    if undecided(minor):
        return "unexplained"
    return "retuned" if retuning_improves else "agrees"


def left(streams: Streams, rmse: Mapping[str, float], noise: Array) -> dict[str, float]:
    """The velocities that the extended model predicts far worse than their ``noise`` (6,) allows:
    the error as a share of the motion."""
    motion = np.nanstd(streams.nu, axis=0)
    return {
        c: rmse[c] / m
        for c, m, own in zip(VELOCITIES, motion.tolist(), noise.tolist(), strict=True)
        if m > 0.0 and rmse[c] > max(_SLIGHT * m, _NEAR_NOISE * own)
    }


def _acts_on(found: Finding, left: Mapping[str, float]) -> bool:
    """Whether an effect, not of a sensor, acts on an axis whose velocity is not predicted; or on
    any, where one is far off, as that moves the others."""
    far = any(share > _FAR_OFF for share in left.values())
    axes = {AXES[VELOCITIES.index(c)] for c in left}
    return not EFFECTS[found.effect].of_sensors and (far or not axes.isdisjoint(found.axes))


def is_beyond_the_file(found: Finding, config: Config) -> bool:
    """Whether the thrust is further off than the file supposes, as a fit's consistency has it: all
    forces that are told are in proportion to it."""
    effect, parameter = THRUST_SCALE
    if found.effect != effect or not config.wrench.scale_std:
        return False
    values = [found.parameters, *(found.repetition.records if found.repetition else ())]
    far = [abs(of[parameter].value - 1.0) for of in values if np.isfinite(of[parameter].std)]
    return max(far, default=0.0) > SUPPOSED * config.wrench.scale_std


def is_between_readings(found: Finding, streams: Streams) -> bool:
    """Whether velocities are late by less than half an interval of the IMU, in which nothing is
    known of how they went on."""
    if found.effect != LATENCY or len(streams.imu_t) < 2:
        return False
    interval = float(np.median(np.diff(streams.imu_t)))
    return abs(found.parameters["delay"].value) < 0.5 * interval


def beside_each_other(found: list[Finding]) -> list[Finding]:
    """Those that another one blurs (`Effect.blurs`) are not sure."""
    blurred = {name for f in found for name in EFFECTS[f.effect].blurs}
    return [unsure(f, _BLURRED) if f.effect in blurred else f for f in found]


def told(left: Mapping[str, float]) -> str:
    """What is left, in words; nothing where that is nothing."""
    far = any(share > _FAR_OFF for share in left.values())
    shares = ", ".join(f"{MOTIONS[c]} {100.0 * share:.0f} %" for c, share in left.items())
    begin = "much is left that no model explains" if far else "what is left"
    return f"{begin}, of the motion on held-out data: {shares}" if left else ""
