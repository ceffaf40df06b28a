"""From files to results: fitting, explaining, checking, planning."""

import contextlib
import dataclasses
import itertools
import math
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from importlib.metadata import version
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rov_ident.api.reading import File, Files, axes, existing, load, once, same_data, several
from rov_ident.config import Config
from rov_ident.config.prior import prior_of
from rov_ident.core.errors import UserError, refuse_ignored, require
from rov_ident.core.messages import DRIVE, WRENCH, Message
from rov_ident.core.progress import Progress, silent
from rov_ident.core.threads import one_blas_thread
from rov_ident.discrepancy import velocity_sensor
from rov_ident.estimation.consistency import Test, tests_of_sensors, worst_of
from rov_ident.estimation.online import ESTIMATORS
from rov_ident.experiment import data_quality, design, messages_alone
from rov_ident.experiment.data_quality import Check
from rov_ident.experiment.design import Limits, Proposal
from rov_ident.io import topics
from rov_ident.io.bag_reader import Bag
from rov_ident.io.mounting import with_mounting
from rov_ident.model.coefficients import MOTIONS
from rov_ident.offline import archive, batch_fit, delays
from rov_ident.offline.batch_fit import KINDS, Settings
from rov_ident.offline.captive_prior import disagreements, with_prior
from rov_ident.offline.fit import Fit, fit_online
from rov_ident.offline.prediction_error import curves, open_loop
from rov_ident.sampling.raw_streams import Streams, gather
from rov_ident.sampling.records import read_record
from rov_ident.sampling.without_velocity import (
    has_velocity,
    is_without_velocity,
    refusal,
    refuse_without_velocity,
)

if TYPE_CHECKING:
    from rov_ident.discrepancy.explain import Explanation

_COMPARED = 100_000  # messages of a bag by which its sensors are compared: ten minutes


