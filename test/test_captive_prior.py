"""A force table as the prior of a fit: the tank or CFD gives what it can, the dive the rest."""

import json
from dataclasses import replace

import numpy as np
import pytest

from rov_ident.api.functions import fit
from rov_ident.cli.program import main
from rov_ident.config import load
from rov_ident.config.prior import prior_of
from rov_ident.core.errors import UserError
from rov_ident.core.files import shipped
from rov_ident.estimation.online import OnlineEstimator
from rov_ident.io.write_messages import write_messages
from rov_ident.offline import captive_tests
from rov_ident.offline.captive_prior import disagreements, with_prior
from rov_ident.sampling import records
from rov_ident.simulation import virtual_sensors as sensors

AXES = {"X": 0, "Y": 1, "Z": 2, "N": 5}


def towed(config, seed, path, noise=0.03):
    """The fits of a table of the drag on four axes, written to ``path``."""
    rng = np.random.default_rng(seed)
    speeds = np.linspace(-1.0, 1.0, 24)
    nu = np.vstack([speeds[:, None] * np.eye(6)[i] for i in AXES.values()])
    forces = np.array([-config.model.damping_matrix(x) @ x for x in nu])
    forces *= 1.0 + noise * rng.standard_normal(forces.shape)
    forces += 0.3 * noise * forces.std(axis=0) * rng.standard_normal(forces.shape)
    table = captive_tests.ForceTable(
        "towed.csv", nu, {}, {axis: forces[:, i] for axis, i in AXES.items()}
    )
    fits = captive_tests.fit(table)
    path.write_text(captive_tests.to_json(fits))
    return fits


def off(config, seed):
    rng = np.random.default_rng(100 + seed)
    factors = np.clip(1.0 + 0.3 * rng.standard_normal(len(config.model.theta)), 0.4, 1.6)
    return config.with_model(config.model.with_theta(config.model.theta * factors))


def test_table_and_dive_are_better_than_either_and_honest(tmp_path):
    """Drawn tables and dives; the vehicle's file is 30 % off, and its mass is not exact.

    The table is as sure as the file allows, which has linear drag that the table may leave out.
    Thrust and velocity sensor are exact, or a dive would make what the table tells less certain
    (docs/forces.md).
    """
    heavy = load(shipped("config/bluerov2_heavy.yaml"))
    heavy = replace(
        heavy,
        wrench=replace(heavy.wrench, scale_std=0.0),
        odometry=replace(heavy.odometry, scale_std=0.0),
    )
    inside, ratios = [], []
    path = tmp_path / "forces.json"
    for seed in range(5):
        fits = towed(heavy, seed, path)
        run = sensors.dive(heavy, "steps", 15.0, seed=seed)
        found = []
        told = with_prior(off(heavy, seed), path)[0]
        for config in (off(heavy, seed), told):
            online = OnlineEstimator(config, "rls")
            for part in records.samples_of(online.config, run):
                online.take(part)
            found.append(online.report())
        dive, both = found
        for name in (n for f in fits.values() for n in f.names if n in heavy.model.names):
            i = both.names.index(name)
            inside.append(both.lower[i] <= heavy.value(name) <= both.upper[i])
            ratios.append((both.std[i] / told.prior.std[name], both.std[i] / dive.std[i]))
    assert np.mean(inside) >= 0.85  # some 30 of 95 %: by chance fewer one time in sixty
    assert (np.median(ratios, axis=0) < 0.9).all()
    assert (np.array(ratios).min(axis=1) < 1.0).all()


@pytest.fixture(scope="module")
def dive_and_table(heavy, tmp_path_factory):
    folder = tmp_path_factory.mktemp("prior")
    write_messages(folder / "dive.mcap", sensors.dive(heavy, duration=8.0, seed=1).messages)
    towed(heavy, 0, folder / "forces.json", noise=0.003)
    return folder / "dive.mcap", folder / "forces.json"


@pytest.mark.parametrize("estimator", ["ls", "iv", "ml", "rls", "ukf"])
def test_every_estimator_takes_it(heavy, dive_and_table, estimator):
    bag, table = dive_and_table
    found = fit(bag, off(heavy, 3), estimator, prior_from=table)
    assert found.more["prior_from"]["file"] == "forces.json"
    assert "Y_vv" in found.more["prior_from"]["coefficients"]
    assert found.value("Y_vv") == pytest.approx(heavy.value("Y_vv"), rel=0.02)
    i = found.names.index("Y_vv")
    assert found.std[i] < 0.02 * 217.0  # a third of what the file's prior leaves after 8 s
    assert json.loads(found.to_json())["prior_from"]["sha256"]


