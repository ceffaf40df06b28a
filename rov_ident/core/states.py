"""The states of a coefficient, with one word for each, and what makes it one of them.

Nodes, fits, checks, tables and pages all take their words from here (docs/glossary.md).
"""

import enum

CONVERGED = 0.1
"""Up to this standard deviation, over the value or over the prior's standard deviation if that is
larger, a coefficient counts as known. A definition: the interval is then ± 20 % of the value."""


CONTRADICTED = 2.0
"""Standard deviations by which data must ask for more than physics allows, for a coefficient to be
said to be at its bound: chance alone does so one time in forty."""


IDENTIFIABLE = 0.75
"""Share of the prior's variance that data must have removed, for them to have decided about a
coefficient: its interval is then half as wide as what the file says."""


class Level(enum.IntEnum):
    """As in diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


class State(enum.Enum):
    """What is known of a coefficient; the value is the word for it."""

    CONVERGED = "converged"
    CONVERGING = "converging"
    HELD = "held"
    AT_BOUND = "at bound"
    DIVERGED = "diverged"
    STALE = "stale"

    @property
    def level(self) -> Level:
        return _LEVELS[self]

    @classmethod
    def at(cls, level: Level) -> "State":
        """The likeliest one of a level, for messages that give nothing else."""
        return next(state for state in cls if state.level == level)


_LEVELS = {
    State.CONVERGED: Level.OK,
    State.CONVERGING: Level.WARN,
    State.HELD: Level.WARN,
    State.AT_BOUND: Level.ERROR,
    State.DIVERGED: Level.ERROR,
    State.STALE: Level.STALE,
}


def is_known(value: float, std: float, prior_std: float) -> bool:
    """Whether a coefficient has converged, by its standard deviation and the prior's."""
    return std <= CONVERGED * max(abs(value), prior_std)


def of_fit(
    value: float, std: float, prior_std: float, identifiable: bool, at_bound: bool = False
) -> State:
    """The state after a fit of all data at once: the prior decides what is not identifiable, and a
    bound what the data contradict, however uncertain that has made it."""
    if at_bound:
        return State.AT_BOUND
    if not identifiable:
        return State.HELD
    return State.CONVERGED if is_known(value, std, prior_std) else State.CONVERGING