@one_blas_thread()
def fit(
    bags: Files,
    config: File | Config,
    estimator: str = "ml",
    channels: str | Sequence[str] | None = None,
    *,
    validate: File | None = None,
    prior: bool = True,
    weighted: bool = True,
    process: bool = True,
    jobs: int = 1,
    dask: str = "",
    reference: float = 0.0,
    prior_from: File | None = None,
    progress: Progress | None = None,
) -> Fit:
    """Identify the coefficients of a vehicle from its bags.

    Parameters
    ----------
    bags
        Path of an ``.mcap`` file or a rosbag2 directory, or several.
    config
        Path of a parameter file, or a Config: the values to begin with, and what is known.
    estimator
        ``ml`` maximum likelihood; ``ls`` least squares; ``iv`` instrumental variables; ``rls`` and
        ``ukf`` the same code as the live nodes, which sees every sample once.
    channels
        ls, iv, ml: fit these axes alone, the others follow the measurement: ``"surge"``,
        ``"surge,yaw"``, ``"lateral"`` (sway, yaw), ``"longitudinal"`` (heave, pitch). Several: one
        group after the other. None: all together.
    validate
        Path of a bag that the fit does not see, on which it is judged.
    prior
        ls, iv, ml: whether the configured values count as one more measurement.
    weighted
        ls, iv: whether each axis is weighed by its residual.
    process
        ml: whether errors of the wrench are allowed for.
    jobs
        ls, iv, ml: processes that read the bags. A script that asks for more than one needs the
        usual ``if __name__ == "__main__"``.
    dask
        ls, iv, ml: address of a Dask scheduler that reads the bags, or ``"local"``.
    reference
        ukf: seconds of the first bag over which filterpy's own filter runs beside ours on the same
        model and samples; ``more["reference"]`` has both.
    prior_from
        Path of a JSON of ``forces``: its coefficients and their standard deviations are the prior,
        in the place of those of ``config``.
    progress
        As in :func:`read`.

    Returns
    -------
    Fit
        ``names``, ``values`` (n,), ``std`` (n,), ``lower`` and ``upper`` (n,) in SI units, signs as
        SNAME has them; ``fitted``, a Config with these values.

    Raises
    ------
    UserError
        If there is no such estimator or channel, an option has no meaning with the estimator, a bag
        cannot be read, or the data are too few.
    """
    require(str, "a name", estimator=estimator)
    require(str | Iterable | None, "text, such as 'surge,yaw', or several", channels=channels)
    require(Real, "a number", reference=reference)
    live = estimator in ESTIMATORS
    if not live and estimator not in KINDS:
        known = ", ".join((*ESTIMATORS, *KINDS))
        raise UserError(f"there is no estimator '{estimator}': use {known}")
    if prior_from is not None and not prior:
        raise UserError(
            "prior_from (--prior-from), prior=False (--no-prior) exclude each other: leave one out"
        )
    ignored = {
        "channels (--channels)": live and channels is not None,
        "prior (--no-prior)": live and not prior,
        "weighted (--ordinary)": estimator not in ("ls", "iv") and not weighted,
        "process (--output-error)": estimator != "ml" and not process,
        "jobs (--jobs)": live and jobs != 1,
        "dask (--dask)": live and bool(dask),
        "reference (--reference)": estimator != "ukf" and bool(reference),
    }
    refuse_ignored(ignored, f"the estimator {estimator}")
    if not (isinstance(jobs, int) and jobs >= 1):
        raise UserError(f"jobs is {jobs!r}, but must be a whole number from 1 on")
    if not 0.0 <= reference < math.inf:
        raise UserError(f"reference is {reference:g} s, but must not be negative")
    given = load(config, f"{estimator}_node" if live else "")
    table: dict[str, Any] = {}
    if prior_from is not None:
        given, table = with_prior(given, existing(prior_from))
    (paths, repeated), say = once(several(bags)), progress or silent
    given, placed = with_mounting(given, paths)
    groups = [channels] if isinstance(channels, str) else channels or ()
    stages = tuple(tuple(n for n, use in zip(MOTIONS, axes(g)) if use) for g in groups)
    settings = Settings(stages, prior, weighted, process)
    with contextlib.ExitStack() as stack:
        if live:
            records = [read_record(path, given, say) for path in paths]
            for record in records:
                if is_without_velocity(record.samples):
                    raise refusal(record.path.name)
            many = archive.of_records(records, given)
            _refuse_unusable(many, given)
            say("estimating")
            found = fit_online(records, given, estimator)  # type: ignore[arg-type]
            if reference:
                found.more["reference"] = _reference(paths[0], given, reference, say)
        else:
            many = stack.enter_context(archive.opened(paths, given, jobs, dask, say))
            _refuse_unusable(many, given)
            found = batch_fit.fit_batch(many, given, estimator, settings, say)
        say("comparing the sensors")
        late = delays.is_late(found.given.effects)
        found = found.with_tests(_message_tests([bag.path for bag in many.bags], found, late))
        if table:
            found = _with_table_notes(found, given, table)
        estimates = dict(zip(found.names, zip(found.values, found.std, strict=True), strict=True))
        notes = (*repeated, *placed, *_reversed_joints(estimates, given), *found.notes)
        found = dataclasses.replace(found, notes=notes)
        return found if validate is None else _judged(found, given, validate, paths, say)


def _reversed_joints(estimates: Mapping[str, tuple[float, float]], given: Config) -> Iterator[str]:
    """Joints that count the other way round: all that follows from them has changed sign, by the
    ``estimates`` with their standard deviations, and some surely."""
    for joint in given.inputs.joints:
        own = [c.name for c in given.model.coefficients if joint in c.inputs]
        odd = [n for n in own if n.count(f"d{joint[-1]}") < 2 and n in estimates]  # no squares
        changed = [n for n in odd if estimates[n][0] * given.value(n) < 0.0]
        surely = [n for n in changed if abs(estimates[n][0]) > 3.0 * estimates[n][1]]
        if surely and changed == odd:
            yield (
                f"{joint} works the other way round than the configuration has it (the sign of "
                f"{', '.join(surely)} has changed): check the sign of inputs.{joint}.scale"
            )


def _judged(found: Fit, given: Config, validate: File, fitted: list[Path], say: Progress) -> Fit:
    """The fit, with its open-loop errors on the bag ``validate``."""
    bag, notes = existing(validate), found.notes
    if same := same_data(bag, fitted):
        notes = (f"{bag} is what was fitted ({same}): it tells nothing of other dives", *notes)
    with archive.opened([bag], given, say=say) as judge:
        say("simulating in open loop")
        reread = judge.as_read_by(found.fitted, given)
        runs = judge.bags, open_loop(judge, given), open_loop(reread, found.fitted)
        more = found.more | {"validation": batch_fit.validation(*runs)}
        return dataclasses.replace(found, notes=notes, more=more, judged=curves(*runs))


