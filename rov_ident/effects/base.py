"""What every effect states about itself, and the three places where one can enter."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EffectParameter:
    """One parameter: the effect vanishes where all of them are at ``null``."""

    name: str
    unit: str
    meaning: str
    null: float
    lower: float
    upper: float


@dataclass(frozen=True)
class Effect:
    """An effect of the library.

    ``place`` is where it enters: the *input* (between the demanded and the acting wrench), the
    *motion* (between the motion through the water and what is measured) or the *wrench*.

    ``start(wrench) -> state`` and ``step(state, wrench, dt, **parameters) -> state, acting`` define
    an input effect: ``wrench`` (6,) is demanded throughout the ``dt`` seconds of the step, and
    ``acting`` (6,) is the mean of what acts during it.
    """

    name: str
    place: Literal["input", "motion", "wrench"]
    summary: str
    source: str
    parameters: tuple[EffectParameter, ...]
    start: Callable[[Array], Array]
    step: Callable[..., tuple[Array, Array]]
