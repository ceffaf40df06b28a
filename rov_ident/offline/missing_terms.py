"""Whether the model lacks a term that an effect has, or a memory of the drag.

Of each such parameter the score at zero, with all others refitted beside it, is tested over
stretches of the records (a score test: `constancy.lacking`). A term that is too weak to leave
anything that lasts for a second still moves what is estimated: 6 % of the drag that follows the
motion a second late are nine standard deviations of the added mass.
"""

import numpy as np

from rov_ident.config import Config
from rov_ident.effects import missing_terms
from rov_ident.estimation.consistency import CAUSE, Test
from rov_ident.model.coefficients import AXES, parse
from rov_ident.model.equations import Array, Model
from rov_ident.offline import constancy
from rov_ident.offline.archive import Archive
from rov_ident.offline.maximum_likelihood import missing_at
from rov_ident.sampling.sample import free_axes


def tests_at(archive: Archive, config: Config, found: Config, values: Array) -> tuple[Test, ...]:
    """The tests at the ``values`` (n,) that an estimator of ``config`` has ``found``, of an archive
    as ``found`` reads it, with the columns of parameters."""
    free = np.any(archive.each(free_axes), axis=0)
    return tests_of(found.dynamics, missing_at(archive.each, config, found.dynamics, values, free))


def tests_of(model: Model, deviates: Array) -> tuple[Test, ...]:
    """The tests of the normal ``deviates`` (q,) of the missing terms of a model, and of a memory of
    the drag of each axis; none where too little tells."""
    words = {
        f"missing term: {name}": f"the model seems to lack {name} ({parse(name).meaning})"
        for name in missing_terms(model)
    }
    words |= {
        f"memory of the drag: {axis}": f"the drag along {axis} seems to depend on the past motion, "
        "too, which added mass takes up"
        for axis in AXES
    }
    limit = constancy.unlikely_of(int(np.count_nonzero(deviates)))
    return tuple(
        Test(name, abs(z), limit, f"{failure}: {CAUSE}")
        for (name, failure), z in zip(words.items(), deviates.tolist(), strict=True)
        if z != 0.0
    )
