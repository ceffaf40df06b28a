"""Identification offline."""

import argparse
import os
from pathlib import Path

from rov_ident.cli import common

BATCH = ("ls", "iv", "ml")


def add(commands: common.Commands) -> None:
    text = "identify offline, by the code of the nodes or from all the data at once"
    fit = common.command(commands, "fit", text, _fit, "bags --config --json --save --report")
    fit.add_argument(
        "--estimator", choices=(*common.LIVE, *BATCH), default="ml",
        help="ml (default): maximum likelihood; ls: least squares; iv: instrumental variables; "
        "rls, ukf: as the nodes",
    )  # fmt: skip
    fit.add_argument(
        "--validate", type=Path, metavar="BAG", help="judge on this bag, which is not fitted"
    )
    fit.add_argument(
        "--reference", type=common.positive, nargs="?", const=60.0, metavar="S",
        help="ukf: run filterpy's filter, too, over the first S seconds (60), and show both",
    )  # fmt: skip
    fit.add_argument(
        "--prior-from", type=Path, metavar="FORCES.json",
        help="what a force table tells (rov-ident forces --json) is the prior of its coefficients",
    )  # fmt: skip
    batch = fit.add_argument_group("ls, iv and ml")
    batch.add_argument(
        "--channels", action="append", metavar="surge,sway,...",
        help="fit these alone, the others as measured (also lateral, longitudinal); "
        "given again: one group after the other",
    )  # fmt: skip
    batch.add_argument(
        "--no-prior", action="store_true", help="the configured values count for nothing"
    )
    batch.add_argument(
        "--ordinary", action="store_true", help="ls, iv: do not weigh the axes by their residuals"
    )
    batch.add_argument("--output-error", action="store_true", help="ml: take the wrench as exact")
    batch.add_argument(
        "--jobs", type=common.count, help="processes that read bags (all processors)"
    )
    batch.add_argument("--dask", default="", metavar="ADDRESS", help="a Dask scheduler, or `local`")


def _fit(options: argparse.Namespace) -> None:
    from rov_ident.api.functions import fit

    live = options.estimator in common.LIVE
    with common.progress(options) as tell:
        found = fit(
            options.bags,
            options.config,
            options.estimator,
            options.channels,
            validate=options.validate,
            prior=not options.no_prior,
            weighted=not options.ordinary,
            process=not options.output_error,
            jobs=options.jobs or (1 if live else len(os.sched_getaffinity(0))),
            dask=options.dask,
            reference=options.reference or 0.0,
            prior_from=options.prior_from,
            progress=tell,
        )
        common.write_result(found, options, tell)
    if options.save:
        found.save_config(options.save)
    common.show(found, [*found.notes, *found.to_measure, *filter(None, [found.doubt])])
