"""The parameter file: what it reads, what it refuses and in which words, and what it writes."""

import array
import dataclasses
import re
import string
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from bench import CONFIGS
from rov_ident.config import (
    LARGEST,
    PARAMETERS,
    VEHICLE_PARAMETERS,
    Config,
    Names,
    Vector,
    dump,
    from_parameters,
    load,
    to_parameters,
)
from rov_ident.config.reading import unflatten
from rov_ident.config.schema import ANY, PULSE_TYPES, WRENCH_TYPES
from rov_ident.core.errors import UserError
from rov_ident.effects import EFFECTS

MINIMAL = """\
/**:
  ros__parameters:
    vehicle:
      name: bluerov2_heavy
      frame: frd
      mass: 13.5
      buoyancy: 134.0
      cog: [0.0, 0.0, 0.0]
      cob: [0.0, 0.0, -0.01]
      inertia: [0.26, 0.23, 0.37, 0.0, 0.0, 0.0]
    coefficients:
      X_udot: -6.36
      X_u: -13.7
      X_uu: -141.0
"""


def minimal(**changes: Any) -> dict[str, Any]:
    """The parameters of MINIMAL with keys replaced: ``vehicle__mass=1.0``; None removes a key."""
    parameters: dict[str, Any] = yaml.safe_load(MINIMAL)["/**"]["ros__parameters"]
    for name, value in changes.items():
        *sections, key = name.split("__")
        section = parameters
        for place in sections:
            section = section.setdefault(place, {})
        if value is None:
            del section[key]
        else:
            section[key] = value
    return parameters


@pytest.fixture
def file(tmp_path: Path) -> Any:
    def write(text: str | bytes) -> Path:
        path = tmp_path / "c.yaml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


# ------------------------------------------------------------------ what it reads


def test_the_keys_of_the_contract_are_enough(file):
    config = load(file(MINIMAL))
    body = config.model.body
    assert config.name == "bluerov2_heavy"
    assert config.estimate == config.model.names == ("X_udot", "X_u", "X_uu")
    assert (body.mass, body.weight, body.buoyancy) == (13.5, 9.81 * 13.5, 134.0)
    np.testing.assert_array_equal(body.cob, [0.0, 0.0, -0.01])
    np.testing.assert_array_equal(body.inertia, np.diag([0.26, 0.23, 0.37]))
    for parameter in PARAMETERS:
        if parameter.key != "estimate":
            value: Any = config
            for name in parameter.key.split("."):
                value = getattr(value, name)
            assert value == parameter.default


def test_whole_numbers_and_exponents_are_numbers(file):
    text = MINIMAL.replace("13.5", "13").replace("-13.7", "-1e1").replace("-141.0", "-1.5E2")
    model = load(file(text)).model
    assert model.body.mass == 13.0
    assert model.theta.tolist() == [-6.36, -10.0, -150.0]


def test_vectors_of_a_flu_file_are_turned_into_frd():
    """Left and up become starboard and down; products of inertia follow both their axes."""
    changes = {
        "vehicle__cog": [1.0, 2.0, 3.0],
        "vehicle__cob": [4.0, 5.0, 6.0],
        "vehicle__inertia": [1.0, 2.0, 2.5, 0.1, 0.2, 0.3],
        "odometry": {"position": [1, 2, 3]},
        "imu": {"position": [4, 5, 6], "rotation": [0.1, 0.2, 0.3]},
    }
    flu = from_parameters(minimal(vehicle__frame="flu", **changes))
    body = flu.model.body
    assert body.cog.tolist() == [1.0, -2.0, -3.0]
    assert body.cob.tolist() == [4.0, -5.0, -6.0]
    assert body.inertia.tolist() == [[1.0, -0.1, -0.2], [-0.1, 2.0, 0.3], [-0.2, 0.3, 2.5]]
    assert flu.odometry.position == (1.0, -2.0, -3.0)
    assert flu.imu.position == (4.0, -5.0, -6.0)
    assert flu.imu.rotation == (0.1, -0.2, -0.3)
    frd = from_parameters(minimal(vehicle__frame="frd", **changes))
    assert to_parameters(frd) == to_parameters(
        from_parameters(minimal(vehicle__frame="fsd", **changes))
    )
    assert frd.model.body.cog.tolist() == [1.0, 2.0, 3.0]
    assert flu.model.theta.tolist() == frd.model.theta.tolist()


