"""Many bags as one fit: in one process, in several, on Dask; and bags that cannot be read."""

import json
import os
import signal

import numpy as np
import pytest
from program import run

from rov_ident.core.errors import UserError
from rov_ident.io.write_messages import write_messages
from rov_ident.offline import archive
from rov_ident.offline.batch_fit import fit_batch
from rov_ident.simulation import virtual_sensors as sensors

pytestmark = pytest.mark.usefixtures("compiled")


@pytest.fixture(scope="module")
def off(heavy):
    factor = np.random.default_rng(3).uniform(0.75, 1.25, len(heavy.model.theta))
    return heavy.with_model(heavy.model.with_theta(heavy.model.theta * factor))


@pytest.fixture(scope="module")
def paths(tmp_path_factory, heavy):
    """Three bags, and between them one that is none."""
    folder = tmp_path_factory.mktemp("archive")
    found = []
    for seed in range(3):
        found.append(folder / f"{seed}.mcap")
        write_messages(found[-1], sensors.dive(heavy, duration=10.0, seed=seed).messages)
    broken = folder / "broken.mcap"
    broken.write_bytes(b"not a bag")
    return [found[0], broken, *found[1:]]


@pytest.fixture(scope="module")
def alone(paths, off):
    """Fits in one process, by estimator."""
    with archive.opened(paths, off) as bags:
        return {kind: fit_batch(bags, off, kind) for kind in ("ls", "ml")}


def same(fit, other):
    np.testing.assert_allclose(fit.values, other.values, rtol=1e-12)
    np.testing.assert_allclose(fit.covariance, other.covariance, rtol=1e-12, atol=1e-300)
    np.testing.assert_allclose(fit.rmse, other.rmse, rtol=1e-12)
    assert fit.samples == other.samples
    assert fit.notes == other.notes
    assert fit.provenance == other.provenance


def test_an_unreadable_bag_is_named_and_left_out(alone):
    for fit in alone.values():
        assert [b["file"] for b in fit.provenance["bags"]] == ["0.mcap", "1.mcap", "2.mcap"]
        assert any("left out" in n and "broken.mcap" in n for n in fit.notes)
        assert fit.duration == pytest.approx(30.0, abs=0.5)


def test_information_adds(paths, off, alone):
    with archive.opened(paths[:1], off) as bags:
        one = fit_batch(bags, off, "ml")
    gain = np.median(one.std / alone["ml"].std)
    assert gain == pytest.approx(np.sqrt(3.0), rel=0.35)


def test_several_processes_give_the_same(paths, off, alone):
    seen = []
    with archive.opened(
        paths, off, jobs=2, say=lambda what, share: seen.append((what, share))
    ) as bags:
        for kind, fit in alone.items():
            same(fit_batch(bags, off, kind), fit)
    assert seen == [(f"read {p.name}", (i + 1) / 4) for i, p in enumerate(paths)]


def test_dask_gives_the_same(paths, off, alone):
    pytest.importorskip("distributed", reason="the extra dask is not installed")
    with archive.opened(paths, off, jobs=2, dask="local") as bags:
        same(fit_batch(bags, off, "ls"), alone["ls"])


def killed(samples):
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_killed_process_is_said(paths, off):
    with archive.opened(paths, off, jobs=2) as bags, pytest.raises(UserError, match="was killed"):
        bags.each(killed)


def test_a_killed_worker_of_dask_is_said(paths, off):
    pytest.importorskip("distributed", reason="the extra dask is not installed")
    import dask.config

    with (
        # as if it took long until the process is back
        dask.config.set({"distributed.deploy.lost-worker-timeout": "0.1s"}),
        archive.opened(paths[:1], off, jobs=1, dask="local") as bags,
        pytest.raises(UserError, match="was killed"),
    ):
        bags.each(killed)


def test_no_scheduler_is_said(paths, off):
    pytest.importorskip("distributed", reason="the extra dask is not installed")
    with (
        pytest.raises(UserError, match="no Dask scheduler answers at"),
        archive.opened(paths, off, dask="tcp://127.0.0.1:9"),
    ):
        pass


@pytest.mark.parametrize("jobs", [1, 2])
def test_nothing_readable_is_refused(paths, off, jobs):
    with (
        pytest.raises(UserError, match=r"broken\.mcap"),
        archive.opened([paths[1], paths[1]], off, jobs=jobs),
    ):
        pass


def test_the_command(paths, tmp_path, heavy_path):
    out, report, saved = tmp_path / "fit.json", tmp_path / "fit.html", tmp_path / "fitted.yaml"
    done = run(
        "fit", *paths, "--config", heavy_path, "--estimator", "ls", "--jobs", 1,
        "--json", out, "--report", report, "--save", saved, "--quiet",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "broken.mcap" in done.stderr
    result = json.loads(out.read_text())
    assert result["estimator"] == "ls"
    assert set(result) >= {"coefficients", "samples", "duration_s", "open_loop"}
    assert set(result["open_loop"]["rmse"]) == set("uvwpqr")
    assert set(result["coefficients"]["X_u"]) >= {"value", "std", "unit", "identifiable"}
    assert result["coefficients"]["X_u"]["identifiable"] is True
    assert result["base_parameters"]["condition"] > 1.0
    page = report.read_text()
    own = page.replace("http://www.w3.org", "").replace("https://github.com/leeoniya/uPlot", "")
    assert page.count("<svg") > 20 and "http" not in own
    assert "X_udot" in saved.read_text()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--estimator", "rls", "--channels", "surge"], "--channels) has no meaning"),
        (["--estimator", "ml", "--ordinary"], "--ordinary) has no meaning"),
        (["--estimator", "ml", "--channels", "warp"], "no channel 'warp'"),
    ],
)
def test_options_that_would_not_be_heeded_are_refused(paths, heavy_path, options, said):
    done = run("fit", paths[0], "--config", heavy_path, *options)
    assert done.returncode == 2
    assert said in done.stderr
