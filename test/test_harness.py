"""What the studies share: bars, rows, and runs that are interrupted and resumed."""

from dataclasses import dataclass
from importlib import import_module
from pkgutil import iter_modules

import pytest

from bench import studies
from bench.harness import Bars, Row, digest, lines_of, show
from bench.studies import validate
from rov_ident.offline.batch_fit import fit_batch
from rov_ident.simulation.virtual_sensors import Suite, dive


@dataclass(frozen=True)
class Trial:
    seed: int
    noise: float = 1.0


def measure(trial):
    if trial.seed < 0:
        raise KeyboardInterrupt
    return {"square": trial.noise * trial.seed**2}


def lines(path, *seeds, source="a", **options):
    return lines_of([Trial(s) for s in seeds], measure, lambda _: path, source, **options)


def test_a_run_that_was_interrupted_goes_on_where_it_was(tmp_path):
    path = tmp_path / "folder" / "lines.jsonl"
    with pytest.raises(KeyboardInterrupt):
        lines(path, -1)
    first = lines(path, 1)
    with path.open("a") as file:
        file.write('{"trial": {"seed": 2')  # the process was killed here
    written = path.read_text()
    path.write_text(written + "\n")
    assert [line["square"] for line in lines(path, 3, 2, 1, jobs=2)] == [9.0, 4.0, 1.0]
    texts = path.read_text().splitlines()
    assert sum('"seed": 1,' in text for text in texts) == 1
    assert lines(path, 1) == first


def test_lines_of_other_sources_are_measured_anew_unless_kept(tmp_path):
    path = tmp_path / "lines.jsonl"
    old = lines(path, 1, 2)
    assert lines(path, 2, source="b", keep=True) == old[1:]
    assert [line["source"] for line in lines(path, 1, 2, source="b")] == ["b", "b"]


def test_no_trial_is_begun_when_the_time_is_over(tmp_path):
    path = tmp_path / "lines.jsonl"
    lines(path, 1)
    assert [line["square"] for line in lines(path, 1, 2, minutes=0.0)] == [1.0]


def test_the_digest_depends_on_the_sources_of_the_study():
    assert digest(b"one") == digest(b"one") != digest(b"other")


def test_rows_and_their_bars(capsys):
    bars = Bars()
    rows = [
        Row("error", "rls", 0.9, "sigma", 1.0),
        Row("error", "ukf", 1.2, "sigma", 1.0),
        Row("speed", "", 3.0, "x", 2.0, above=True),
    ]
    assert show(iter(rows), bars) == rows
    said = capsys.readouterr()
    assert said.out.splitlines()[-3:] == [
        "| error | rls | 0.9 sigma | <= 1 |",
        "| error | ukf | **1.2 sigma** | <= 1 |",
        "| speed |  | 3 x | >= 2 |",
    ]
    assert "error: ukf 1.2 sigma" in said.err
    assert bars.status() == 1
    assert "1 bars missed\n- error ukf: 1.2 sigma" in capsys.readouterr().out


@pytest.mark.parametrize("value", [float("nan"), 1.0 + 1e-9])
def test_what_is_not_a_number_misses_its_bar(value):
    assert not Row("error", "rls", value, "", 1.0).met


@pytest.mark.parametrize("name", [module.name for module in iter_modules(studies.__path__)])
def test_every_study_loads(name):
    """One that no test uses had not been runnable for days."""
    try:
        import_module(f"bench.studies.{name}")
    except ModuleNotFoundError as missing:  # a peer, which only `make bench` installs
        if str(missing.name).split(".")[0] in ("bench", "rov_ident"):
            raise
        pytest.skip(f"{missing.name} is not installed")


def test_the_study_of_offline_fits_fits_a_dive(heavy):
    archive = validate.archive_of(heavy, dive(heavy, "steps", 20.0, Suite(), 1))
    assert archive.duration == pytest.approx(20.0, abs=1.0)
    assert fit_batch(archive, heavy, "ls").consistency.consistent