def test_dotted_names_are_sections():
    dotted = {
        "vehicle": {"inertia": array.array("d", [0.26, 0.23, 0.37, 0.0, 0.0, 0.0])},
        **{f"vehicle.{k}": v for k, v in minimal()["vehicle"].items() if k != "inertia"},
        **{f"coefficients.{k}": v for k, v in minimal()["coefficients"].items()},
        "rls.gate": 4,
        "prior.std.X_u": 2.0,
        "use_sim_time": True,
        "qos_overrides./clock.subscription.depth": 1,
    }
    config = from_parameters(dotted)
    assert to_parameters(config) == {
        **to_parameters(from_parameters(minimal())),
        "rls": {"gate": 4.0},
        "prior": {"std": {"X_u": 2.0}},
    }


def test_a_node_of_its_own_section_overrides_the_common_one(file):
    own = "/rov/ukf_node:\n  ros__parameters:\n    ukf.gate: 3.0\n"
    path = file(MINIMAL + own)
    assert load(path).ukf.gate == 5.0
    assert load(path, "ukf_node").ukf.gate == 3.0
    assert load(file(MINIMAL.replace("/**", "/rls_node"))).name == "bluerov2_heavy"


def test_what_a_node_alone_needs_may_stand_in_the_common_file(file):
    """Commands and other nodes pass over it."""
    without = to_parameters(load(file(MINIMAL)))
    path = file(f"{MINIMAL}    checkpoint_path: ~/.ros/rov_ident/\n")
    for node in ("", "rls_node", "controller_bridge"):
        assert to_parameters(load(path, node)) == without


def test_a_file_of_two_vehicles_is_refused(file):
    """The last of two sections that a node would take counted, whichever vehicle it was of."""
    for names in (("/rov1/**", "/rov2/**"), ("/rov1/rls_node", "/rov2/rls_node")):
        both = "\n".join(MINIMAL.replace("/**", name) for name in names)
        with pytest.raises(UserError, match="keep a file for each vehicle"):
            load(file(both))


def test_estimate_is_in_the_order_of_the_model_and_knows_both_names_of_a_term():
    config = from_parameters(
        minimal(coefficients__Y_rdot=0.1, estimate=["X_u", "N_vdot", "X_udot"])
    )
    assert config.estimate == ("X_udot", "Y_rdot", "X_u")


def test_effects_are_complete():
    config = from_parameters(minimal(effects={"thruster_lag": {"time_constant": 0.2}}))
    assert config.effects == {"thruster_lag": {"time_constant": 0.2}}
    for effect in EFFECTS.values():
        if effect.coefficients:
            continue
        at_rest = from_parameters(minimal(effects={effect.name: {}})).effects[effect.name]
        assert at_rest == {p.name: p.null for p in effect.parameters}


def test_gravity_gives_the_weight_where_none_is_given():
    assert from_parameters(minimal(gravity=9.8)).model.body.weight == 9.8 * 13.5
    assert from_parameters(minimal(gravity=9.8, vehicle__weight=130)).model.body.weight == 130.0


# ------------------------------------------------------------------ what it refuses

TERMS = "use names such as X_udot, X_u, X_uu, Y_uv or Y_v_abs_r (`rov-ident coefficients` prints"

