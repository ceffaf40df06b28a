"""The guided path: check, fit, explain, judge on data not used, and say what to fly next."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from rov_ident.api.functions import check, explain, plan
from rov_ident.api.functions import fit as fit_bags
from rov_ident.api.reading import File, Files, existing, load, once, same_data, several
from rov_ident.config import Config
from rov_ident.core.errors import UserError
from rov_ident.core.files import write_file
from rov_ident.core.progress import Progress, silent
from rov_ident.core.threads import one_blas_thread
from rov_ident.discrepancy.explain import Explanation
from rov_ident.discrepancy.extension import EXTENDED
from rov_ident.discrepancy.findings import undecided
from rov_ident.estimation.consistency import CAUSE
from rov_ident.experiment.data_quality import Check
from rov_ident.experiment.design import Proposal
from rov_ident.experiment.messages_alone import GOOD
from rov_ident.io.mounting import with_mounting
from rov_ident.model.coefficients import VELOCITIES
from rov_ident.offline import archive
from rov_ident.offline.fit import Fit, rmse_change
from rov_ident.offline.prediction_error import open_loop
from rov_ident.reports.result import Figure, Shown, as_json
from rov_ident.reports.table import Table, Tables
from rov_ident.sampling.records import HORIZON, UNITS, numbers
from rov_ident.sampling.without_velocity import is_without_velocity

_WORSE = 1.05  # of two errors: 5 % is the scatter between dives, as in `estimation.consistency`
_UNEXPLAINED = "Without linear velocity it cannot be told what the model lacks."


@dataclass(frozen=True)
class Identification(Shown):
    """What the guided path found.

    ``fit``: the coefficients, of the extended model where something was missing; its ``fitted`` is
    the configuration to use. ``explanation``: what was missing, and the errors on data that no fit
    has used, those of the same structure fitted without them; None without linear velocity.
    ``checks``: of the dives used; ``left_out``: why others were not. ``judge``: the dive that was
    held back, empty where parts of each were; ``judged``: RMSE on it, of the configuration as given
    and of ``fit.fitted``. ``next``: the manoeuvre to fly next; None where none is safe in the free
    water assumed.
    """

    fit: Fit
    explanation: Explanation | None
    checks: tuple[Check, ...]
    left_out: Mapping[str, str]
    judge: str
    next: Proposal | None = field(repr=False)
    judged: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def given(self) -> Config:
        """The configuration as it was given."""
        return self.explanation.given if self.explanation else self.fit.given

    @property
    def errors(self) -> dict[str, tuple[float, float]]:
        """RMSE of the open-loop prediction by velocity, as configured and as identified; [m/s],
        [rad/s]."""
        both: tuple[Any, Any] | None = None
        if self.judged:
            both = self.judged["rmse_before"], self.judged["rmse"]
        elif self.explanation is None:
            both = self.fit.more["open_loop_before"]["rmse"], numbers(self.fit.rmse)
        if both is not None:
            return {n: (x, both[1][n]) for n, x in both[0].items() if None not in (x, both[1][n])}
        assert self.explanation is not None
        found = self.explanation.findings
        after = found.extended if found.effects else found.retuned
        return {name: (found.baseline[name], after[name]) for name in found.baseline}

    @property
    def sentence(self) -> str:
        """Whether the model is good now, in numbers."""
        before, after = ({n: pair[i] for n, pair in self.errors.items()} for i in (0, 1))
        known, total = sum(self.fit.identifiable), len(self.fit.names)
        where, told = "what was fitted", _UNEXPLAINED
        if self.explanation is not None:
            where, told = "parts of the dives that were held back", self.explanation.sentence
        return (
            f"{self._doubt}{told} On {self.judge or where}, {rmse_change(before, after)}; "
            f"the data determine {known} of {total} parameters."
        )

    @property
    def _doubt(self) -> str:
        """What the model and the data disagree in, in a sentence; empty where they agree."""
        if self.fit.consistency.consistent:
            return ""
        why = self.fit.consistency.sentence
        if self.explanation is not None:
            why = why.replace(CAUSE, "what explain found follows")
        return f"Data and model disagree, and intervals are wide: {why}. "

    @property
    def advice(self) -> tuple[str, ...]:
        """What to do next, the most useful first."""
        held = [n for n, known in zip(self.fit.names, self.fit.identifiable) if not known]
        advice = [*self.fit.to_measure]
        findings = self.explanation.findings if self.explanation else None
        if findings and findings.verdict == "unexplained":
            advice.append("Something is left that no known effect surely explains: see below what.")
        advice += [
            f"Fly next: {effect.manoeuvre} (it tells {effect.effect} from its rivals)."
            for effect in ((*findings.effects, *undecided(findings.minor)) if findings else ())
            if effect.manoeuvre
        ]
        if held:
            advice.append(f"Not determined by these dives: {', '.join(held)}.")
        if self.explanation is None:
            advice.append(
                "Fly next: heave, roll, pitch and yaw at changing levels while surge and sway "
                "rest; a velocity sensor (DVL) alone tells surge and sway."
            )
        if self.next is not None and not self._doubt:
            advice.append(f"Fly next: {self.next.sentence}.")
        elif self.next is not None:  # what it would tell supposes that the model is right
            advice.append(f"Fly next: {self.next.manoeuvre}; {self.next.extent}.")
        ratio = {n: after / before for n, (before, after) in self.errors.items()}
        worse = [n for n, r in ratio.items() if r > _WORSE]
        but = f" (but {' and '.join(worse)} worse)" if worse else ""
        if not float(np.median([*ratio.values()])) < 1.0:  # nor if both diverge
            advice.append("Keep the configuration: extended.yaml predicts no better than it does.")
        elif self._doubt:
            advice.append(
                f"Use extended.yaml to predict, better than the configuration does{but}; its "
                "coefficients are not to be relied on, as data and model disagree."
            )
        else:
            advice.append(
                f"Use extended.yaml in place of the configuration, for nodes and commands{but}."
            )
        return tuple(advice)

    def table(self) -> Tables:
        """Every coefficient against the configured one, and the errors before and after."""
        rows = [
            [name, f"{before:.3g}", f"{after:.3g}", UNITS[VELOCITIES.index(name)]]
            for name, (before, after) in self.errors.items()
        ]
        parts = "held-out parts" if self.explanation else "what was fitted"
        title = f"RMSE of {HORIZON:g} s predictions on {self.judge or parts}"
        errors = Table(title, ["", "as configured", "identified", "unit"], rows, text=(3,))
        known = dict(zip(self.given.model.names, self.given.model.theta.tolist()))
        columns = {
            "configured": [f"{known[n]:.5g}" if n in known else "" for n in self.fit.names],
            "state": [state.value for state in self.fit.states],
        }
        return Tables((self.fit.numbers("coefficients", columns), errors))

    def plot(self) -> Figure:
        """The coefficients relative to the configured ones, and the motion."""
        return self.fit.plot()

    def to_json(self) -> str:
        """Everything, for machines: the JSON of `fit` and of `explain` among it."""
        document: dict[str, Any] = {
            "sentence": self.sentence,
            "advice": self.advice,
            "judge": self.judge or None,
            "rmse": {n: {"before": b, "after": a} for n, (b, a) in self.errors.items()},
            "left_out": dict(self.left_out),
            "fit": json.loads(self.fit.to_json()),
            "explain": json.loads(self.explanation.to_json()) if self.explanation else None,
        }
        return as_json(document)

    def page(self) -> str:
        """One report: the answer, the coefficients, what to do, then the evidence."""
        from rov_ident.reports import html

        of_explain = import_module("rov_ident.discrepancy.report")
        coefficients, errors = self.table().parts
        remarks = [
            [c.bag, r.level, r.subject, r.text]
            for c in self.checks
            for r in c.remarks
            if r.level != GOOD
        ]
        left_out = [f"{name} is left out: {why}" for name, why in self.left_out.items()]
        told = self.explanation.findings.notes if self.explanation else ()
        notes = [note for note in self.notes if note not in told]
        sections = [
            html.beside_table(
                [html.heading("Coefficients, against those configured"), coefficients.html()],
                [html.heading("Is it good now?"), errors.html(), html.heading("What to do next"),
                 html.bullets(self.advice)],
            ),
            *(of_explain.sections(self.explanation, self.fit.fitted) if self.explanation else ()),
            html.heading("The dives"),
            html.bullets([*(c.sentence for c in self.checks), *left_out, *notes]),
            html.table(["dive", "", "subject", ""], remarks, text=(1, 2, 3)) if remarks else "",
        ]  # fmt: skip
        return html.page(
            f"{self.fit.given.name}: identified", self.sentence, sections, html.origin(self.fit)
        )

    def _writers(self) -> dict[str, Callable[[Path], None]]:
        return super()._writers() | {".yaml": self.fit.save_config, "": self.write_folder}

    def write_folder(self, folder: Path) -> None:
        """Write report.html, result.json and extended.yaml into a folder of any name.

        Raises UserError if they cannot be written there.
        """
        write_file(folder / "report.html", self.page())
        write_file(folder / "result.json", self.to_json())
        self.fit.save_config(folder / "extended.yaml")


@one_blas_thread()
def identify(
    dives: Files,
    config: File | Config,
    *,
    validate: File | None = None,
    progress: Progress | None = None,
) -> Identification:
    """Identify a vehicle from its dives, by the whole path: check, explain, fit, judge, plan.

    Dives that are not fit for identification are left out. Of several that are, the shortest judges
    and is fitted by nothing; of one, 30 % of it in whole windows.

    Parameters
    ----------
    dives
        Path of an ``.mcap`` file or a rosbag2 directory, or several.
    config
        Path of a parameter file, or a Config.
    validate
        Path of the bag to judge on, in place of the shortest dive.
    progress
        As in :func:`read`.

    Returns
    -------
    Identification
        ``fit``, ``explanation``, ``checks``, ``next``; ``save(folder)`` writes one report and one
        extended configuration.

    Raises
    ------
    UserError
        If a bag cannot be read, or no dive is fit for identification: why, and what to fly instead.
    """
    say = progress or silent
    paths, repeated = once(several(dives))
    given, placed = with_mounting(load(config), paths)
    judge = None if validate is None else existing(validate)
    if judge and (same := same_data(judge, paths)):
        judge = same  # one of the dives, which is then held back
    checked: list[tuple[Path, Check]] = []
    left_out: dict[str, str] = {}
    for path in paths:
        found = check(path, given, progress=say)
        if found.usable:
            checked.append((path, found))
        else:
            left_out[path.name] = found.why
    if not checked:
        reasons = "; ".join(f"{name}: {why}" for name, why in left_out.items())
        raise UserError(f"no dive is fit for identification: {reasons}{_first_dive(given, say)}")
    if judge is None and len(checked) > 1:
        judge, _ = min(checked, key=lambda pair: pair[1].duration)
    used = [path for path, _ in checked if path != judge]
    if not used:
        others = "".join(f"; {name} is left out: {why}" for name, why in left_out.items())
        raise UserError(
            f"{judge} is the only dive to fit, and cannot judge as well: leave validate "
            f"(--validate) out, or give another dive{others}"
        )
    start, explanation = given, None
    if not any(is_without_velocity(found.record.samples) for _, found in checked):
        # with the mounting that any of the dives tells; else by the name of the file
        explanation = explain(used, given if placed else config, judge, progress=say)
        extended = explanation.findings.verdict in ("explained", "unexplained")
        start = explanation.extended if extended else given
        explanation = _with_start_notes(explanation, extended)
    fitted = checked[0][1].quick if explanation is None and judge is None else None
    if fitted is None:  # else a single dive without velocity: its check has made this very fit
        fitted = fit_bags(used, start, "ml", validate=judge, progress=say)
    judged = dict(fitted.more.get("validation", {}))  # against what the fit began with
    if judge is not None and start is not given:
        with archive.opened([judge], given, say=say) as held_back:
            judged["rmse_before"] = numbers(open_loop(held_back, given).rmse)
    proposal, why = None, list(fitted.notes)
    try:  # what is planned drives surge and sway
        proposal = plan(fitted.fitted, used, progress=say) if explanation else None
    except UserError as error:
        why.append(f"no next manoeuvre: {error}")
    checks = tuple(found for path, found in checked)
    name = judge.name if judge else ""
    notes = (*repeated, *placed, *why, *(explanation.findings.notes if explanation else ()))
    return Identification(fitted, explanation, checks, left_out, name, proposal, judged, notes)


def _with_start_notes(explanation: Explanation, used: bool) -> Explanation:
    """The explanation with notes that call its extended configuration what it is here: the start of
    the fit if it is ``used``, else nothing."""
    findings = explanation.findings
    notes = tuple(
        note.replace(EXTENDED, "the configuration that the fit starts from")
        for note in findings.notes
        if used or EXTENDED not in note
    )
    return replace(explanation, findings=replace(findings, notes=notes))


def _first_dive(config: Config, say: Progress) -> str:
    """The end of a message: the manoeuvre to begin with, where there is a safe one."""
    try:
        return f"; fly instead: {plan(config, progress=say).sentence}"
    except UserError:
        return ""
