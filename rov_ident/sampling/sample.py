"""The record of one sample, and sequences of them."""

from collections.abc import Iterator, Sequence
from functools import cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rov_ident.core.jit import floats, record
from rov_ident.core.messages import Array
from rov_ident.model.coefficients import INPUTS

NO_SIDES = np.zeros((1, 13, 0))

NO_MOMENT = (
    "the wrench never holds a moment: how the vehicle turns is taken from the measurement, not "
    "simulated, and nothing is said about it"
)

SAMPLE = record(
    [
        ("t", "f8"),  # s since the first message
        ("dt", "f8"),  # s since the previous sample
        ("restart", "?"),  # the interval before this sample is not known: filters restart
        ("anew", "?"),  # the samples before were wrong, too: they are discarded
        ("measured", "?"),  # an odometry message belongs to this sample
        ("moving", "u1", (6,)),  # 1: this component of nu is well above its noise
        ("nu", "f8", (6,)),  # m/s, rad/s: through the water
        ("water", "f8", (3,)),  # m/s: velocity of the water in body axes; nu + water: over ground
        ("orientation", "f8", (4,)),  # w x y z, body -> world
        ("position", "f8", (3,)),  # m: in the world, as last measured
        ("down", "f8", (3,)),  # unit, body axes
        ("down_slope", "f8", (3,)),  # per s: of the line that ends at down and has its mean over dt
        ("tilt", "f8"),  # rad2 s: variance density of an error of down that lasts a second
        # rad2, s: after smoothing, variance of an error of down, and for how long it lasts
        *floats((), "tilt_variance tilt_lasts"),
        ("wrench", "f8", (6,)),  # N, N m: mean over dt, of thrusters and surroundings
        ("wrench_slope", "f8", (6,)),  # per s: of the line with the same mean and first moment
        # N2, (N m)2: what of it may be an outlier, mean over dt; infinite, of all moments: none was
        # ever recorded
        ("wrench_doubt", "f8", (6,)),
        # fins and shafts: mean over dt, and at t; zeros where none is configured
        ("inputs", "f8", (2, len(INPUTS))),
        # N2 s, (N m)2 s: variance density of what looks like noise of the wrench's reading; 0 where
        # the wrench is far above it
        ("reading_noise", "f8", (6,)),
        ("hold", "f8"),  # s: how long a command acts, recently; 0: not known yet
        ("surroundings", "f8", (6,)),  # part of the wrench: of wrench effects at this motion
        ("surroundings_slope", "f8", (6,)),
        ("odometry", "f8", (6,)),  # as nu; NaN: not measured
        ("odometry_variance", "f8", (6,)),
        ("gyro", "f8", (3,)),  # rad/s, bias removed; NaN: not measured
        ("gyro_variance", "f8"),
        ("gyro_bias", "f8", (3,)),  # rad/s: what was taken off the gyro here
        ("attitude", "f8", (4,)),  # as the odometry has it; NaN: not measured
        # m, s, m2: of the body origin so long before t, where no linear velocity is measured
        *floats((), "depth depth_age depth_variance"),  # a variance of zero: not measured
    ]
)


def joined(parts: Sequence[NDArray[np.void]]) -> NDArray[np.void]:
    """One array of the samples in all parts, as np.concatenate, which is slow with records."""
    return np.frombuffer(bytearray().join(part.tobytes() for part in parts), dtype=parts[0].dtype)


def after_reset(samples: NDArray[np.void]) -> NDArray[np.void]:
    """Samples (k,) of SAMPLE from the last one on that makes all before it invalid (``anew``)."""
    anew = np.flatnonzero(samples["anew"])
    return samples[anew[-1] :] if len(anew) else samples


def free_axes(samples: NDArray[np.void]) -> NDArray[np.bool_]:
    """Axes (6,) along which samples (k,) tell what moves the vehicle (:data:`NO_MOMENT`)."""
    known: NDArray[np.bool_] = np.isfinite(samples["wrench_doubt"]).any(axis=0)
    return known


def thrust_axes(samples: NDArray[np.void]) -> NDArray[np.bool_]:
    """Axes (6,) along which thrusters ever push in samples (k,)."""
    pushed: NDArray[np.bool_] = (samples["wrench"] != samples["surroundings"]).any(axis=0)
    return pushed


def stretches(samples: NDArray[np.void]) -> Iterator[tuple[int, int]]:
    """Where each stretch of samples (k,) without a gap begins and ends."""
    edges = np.flatnonzero(samples["restart"]).tolist()
    return pairwise(sorted({0, *edges, len(samples)}))


@cache
def sample_type(size: int) -> np.dtype[np.void]:
    """The dtype of samples that know how they change with ``size`` parameters of effects.

    A SAMPLE, then ``by_wrench`` and ``by_velocity`` (6, size) and ``about`` (size,): the values of
    the parameters by which the sample was made. See :mod:`rov_ident.sampling.effect_jacobians`.
    """
    if size == 0:
        return SAMPLE
    first, step = SAMPLE.itemsize, 48 * size
    names = list(SAMPLE.names or ())
    kinds = [SAMPLE.fields[name] for name in names] if SAMPLE.fields else []
    return record(
        {
            "names": [*names, "by_wrench", "by_velocity", "about"],
            "formats": [*(k[0] for k in kinds), *([("f8", (6, size))] * 2), ("f8", (size,))],
            "offsets": [*(k[1] for k in kinds), first, first + step, first + 2 * step],
        }
    )


def one_sample(size: int) -> tuple[NDArray[np.void], NDArray[np.void], Array]:
    """A sample (1,) of :func:`sample_type`, zeros; and views: its SAMPLE, its sides (13, size)."""
    # np.zeros fills records field by field
    buffer = bytearray(SAMPLE.itemsize + 104 * size)
    whole, sample = np.frombuffer(buffer, sample_type(size)), np.frombuffer(buffer, SAMPLE, 1)
    return whole, sample, np.ndarray((13, size), np.float64, buffer, SAMPLE.itemsize)


def parts(samples: NDArray[np.void]) -> tuple[NDArray[np.void], Array]:
    """Samples (k,) of SAMPLE, and how they change with parameters of effects: (k, 13, size).

    Six rows of the wrench, six of the measured velocity, and the values that they are about.
    """
    if samples.dtype == SAMPLE:
        return samples, NO_SIDES
    first, count, whole = SAMPLE.itemsize, len(samples), np.ascontiguousarray(samples)
    size = (samples.dtype.itemsize - first) // 104
    # np.ndarray and not view, which looks through all fields of a record
    rows = np.ndarray((count, samples.dtype.itemsize), np.uint8, whole)
    plain, sides = np.ascontiguousarray(rows[:, :first]), np.ascontiguousarray(rows[:, first:])
    return np.ndarray((count,), SAMPLE, plain), np.ndarray((count, 13, size), np.float64, sides)