REFUSED = [
    # missing
    ({"vehicle": None}, "vehicle is missing: a configuration needs vehicle and coefficients"),
    (
        {"coefficients": None},
        "coefficients is missing: a configuration needs vehicle and coefficients",
    ),
    (
        {"vehicle__mass": None},
        "vehicle.mass is missing: mass in air, with enclosed air, a number (kg)",
    ),
    (
        {"vehicle__frame": None},
        "vehicle.frame is missing: axes of every vector in the file: forward-right-down (frd, also "
        "called fsd) or forward-left-up (flu), one of frd, fsd, flu",
    ),
    ({"coefficients": {}}, "coefficients is empty: give at least one, such as X_udot or X_u"),
    # ill-typed
    ({"vehicle": 5}, "vehicle is 5 (a number), but must be a section of keys"),
    ({"coefficients": [1.0]}, "coefficients is [1.0] (a list), but must be a section of names"),
    ({"vehicle__name": 7}, "vehicle.name is 7 (a number), but must be text"),
    ({"vehicle__mass": "heavy"}, "vehicle.mass is 'heavy' (text), but must be a number (kg)"),
    ({"vehicle__mass": True}, "vehicle.mass is True (true or false), but must be a number (kg)"),
    ({"vehicle__mass": [1.0]}, "vehicle.mass is [1.0] (a list), but must be a number (kg)"),
    ({"vehicle__mass": {"kg": 1}}, "vehicle.mass is a section of keys, but must be a number (kg)"),
    ({"vehicle__cog": 0.1}, "vehicle.cog is 0.1 (a number), but must be a list of 3 numbers (m)"),
    ({"vehicle__cog": [0, 0]}, "vehicle.cog has 2 values, but must be a list of 3 numbers (m)"),
    (
        {"vehicle__cog": [0, "a", 0]},
        "vehicle.cog is 'a' (text), but must be a list of 3 numbers (m)",
    ),
    ({"vehicle__frame": "enu"}, "vehicle.frame is 'enu' (text), but must be one of frd, fsd, flu"),
    ({"coefficients__X_u": "a"}, "coefficients.X_u is 'a' (text), but must be a number"),
    ({"estimate": "X_u"}, "estimate is 'X_u' (text), but must be a list of names"),
    ({"estimate": [1]}, "estimate is [1] (a list), but must be a list of names"),
    ({"qos": {"depth": 1.5}}, "qos.depth is 1.5 (a number), but must be a whole number"),
    ({"effects": 1}, "effects is 1 (a number), but must be a section of effects"),
    # unknown
    ({"vehicle__mas": 1.0}, "vehicle.mas is an unknown key: did you mean mass?"),
    ({"vehicles": 1.0}, "vehicles is an unknown key: did you mean vehicle?"),
    ({"estimate_effects": {}}, "estimate_effects is an unknown key: did you mean estimate?"),
    ({"rls": {"gat": 1.0}}, "rls.gat is an unknown key: did you mean gate?"),
    ({"qos": {"zzz": 1.0}}, "qos.zzz is an unknown key: use one of reliability, depth"),
    (
        {"coefficients__X_uuu": -1.0},
        f"coefficients.X_uuu: 'X_uuu' is not a hydrodynamic coefficient: {TERMS} them all); "
        "did you mean X_uu?",
    ),
    ({"estimate": ["Y_v"]}, "estimate: Y_v is not in coefficients: use one of X_udot, X_u, X_uu"),
    ({"estimate": ["X_uv"]}, "estimate: X_uv is not in coefficients: did you mean X_u?"),
    ({"prior": {"std": {"N_r": 1.0}}}, "prior.std.N_r is not in coefficients: use one of X_udot"),
    (
        {"coefficients__Y_rdot": 0.1, "prior": {"std": {"N_vdot": 5.0, "Y_rdot": 1.0}}},
        "prior.std.N_vdot and prior.std.Y_rdot are the same: keep one",
    ),
    (
        {"effects": {"quadratic_damping": {}}},
        "effects.quadratic_damping is a family of coefficients: put X_uu, Y_vv, ",
    ),
    (
        {"effects": {"cog_offset": {"dx": 1.0}}, "coefficients": {"Y_rdot": -2.0, "X_u": -1.0}},
        "effects.cog_offset makes the mass matrix indefinite: ",
    ),
    (
        {"effects": {"battery_sag": {"end_loss": 0.1, "duration": 0.0}}},
        "effects.battery_sag.duration is 0 s, but must be between 1 and ",
    ),
    (
        {"coefficients": {"X_u": -1.0, "X_u_neg": 1.5}},
        "coefficients.X_u_neg is 1.5, but its sum with X_u must not be positive",
    ),
    (
        {"effects": {"thruster_lags": {}}},
        "effects.thruster_lags is an unknown effect: did you mean thruster_lag?",
    ),
    ({"effects": {"thruster_lag": {"time": 0.1}}}, "effects.thruster_lag.time is an unknown key: "),
    # unphysical
    ({"vehicle__mass": 0.0}, "vehicle.mass is 0 kg, but must be positive"),
    ({"vehicle__mass": -13.5}, "vehicle.mass is -13.5 kg, but must be positive"),
    ({"vehicle__buoyancy": 0}, "vehicle.buoyancy is 0 N, but must be positive"),
    ({"vehicle__weight": -1.0}, "vehicle.weight is -1 N, but must be positive"),
    ({"vehicle__mass": float("nan")}, "vehicle.mass is nan (a number), but must be finite"),
    ({"vehicle__cob": [0.0, 0.0, float("inf")]}, "vehicle.cob is inf (a number), but must be fini"),
    ({"coefficients__X_u": float("nan")}, "coefficients.X_u is nan (a number), but must be finite"),
    (
        {"vehicle__inertia": [0.26, -0.23, 0.37, 0.0, 0.0, 0.0]},
        "vehicle.inertia [0.26, -0.23, 0.37, 0.0, 0.0, 0.0] is not positive definite: check its "
        "values and their order xx yy zz xy xz yz",
    ),
    (
        {"vehicle__inertia": [0.26, 0.23, 0.37, 0.5, 0.0, 0.0]},
        "vehicle.inertia [0.26, 0.23, 0.37, 0.5, 0.0, 0.0] is not positive definite: check",
    ),
    ({"coefficients__Y_rdot": 20.0}, "the mass matrix (rigid body plus added mass) is not positi"),
    ({"coefficients__X_uu": 141.0}, "coefficients.X_uu is 141.0, but must not be positive"),
    ({"gravity": 32.2}, "gravity is 32.2 m/s2, but must be between 9.7 and 9.9"),
    ({"rls": {"forgetting_factor": 1.01}}, "rls.forgetting_factor is 1.01, but must be between 0 "),
    ({"qos": {"depth": 0}}, "qos.depth is 0, but must be at least 1"),
    ({"prior": {"std": {"X_u": 0}}}, "prior.std.X_u is 0.0, but must be positive"),
    (
        {"effects": {"thruster_lag": {"time_constant": -0.1}}},
        "effects.thruster_lag.time_constant is -0.1 s, but must be between 0 and 3",
    ),
    # twice
    ({"rls.gate": 3.0, "rls": {"gate": 3.0}}, "rls.gate is given twice: keep one of them"),
    ({"rls": 3.0, "rls.gate": 3.0}, "rls.gate is given, but rls is a value: keep one"),
]


