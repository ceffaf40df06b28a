"""Identification offline."""

import argparse
import contextlib
from pathlib import Path

from rov_ident import config as configuration
from rov_ident.coefficients import MOTIONS
from rov_ident.commands.common import (
    BAG,
    CONFIG,
    ERR,
    LIVE,
    OUT,
    Commands,
    channels,
    check_outputs,
    count,
    new_table,
    progress,
    read_bag,
    result_table,
)
from rov_ident.errors import UserError

BATCH = ("ls", "iv", "ml")


def add(commands: Commands) -> None:
    fit = commands.add_parser(
        "fit", help="identify offline, by the code of the nodes or from all the data at once"
    )
    fit.add_argument("bags", nargs="+", type=Path, metavar="BAG", help=BAG)
    fit.add_argument("--config", required=True, type=Path, help=CONFIG)
    fit.add_argument(
        "--estimator",
        choices=(*LIVE, *BATCH),
        required=True,
        help="rls, ukf: as the nodes; ls: least squares; iv: instrumental variables; "
        "ml: maximum likelihood",
    )
    fit.add_argument("--json", type=Path, help="write the result here")
    fit.add_argument(
        "--save", type=Path, metavar="FILE", help="write a configuration with the fitted values"
    )
    fit.add_argument("--report", type=Path, metavar="FILE", help="write a page with pictures")
    fit.add_argument(
        "--validate", type=Path, metavar="BAG", help="judge on this bag, which is not fitted"
    )
    batch = fit.add_argument_group("ls, iv and ml")
    batch.add_argument(
        "--channels",
        type=channels,
        action="append",
        metavar="surge,sway,...",
        help="fit these alone, the others as measured (also lateral, longitudinal); "
        "given again: one group after the other",
    )
    batch.add_argument(
        "--no-prior", action="store_true", help="the configured values count for nothing"
    )
    batch.add_argument(
        "--ordinary", action="store_true", help="ls, iv: do not weigh the axes by their residuals"
    )
    batch.add_argument("--output-error", action="store_true", help="ml: take the wrench as exact")
    batch.add_argument("--jobs", type=count, help="processes that read bags (all processors)")
    batch.add_argument("--dask", default="", metavar="ADDRESS", help="a Dask scheduler, or `local`")
    fit.set_defaults(run=_fit)


def _fit(options: argparse.Namespace) -> None:
    from rov_ident import archive
    from rov_ident.batch import Settings, curves, fit_batch, validation
    from rov_ident.fit import fit_online, write_text

    outputs = [options.json, options.save, options.report]
    check_outputs(outputs, [*options.bags, options.config, options.validate])
    live = options.estimator in LIVE
    _check_batch_options(options, live)
    config = configuration.load(options.config, f"{options.estimator}_node" if live else "")
    with progress(options) as tell, contextlib.ExitStack() as stack:
        if live:
            records = [read_bag(path, config, tell) for path in options.bags]
            bags = archive.of_records(records)
            tell("estimating")
            fit = fit_online(records, config, options.estimator)
        else:
            jobs = options.jobs or archive.default_jobs()
            bags = stack.enter_context(
                archive.opened(
                    options.bags, config, jobs, options.dask,
                    lambda name, done, total: tell(f"read {name}", done / total),
                )
            )  # fmt: skip
            stages = tuple(
                tuple(name for name, use in zip(MOTIONS, marks) if use)
                for marks in options.channels or ()
            )
            settings = Settings(
                stages, not options.no_prior, not options.ordinary, not options.output_error
            )
            fit = fit_batch(bags, config, options.estimator, settings, tell)
        fitted = config.with_model(fit.model)
        tell("drawing")
        drawn = curves(bags, config, fitted) if options.report else []
        seen = []
        if options.validate:
            judge = stack.enter_context(archive.opened([options.validate], config))
            fit.more["validation"] = validation(judge, config, fitted)
            seen = curves(judge, config, fitted) if options.report else []
    if options.json:
        write_text(options.json, fit.to_json())
    if options.report:
        from rov_ident.fit_report import page

        write_text(options.report, page(fit, config, drawn, seen))
    if options.save:
        bags_read = ", ".join(path.name for path in options.bags)
        configuration.dump(
            fitted,
            options.save,
            comment=f"Fitted by rov-ident fit --estimator {options.estimator} to {bags_read}.",
        )

    title = f"{options.estimator}: {fit.samples} samples, {fit.duration:.1f} s"
    configured = [f"{config.value(name):.5g}" for name in fit.names]
    known = ["yes" if i else "no: the prior decides" for i in fit.identifiable]
    OUT.print(result_table(title, fit, configured=configured, identifiable=known))
    if judged := fit.more.get("validation"):
        table = new_table(
            f"{options.validate.name}, simulated in open loop: RMSE", "before", "after"
        )
        for name, before in judged["rmse_before"].items():
            after = judged["rmse"][name]
            table.add_row(name, *("" if x is None else f"{x:.4f}" for x in (before, after)))
        OUT.print(table)
    for note in () if live else fit.notes:
        ERR.print(note, markup=False, soft_wrap=True)


def _check_batch_options(options: argparse.Namespace, live: bool) -> None:
    """Refuse options that the estimator would not heed."""
    given = {
        "--channels": options.channels, "--no-prior": options.no_prior,
        "--ordinary": options.ordinary, "--output-error": options.output_error,
        "--jobs": options.jobs, "--dask": options.dask,
    }  # fmt: skip
    heeded = set() if live else {"--channels", "--no-prior", "--jobs", "--dask"}
    heeded |= {"--output-error"} if options.estimator == "ml" else set()
    heeded |= {"--ordinary"} if options.estimator in ("ls", "iv") else set()
    for name, value in given.items():
        if value and name not in heeded:
            raise UserError(f"{name} has no meaning with --estimator {options.estimator}")