def _message_tests(paths: Sequence[Path], fit: Fit, late: bool) -> list[Test]:
    """Tests of sensors and clocks on the first messages of each bag: the worst result of each;
    ``late``: whether the model that was fitted has thrust or velocities that are."""
    from rov_ident.discrepancy import rates_and_attitude  # here: it loads what only explain needs

    worst: dict[str, Test] = {}
    config = fit.given
    for path in paths:
        bag = Bag(path)
        chosen = topics.select(bag, config)
        if has_velocity(bag, chosen, config):
            heard = _once_commanded(topics.messages(bag, chosen, config), chosen)
            streams = gather(itertools.islice(heard, _COMPARED), config)
            for test in (
                *velocity_sensor.tests_of(streams, config),
                *rates_and_attitude.tests_of(streams, config, fit),
                *delays.tests_of(streams, config, late),
            ):
                before = worst.get(test.name, test)
                worst[test.name] = max(before, test, key=lambda t: t.value / t.limit)
    return list(worst.values())


def _once_commanded(
    messages: Iterable[tuple[str, Message]], chosen: Collection[str]
) -> Iterator[tuple[str, Message]]:
    """The messages of the ``chosen`` roles from where wrench and joints have begun, which a dive's
    recording often does before."""
    waited = {WRENCH, DRIVE} & set(chosen)
    for role, message in messages:
        waited.discard(role)
        if not waited:
            yield role, message


def _with_table_notes(found: Fit, given: Config, table: Mapping[str, Any]) -> Fit:
    """The fit, saying where its prior is from, and where table and dives exclude each other."""
    prior = prior_of(given)
    of_table = {
        name: (mean, std)
        for name, mean, std in zip(prior.names, prior.mean.tolist(), prior.std.tolist())
        if name in table["coefficients"]
    }
    notes = disagreements(of_table, found.names, found.values, found.std)
    return dataclasses.replace(
        found, notes=(*found.notes, *notes), more={**found.more, "prior_from": dict(table)}
    )


def _refuse_unusable(many: archive.Archive, config: Config) -> None:
    """UserError where the data are too few, or so wrong that no fit makes sense of them.

    k samples show k - 1 changes of velocity on each axis: more than its unknowns are needed.
    """
    chosen = (c.row for c in config.model.coefficients if c.name in config.estimate)
    unknowns = max(Counter(chosen).values(), default=0)
    if many.samples - 1 <= unknowns:
        raise UserError(
            f"{many.samples} samples are too few for {unknowns} coefficients of one axis: record "
            "for longer (rov-ident plan says what)"
        )
    for bag, remarks in zip(many.bags, many.each(messages_alone.of_dynamics, config), strict=True):
        messages_alone.refuse_reversed(bag.path.name, remarks)


def _reference(path: Path, config: Config, duration: float, say: Progress) -> dict[str, Any]:
    """Both unscented filters over the beginning of a bag; effects are held."""
    from rov_ident.estimation.reference_ukf import compare

    held = config.with_effects_held
    samples = read_record(path, held, say).samples
    samples = samples[samples["t"] < samples["t"][0] + duration]
    return compare(held, samples, say)