@pytest.mark.parametrize(("changes", "message"), REFUSED, ids=[m[:40] for _, m in REFUSED])
def test_a_refusal_is_one_sentence_with_the_key_and_the_file(changes, message, file):
    with pytest.raises(UserError, match="^" + re.escape(message)) as refusal:
        from_parameters(minimal(**changes))
    assert "\n" not in str(refusal.value)
    assert len(str(refusal.value)) < 500
    # The same through a file, with its name in front.
    path = file(yaml.safe_dump({"/**": {"ros__parameters": minimal(**changes)}}))
    with pytest.raises(UserError, match="^" + re.escape(f"{path}: {message}")):
        load(path)


@pytest.mark.parametrize("key", [p.key for p in VEHICLE_PARAMETERS if p.required])
def test_every_required_key_is_named_when_missing(key):
    with pytest.raises(UserError, match=f"^{key} is missing: "):
        from_parameters(minimal(**{key.replace(".", "__"): None}))


def test_a_number_that_would_overflow_is_refused():
    with pytest.raises(UserError, match="sensible size"):
        from_parameters(minimal(vehicle__buoyancy=2 * LARGEST))
    with pytest.raises(UserError, match="X_u is 1000.*sensible size"):
        from_parameters(minimal(coefficients__X_u=10**400))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty: give a section /**: with ros__parameters: below it"),
        ("# nothing\n", "is empty: give a section /**: with ros__parameters: below it"),
        ("- 1\n", "is [1] (a list) at the top, but must begin with /**:"),
        ("vehicle: {mass: 1}\n", "has no ros__parameters: put /**: and ros__parameters: above the"),
        (
            "/a:\n  ros__parameters: {x: 1}\n/b:\n  ros__parameters: {x: 1}\n",
            "has no section /**: only for a, b; rename one of them",
        ),
        ("/**:\n  ros__parameters:\n", "ros__parameters is empty, but must be a section of keys"),
        (MINIMAL.replace("13.5", "  "), "vehicle.mass is empty, but must be a number (kg)"),
        (MINIMAL.replace("13.5", ".nan"), "vehicle.mass is nan (a number), but must be finite"),
        (MINIMAL.replace("13.5", "[1"), "is not valid YAML at line 7, column 15: expected ',' or"),
        (
            MINIMAL + "      X_u: -1.0\n",
            "is not valid YAML at line 15, column 7: the key X_u is given twice",
        ),
        (
            MINIMAL.replace("bluerov2_heavy", "2024-99-99"),
            "is not valid YAML at line 4, column 13: there is a date: put",
        ),
        (b"\x89MCAP0\r\n\xff\xfe", "is not a text file: give a YAML file"),
        ("a: \x00", "is not valid YAML: unacceptable character #x0000"),
        ("[" * 5000, "is not valid YAML at line 1, column 33: the value is nested deeper than 32"),
    ],
)
def test_a_file_that_is_no_parameter_file(file, text, message):
    path = file(text)
    with pytest.raises(UserError, match="^" + re.escape(f"{path}: {message}")) as refusal:
        load(path)
    assert "\n" not in str(refusal.value)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(
        UserError, match="none.yaml: cannot be read, No such file or directory: give a YAML"
    ):
        load(tmp_path / "none.yaml")
    with pytest.raises(UserError, match="cannot be read, it is a folder: give a YAML file$"):
        load(tmp_path)


JUNK = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=5)
    | st.sampled_from(["vehicle", "mass", "X_u", "frd"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=5,
)
KEYS = [p.key for p in VEHICLE_PARAMETERS + PARAMETERS]
KEYS += ["vehicle", "coefficients", "coefficients.X_u", "prior", "prior.std", "effects", "rls"]


@settings(deadline=None)
@given(st.dictionaries(st.sampled_from(KEYS), JUNK, min_size=1, max_size=3))
def test_nothing_but_a_user_error_comes_of_wrong_values(junk):
    parameters = {
        k: v for k, v in minimal().items() if k not in {key.split(".")[0] for key in junk}
    }
    with_junk = {**parameters, **junk}
    try:
        config = from_parameters(with_junk)
    except UserError:
        return
    assert np.isfinite(config.model.mass_matrix).all()


# ------------------------------------------------------------------ what it writes

FINITE = st.floats(-1e6, 1e6)
NAMES = st.text(string.printable, max_size=12)


def values_of(parameter: Any) -> st.SearchStrategy[Any]:
    """Values that the parameter takes."""
    lower, upper = max(parameter.lower, -1e6), min(parameter.upper, 1e6)
    if parameter.choices:
        return st.sampled_from(parameter.choices)
    if parameter.type is bool:
        return st.booleans()
    if parameter.type is str:
        return NAMES
    if parameter.type is int:
        return st.integers(int(lower), int(upper))
    if parameter.type is Names:
        return st.lists(st.sampled_from(["X_udot", "X_u", "X_uu"]))
    if parameter.type is Vector and parameter.size == ANY:
        return st.lists(st.floats(lower, upper), max_size=7)
    if parameter.type is Vector:
        return st.tuples(*[st.floats(lower, upper)] * parameter.size).map(list)
    return st.floats(lower, upper)


@st.composite
def configurations(draw: Any) -> Config:
    chosen = draw(st.sets(st.sampled_from(PARAMETERS), max_size=8))
    parameters = {p.key: draw(values_of(p)) for p in chosen}
    if parameters.get("inputs.wrench") not in (None, *WRENCH_TYPES):  # then these are checked
        columns = [draw(FINITE) for _ in range(6 * draw(st.integers(1, 3)))]
        parameters = {k: v for k, v in parameters.items() if not k.startswith("thrusters.")}
        parameters["thrusters.allocation"] = columns
    if parameters.get("inputs.wrench") not in PULSE_TYPES:
        parameters.pop("inputs.battery", None)
    positive = st.floats(1e-3, 1e6)
    coefficient = st.floats(-1e6, 0.0)
    return from_parameters(
        {
            **parameters,
            "vehicle": {
                "name": draw(NAMES),
                "frame": draw(st.sampled_from(["frd", "fsd", "flu"])),
                "mass": draw(positive),
                "buoyancy": draw(positive),
                "cog": draw(st.lists(st.floats(-1, 1), min_size=3, max_size=3)),
                "cob": draw(st.lists(FINITE, min_size=3, max_size=3)),
                # Off-diagonal entries below half the diagonal: positive definite.
                "inertia": [10.0, 20.0, 25.0, *draw(st.tuples(*[st.floats(-4, 4)] * 3))],
            },
            "coefficients": {n: draw(coefficient) for n in ("X_udot", "X_u", "X_uu")},
            "effects": draw(st.sampled_from([{}, {"thruster_lag": {"time_constant": 1e-5}}])),
            "prior.std": draw(st.dictionaries(st.sampled_from(["X_u", "X_uu"]), positive)),
        }
    )


@settings(deadline=None, max_examples=100)
@given(configurations())
def test_a_written_configuration_reads_back_to_the_last_bit(tmp_path_factory, config):
    path = tmp_path_factory.mktemp("config") / "c.yaml"
    dump(config, path, comment="fitted from a.mcap\nby a test")
    again = load(path)
    assert to_parameters(again) == to_parameters(config)
    assert again.model.theta.tobytes() == config.model.theta.tobytes()
    assert again.model.mass_matrix.tobytes() == config.model.mass_matrix.tobytes()
    for item in dataclasses.fields(Config):
        if item.name != "model":
            assert getattr(again, item.name) == getattr(config, item.name)
    assert [p.name for p in path.parent.iterdir()] == ["c.yaml"]
    assert path.read_text().startswith("# fitted from a.mcap\n# by a test\n/**:\n")


def test_a_written_configuration_has_no_number_that_other_readers_take_for_text(tmp_path):
    """`1e-05` is text to YAML 1.1; an array with `1` and `0.5` is refused by ROS."""
    dump(
        from_parameters(minimal(coefficients__X_u=-1e-5, odometry={"position": [1, 2, 1e-7]})),
        tmp_path / "c.yaml",
    )
    parameters = yaml.safe_load((tmp_path / "c.yaml").read_text())["/**"]["ros__parameters"]
    assert parameters["coefficients"]["X_u"] == -1e-5
    position = parameters["odometry"]["position"]
    assert [type(x) for x in position] == [float] * 3


def test_another_model_keeps_what_is_held():
    config = from_parameters(minimal(estimate=["X_u", "X_uu"], prior={"std": {"X_uu": 1.0}}))
    smaller = minimal(coefficients={"X_udot": -6.0, "X_u": -10.0, "Y_v": -3.0})
    other = config.with_model(from_parameters(smaller).model)
    assert other.estimate == ("X_u", "Y_v")
    assert other.prior.std == {}
    assert other.model.names == ("X_udot", "X_u", "Y_v")
    assert config.prior.std == {"X_uu": 1.0}


def test_a_name_that_looks_like_a_number_stays_text(tmp_path):
    dump(from_parameters(minimal(vehicle__name="1e5")), tmp_path / "c.yaml")
    assert load(tmp_path / "c.yaml").name == "1e5"


# ------------------------------------------------------------------ what ROS makes of it


@pytest.fixture
def as_a_node_gets_it(monkeypatch) -> Any:
    """Reads a parameter file as a node does, by rcl's own parser."""
    rclpy = pytest.importorskip("rclpy")
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")

    def read(path: Path) -> dict[str, Any]:
        context = rclpy.Context()
        context.init(args=["--ros-args", "--params-file", str(path)])
        try:
            node = rclpy.create_node(
                "rls_node", context=context, automatically_declare_parameters_from_overrides=True
            )
            parameters = {k: v.value for k, v in node.get_parameters_by_prefix("").items()}
            node.destroy_node()
            return parameters
        finally:
            context.shutdown()

    return read


@pytest.mark.parametrize("path", CONFIGS, ids=lambda p: p.stem)
def test_a_node_reads_a_shipped_vehicle_as_the_commands_do(path, as_a_node_gets_it):
    assert to_parameters(from_parameters(as_a_node_gets_it(path))) == to_parameters(load(path))


def test_a_node_reads_what_was_written_as_the_commands_do(tmp_path, as_a_node_gets_it):
    config = from_parameters(
        minimal(
            coefficients__X_u=-1e-5,
            estimate=["X_u"],
            prior={"std": {"X_u": 3}},
            frames={"world": "ned"},
            odometry={"position": [1, 2, 1e-7]},
            qos={"depth": 5},
            effects={"thruster_lag": {"time_constant": 1e-9}},
        )
    )
    dump(config, tmp_path / "c.yaml", comment="by a test")
    parameters = as_a_node_gets_it(tmp_path / "c.yaml")
    assert to_parameters(from_parameters(parameters)) == to_parameters(config)


# ------------------------------------------------------------------ the declarations


def test_every_parameter_is_declared_in_full():
    for parameter in VEHICLE_PARAMETERS + PARAMETERS:
        assert parameter.description
        assert not parameter.description.endswith(".")
        assert parameter.type in (float, int, bool, str, Vector, Names)
        assert (parameter.type is Vector) == (parameter.size != 0)
        if parameter.type is not Vector and parameter.default is not None:
            assert type(parameter.default) is (tuple if parameter.type is Names else parameter.type)
        numbers = parameter.default if parameter.type is Vector else (parameter.default,)
        for number in numbers or ():
            if isinstance(number, float | int):
                assert parameter.lower <= number <= parameter.upper
        if parameter.choices and parameter.default is not None:
            assert parameter.default in parameter.choices
    assert len({p.key for p in PARAMETERS}) == len(PARAMETERS)


def test_unflatten_leaves_nested_parameters_as_they_are():
    parameters = minimal(rls={"gate": 1.0}, effects={})
    assert unflatten(parameters) == parameters


# ------------------------------------------------------------------ the shipped vehicles


@pytest.mark.parametrize("path", CONFIGS, ids=lambda p: p.stem)
def test_a_shipped_vehicle_is_trimmed_light_and_states_its_units(path):
    config = load(path)
    body = config.model.body
    assert path.stem.startswith(config.name)
    if path.stem == config.name:  # the others say themselves how they differ
        assert 1.0 <= body.buoyancy - body.weight <= 2.0
    assert body.cog[2] > body.cob[2]
    text = path.read_text()
    for coefficient in config.model.coefficients:
        unit = re.search(rf"^ +{coefficient.name}: .*# ([^;\n]+)", text, re.MULTILINE)
        assert unit is not None
        assert unit[1].strip() == coefficient.unit


def test_remus_has_the_published_products_of_velocities():
    """Coriolis terms of the added mass plus the lift in the file are Prestero's numbers."""
    model = load(next(p for p in CONFIGS if p.stem == "remus100")).model
    published = {
        **{"X_wq": -35.5, "X_qq": -1.93, "X_vr": 35.5, "X_rr": -1.93},
        **{"Y_uv": -28.6, "Y_ur": 5.22, "Y_wp": 35.5, "Y_pq": 1.93},
        **{"Z_uw": -28.6, "Z_uq": -5.22, "Z_vp": -35.5, "Z_rp": 1.93},
        **{"M_uw": 24.0, "M_uq": -2.0, "M_vp": -1.93, "M_rp": 4.81},
        **{"N_uv": -24.0, "N_ur": -2.0, "N_wp": -1.93, "N_pq": -4.81},
        # (published: 4.86; but it is K_pdot - N_rdot of the published added mass)
    }
    squares = [i for i, c in enumerate(model.coefficients) if c.left >= 7]
    theta = model.theta.copy()
    theta[squares] = 0.0

    def force(nu: Any) -> Any:
        return -model.regressor(np.asarray(nu, dtype=float), np.zeros(6)) @ theta

    for name, value in published.items():
        row, i, j = "XYZKMN".index(name[0]), *("uvwpqr".index(v) for v in name[2:])
        a, b = np.eye(6)[i], np.eye(6)[j]
        # A bilinear form by polarisation; a square term is its own.
        product = force(a) if i == j else force(a + b) - force(a) - force(b)
        assert product[row] == pytest.approx(value, abs=0.005), name