def test_what_the_table_left_out_is_not_taken_for_zero(heavy, tmp_path):
    """The table's X_uu holds for X_u = 0: beside an X_u it is less, and less certain."""
    slope, terms = 1.2, {"X_uu": {"value": -160.0, "std": 2.0}}
    axis = {"terms": terms, "covariance": [[4.0]], "left_out": {"X_u": [slope]}}
    path = tmp_path / "f.json"
    path.write_text(json.dumps({"axes": {"X": axis}}))
    new, told = with_prior(heavy, path)
    assert told["coefficients"] == ["X_uu"]
    assert new.value("X_uu") == pytest.approx(-160.0 - slope * heavy.value("X_u"))
    prior = prior_of(heavy)
    alone = np.hypot(2.0, slope * prior.std[prior.names.index("X_u")])
    assert alone < new.prior.std["X_uu"] < np.sqrt(2.0) * alone
    assert "X_u" not in new.prior.std and new.value("X_u") == heavy.value("X_u")


def test_the_prior_is_in_no_direction_surer_than_the_table(heavy, tmp_path):
    path = tmp_path / "f.json"
    terms = {"X_u": {"value": -14.0, "std": 1.0}, "X_uu": {"value": -140.0, "std": 2.0}}
    for correlation in (0.0, 0.9, -0.9):
        covariance = np.array([[1.0, 2.0 * correlation], [2.0 * correlation, 4.0]])
        axis = {"terms": terms, "covariance": covariance.tolist()}
        path.write_text(json.dumps({"axes": {"X": axis}}))
        std = with_prior(heavy, path)[0].prior.std
        diagonal = np.diag([std["X_u"] ** 2, std["X_uu"] ** 2])
        assert np.linalg.eigvalsh(diagonal - covariance).min() > -1e-9
        assert std["X_u"] == pytest.approx(np.sqrt(1.0 + abs(correlation)))


def test_terms_that_the_configuration_lacks_are_added(heavy, tmp_path):
    path = tmp_path / "f.json"
    terms = {"Y_v": {"value": -20.0, "std": 1.0}, "Y_0": {"value": 1.0, "std": 0.1}}
    path.write_text(json.dumps({"axes": {"Y": {"terms": terms}}}))
    new, told = with_prior(heavy, path)
    assert new.value("Y_v") == -20.0 and "Y_v" in new.estimate
    assert new.prior.std == {"Y_v": 1.0} and told["coefficients"] == ["Y_v"]


def test_table_and_dive_that_exclude_each_other_are_named():
    names, prior = ("X_uu", "Y_vv"), {"X_uu": (-100.0, 2.0), "Y_vv": (-200.0, 2.0)}
    (note,) = disagreements(prior, names, np.array([-110.0, -201.0]), np.array([1.0, 1.0]))
    assert note.startswith("X_uu: the table has -100") and "exclude each other" in note


def terms(**values):
    return {"axes": {"X": {"terms": {"X_uu": {"value": -140.0, "std": 2.0} | values}}}}


BAD = {
    "no JSON": ("{", "is no result of a force table"),
    "another result": ({"coefficients": {}}, "is no result of a force table"),
    "a list": ([1, 2], "is no result of a force table"),
    "no std": ({"axes": {"X": {"terms": {"X_uu": {"value": -1.0}}}}}, "X_uu lacks the numbers"),
    "text": (terms(value="many"), "X_uu lacks the numbers"),
    "null": (terms(std=None), "is no result of a force table"),
    "negative": (terms(std=-3.0, value=0.0), "X_uu is 0 with a std of -3"),
    "unknown": ({"axes": {"X": {"terms": {"X_zz": {"value": 1.0, "std": 1.0}}}}}, "X_zz"),
    "another axis": ({"axes": {"Y": {"terms": {"X_uu": {"value": -1.0, "std": 1.0}}}}}, "axis Y"),
    "a constant": ({"axes": {"X": {"terms": {"X_0": {"value": 1.0, "std": 1.0}}}}}, "constant"),
    "driven": (terms(value=140.0), "X_uu is 140.0, but must not be positive"),
    "matrix": (
        {"axes": {"X": {**terms()["axes"]["X"], "covariance": [[1.0, 0.0]]}}},
        "do not fit its 1 terms",
    ),
    "Munk": (
        {"axes": {"N": {"terms": {"N_uv": {"value": -10.0, "std": 1.0}}}}},
        "N_uv holds a Coriolis force of the added mass",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_are_refused_in_a_sentence(case, heavy, heavy_path, tmp_path, capsys):
    document, sentence = BAD[case]
    path = tmp_path / "f.json"
    path.write_text(document if isinstance(document, str) else json.dumps(document))
    arguments = ["fit", "dive.mcap", "--config", str(heavy_path), "--prior-from", str(path)]
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert "f.json" in said and sentence in said.replace("\n", " ") and said.count("\n") == 1
    if case == "Munk":  # and not where they were taken off
        path.write_text(json.dumps({**document, "coriolis_taken_off": True}))
        assert with_prior(heavy, path)[0].value("N_uv") == -10.0


def test_no_file_and_no_prior_are_refused(heavy, tmp_path):
    with pytest.raises(UserError, match="cannot be read"):
        with_prior(heavy, tmp_path / "none.json")
    with pytest.raises(UserError, match="exclude each other"):
        fit("dive.mcap", heavy, prior_from=tmp_path / "f.json", prior=False)