@one_blas_thread()
def explain(
    bags: Files,
    config: File | Config,
    validate: File | None = None,
    *,
    progress: Progress | None = None,
) -> "Explanation":
    """Find what the configured simulation lacks, and what each lacking effect would gain.

    Parameters
    ----------
    bags
        Path of an ``.mcap`` file or a rosbag2 directory, or several.
    config
        Path of a parameter file, or a Config: the simulation that is judged.
    validate
        Path of a bag to judge on; None: on 30 % of each bag that no fit sees.
    progress
        As in :func:`read`.

    Returns
    -------
    Explanation
        ``findings`` with effects, gains [%] and verdict; ``extended``, a Config with them.

    Raises
    ------
    UserError
        If a bag cannot be read or is too short, or the model cannot be simulated at all.
    """
    from rov_ident.discrepancy.explain import contradicted  # here: no other needs it
    from rov_ident.discrepancy.explain import explain as explain_streams

    given, say = load(config), progress or silent
    paths, repeated = once(several(bags))
    other = None if validate is None else existing(validate)
    if other and (same := same_data(other, paths)):
        raise UserError(f"{other} is what is searched ({same}): validate on a bag of another dive")
    given, placed = with_mounting(given, paths)
    read_bags = [_streams(path, given, say) for path in paths]
    judge = None if other is None else _streams(other, given, say)
    for path, (streams, _) in zip(paths, read_bags, strict=True):
        seen = delays.samples_of(streams)
        messages_alone.refuse_reversed(path.name, messages_alone.of_dynamics(seen, given))
    found = explain_streams(
        [streams for streams, _ in read_bags], given, judge[0] if judge else None, say
    )
    say("comparing odometry and IMU", 1.0)
    ratios = worst_of(read_record(path, found.extended).contradictions for path in paths)
    failed = (test for test in tests_of_sensors(ratios) if not test.passed)
    found = contradicted(found, [test.failure for test in failed])
    name = given.name if isinstance(config, Config) else Path(config).name
    made: dict[str, Any] = {"rov_ident": version("rov_ident"), "config": name}
    made |= {"bags": [source for _, source in read_bags]}
    made |= {"validate": judge[1]} if judge else {}
    findings = found.findings
    stds = {name: change.std for name, change in findings.changed.items()}
    estimates = {
        name: (found.extended.value(name), stds.get(name, math.inf)) for name in given.model.names
    }
    notes = (*repeated, *placed, *_reversed_joints(estimates, given), *findings.notes)
    findings = dataclasses.replace(findings, provenance=made, notes=notes)
    return dataclasses.replace(found, findings=findings)


def _streams(path: Path, config: Config, say: Progress) -> tuple[Streams, dict[str, str]]:
    """A bag's messages in arrays, and its name and sha256."""
    bag = Bag(path)
    chosen = topics.select(bag, config)
    refuse_without_velocity(bag, chosen, config)

    streams = gather(topics.messages(bag, chosen, config, say=say), config)
    notes = [*topics.doubts(bag, chosen, config), *streams.notes, *filter(None, [bag.damage])]
    streams = dataclasses.replace(streams, notes=tuple(notes))
    return streams, {"name": bag.path.name, "sha256": bag.sha256}


@one_blas_thread()
def check(bag: File, config: File | Config, *, progress: Progress | None = None) -> Check:
    """Say whether a bag is fit for identification, and what it would tell of each coefficient.

    Parameters
    ----------
    bag, config, progress
        As in :func:`read`.

    Returns
    -------
    Check
        ``fit``, whether a fit can be trusted; ``remarks``; ``quick``, a quick fit; ``prospects``,
        what it makes of each coefficient.

    Raises
    ------
    UserError
        If the bag cannot be read, or has too few messages.
    """
    return data_quality.check(existing(bag), load(config), progress or silent)


@one_blas_thread()
def plan(
    config: File | Config,
    bag: Files | None = None,
    *,
    duration: float = 60.0,
    tank: Sequence[float] = (6.0, 6.0, 2.0),
    thrust: float = 1.0,
    progress: Progress | None = None,
) -> Proposal:
    """Propose the manoeuvre to run next: safe, and best for the coefficient that is known worst.

    Parameters
    ----------
    bag
        Path, or several, of what has been recorded already.
    duration
        Length of the manoeuvre, s.
    tank
        Length (north), width (east) and depth (down) of free water about the start, m.
    thrust
        The largest wrench on each axis, relative to what holds working speed.
    config, progress
        As in :func:`read`.

    Returns
    -------
    Proposal
        ``best``, the manoeuvre; ``before`` and ``after``, what is known of each coefficient.

    Raises
    ------
    UserError
        If a bag cannot be read, or no manoeuvre is safe within these limits.
    """
    require(Real, "a number", duration=duration, thrust=thrust)
    given, say = load(config), progress or silent
    sides = tuple(tank) if isinstance(tank, Iterable) else ()
    numeric = all(isinstance(side, int | float | np.number) and side > 0 for side in sides)
    if len(sides) != 3 or not numeric:
        raise UserError(f"tank is {tank!r}, but must be three lengths [m], such as (6, 6, 2)")
    limits, paths = Limits(sides, thrust), [] if bag is None else several(bag)
    given, placed = with_mounting(given, paths)
    known = archive.opened(paths, given, say=say) if paths else contextlib.nullcontext()
    with known as bags:
        found = design.propose(given, bags, duration, limits, say)
    return dataclasses.replace(found, notes=(*placed, *found.notes))
