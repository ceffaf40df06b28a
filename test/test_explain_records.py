"""Several records: what they share, what each has for itself, and whether a cause repeats."""

import dataclasses

import numpy as np
import pytest
from tiers import more

from bench import CONFIGS, HEAVY
from rov_ident import config as configuration
from rov_ident.discrepancy import repetition, sensor_consistency
from rov_ident.discrepancy.explain import _beside_given, explain
from rov_ident.discrepancy.findings import unsure
from rov_ident.discrepancy.held_out import Judge, blocks, split, windows
from rov_ident.discrepancy.hypothesis import THRUST_SCALE, Hypothesis, bounds, precision
from rov_ident.discrepancy.multiple_shooting import tangent
from rov_ident.discrepancy.output_error import fit, with_best_onsets
from rov_ident.discrepancy.prepared import of_guided
from rov_ident.discrepancy.report import _card
from rov_ident.discrepancy.results import Alternative, Finding, Gain, Value
from rov_ident.discrepancy.search import Search
from rov_ident.discrepancy.windowed_problem import WindowedProblem
from rov_ident.effects import EFFECTS
from rov_ident.model.coefficients import AXES
from rov_ident.sampling.raw_streams import gather, inspected, joined
from rov_ident.simulation.virtual_sensors import Suite, dive

TODAY = configuration.load(HEAVY)
LEAN = Suite(odometry_rate=10.0, imu_rate=0.0)


def record(seed, duration=40.0, suite=LEAN, coefficients=None, **effects):
    """A dive of the vehicle with effects that its configuration does not have, and coefficients
    that differ from its own."""
    document = configuration.to_parameters(TODAY) | {"effects": effects}
    document["coefficients"] |= coefficients or {}
    true = configuration.from_parameters(document)
    messages = dive(true, "steps", duration, suite, seed).messages
    return gather(((role, message) for _, role, message in messages), TODAY)


def both(name, values, config=TODAY):
    """A configuration with more in one of its sections."""
    document = configuration.to_parameters(config)
    return configuration.from_parameters(document | {name: {**document.get(name, {}), **values}})


@pytest.mark.parametrize("imu", [50.0, *more(0.0)])
def test_what_the_file_says_of_the_sensors_is_taken_off(imu):
    """The arm of a sensor that the file has was named once more, surely."""
    config = both("odometry", {"position": [0.5, 0.2, -0.1]})
    sensors = {
        "velocity_scale": {"scale": 1.1},
        "sensor_misalignment": {"roll": 0.0, "pitch": 0.0, "yaw": 0.1},
    }
    if imu:
        sensors["imu_bias"] = {"gx": 0.02, "gy": 0.0, "gz": 0.0, "ax": 0.0, "ay": 0.1, "az": 0.0}
    config = both("effects", sensors, config)
    run = dive(config, "steps", 60.0, Suite(odometry_rate=10.0, imu_rate=imu), 1)
    messages = [(role, message) for _, role, message in run.messages]
    read = gather(messages, config)
    spans = windows(0.0, read.duration)
    assert sensor_consistency.search(read, config, spans)[0] == {}
    as_read = sensor_consistency.search(gather(messages, TODAY), TODAY, spans)[0]
    assert {"velocity_scale", "sensor_misalignment", "sensor_lever_arm"} <= as_read.keys()


def test_what_is_found_is_written_beside_what_the_file_has():
    config = both("effects", {"velocity_scale": {"scale": 1.1}, "velocity_latency": {"delay": 0.1}})
    assert _beside_given(config, "velocity_scale", {"scale": 1.02}) == {"scale": 1.1 * 1.02}
    late = _beside_given(config, "velocity_latency", {"delay": 0.05})
    assert late == {"delay": pytest.approx(0.15)}
    assert _beside_given(config, "heading_offset", {"yaw": 0.2}) == {"yaw": 0.2}


def test_velocities_that_were_not_measured_stay_as_they_are():
    """What holds zeros is taken as measured, and not turned, by a sensor that sits elsewhere."""
    config = both("odometry", {"position": [0.5, 0.2, -0.1]})
    run = dive(config, "steps", 20.0, LEAN, 1)
    flat = [
        (r, m._replace(linear=m.linear * [1.0, 1.0, 0.0]) if r == "odom" else m)
        for _, r, m in run.messages
    ]
    read = gather(flat, config)
    assert list(read.guided) == [False, False, True, False, False, False]
    assert not read.nu[:, 2].any() and read.nu[:, :2].all()


@pytest.mark.parametrize("seed", [1, *more(2, 3)])
def test_a_record_without_a_pose_says_nothing_of_the_velocities(seed):
    """Its position, which never moved, made coriolis of a velocity scale, surely."""
    bags = [record(s, velocity_scale={"scale": 1.05}) for s in (seed, seed + 10)]
    still = np.zeros_like(bags[1].position)
    bags[1] = inspected(dataclasses.replace(bags[1], position=still))
    streams, begins = joined(bags)
    assert list(streams.posed) == [True] * len(bags[0].t) + [False] * len(bags[1].t)
    spans = [(a + b, a + c) for a in begins for b, c in windows(0.0, 39.0)]
    found, std = sensor_consistency.search(streams, TODAY, spans)
    assert list(found) == ["velocity_scale"]
    assert abs(found["velocity_scale"]["scale"] - 1.05) < 3.5 * std["velocity_scale", "scale"]
    gain = Gain("u", 1.0, 0.5, 50.0, 40.0, 60.0)
    value = {"scale": Value(1.05, 0.001, "1")}
    told = Finding("velocity_scale", (), value, None, gain, True, None, (), "")
    (told,) = repetition.of_sensors(bags, TODAY, [told], [0.0, 0.0])
    assert told.repetition.same and np.isinf(told.repetition.records[1]["scale"].std)


def test_a_record_without_forces_tells_no_scale_of_them():
    """Of a vehicle under fins and a propeller, whose coefficients may all be too large together."""
    driven = record(1)
    (told,) = of_guided(dataclasses.replace(driven, demand=np.zeros_like(driven.demand)))
    assert "no force in newtons is recorded" in told and not of_guided(driven)


def test_a_record_without_moments_or_heave_lacks_them_for_all():
    bags = [record(1), record(2)]
    forces = bags[1].demand * [1.0, 1.0, 1.0, 0.0, 0.0, 0.0]
    flat = bags[1].nu * [1.0, 1.0, 0.0, 1.0, 1.0, 1.0]
    bags[1] = inspected(dataclasses.replace(bags[1], demand=forces, nu=flat))
    assert list(joined(bags)[0].guided) == [False, False] + [True] * 4


@pytest.mark.parametrize("seed", [4, *more(1, 2, 3, 5, 6)])
def test_what_is_taken_up_within_a_held_out_block_leaves_nothing(seed):
    """Its block, of which no fit knows when it begins, does not count: much was said to be left."""
    rng = np.random.default_rng(seed)
    begin, end = split(120.0)[1][1]
    onset = rng.uniform(begin + 1.0, end - 1.0)
    payload = {"mass_wet": 1.0, "x": 0.1, "y": 0.0, "z": 0.1, "onset": onset}
    findings = explain([record(seed, 120.0, payload=payload)], TODAY).findings
    first, *others = findings.effects
    assert first.effect == "payload" and first.onset_s == pytest.approx(onset, abs=0.3)
    assert not any(f.separable for f in others)
    assert not any("left" in note for note in findings.notes)


def test_each_record_has_a_clock_of_its_own():
    """Waves, and a battery that runs down, begin with each record; a payload is taken up in one."""
    duration, onset = 40.0, 15.0
    dive_of = {
        "wave": {"fx": 10.0, "fy": 5.0, "fz": 0.0, "frequency": 0.23, "phase": 1.0},
        "battery_sag": {"end_loss": 0.3, "duration": duration},
    }
    payload = {"mass_wet": 1.0, "x": 0.1, "y": 0.0, "z": 0.0, "onset": onset}
    bags = [record(1, duration, **dive_of), record(2, duration, **dive_of, payload=payload)]
    streams, begins = joined(bags)
    assert streams.longest == pytest.approx(max(bag.duration for bag in bags))
    payload["onset"] = begins[1] + onset
    there = {**dive_of, "payload": payload}
    h = Hypothesis(TODAY, {(e, n): x for e, of in there.items() for n, x in of.items()})
    problem = WindowedProblem(streams, blocks(streams))
    motion = problem.motion(h, problem.measured_starts())
    for error in (problem.errors(h), problem.measured - motion.nu[problem.nodes]):
        assert (np.sqrt(np.mean(error**2, axis=0)) < np.repeat([0.02, 0.01], 3)).all()
    sag = h.without([k for k in h.keys if k[0] == "battery_sag"]).having(
        {("battery_sag", "end_loss"): 0.1}
    )
    halves = [s for a, b in blocks(streams) for s in windows(a, b)]
    sag = dataclasses.replace(sag, constants=Search(streams, TODAY, halves).given.constants)
    fitted = fit(WindowedProblem(streams, halves), sag)
    assert fitted.hypothesis.values["battery_sag", "end_loss"] == pytest.approx(0.3, abs=0.02)


def fitted_to_each(bags, effect, parameters):
    """A search, the records, and fits to all of them and to each that have an effect."""
    streams, begins = joined(bags)
    halves = [s for a, b in blocks(streams) for s in windows(a, b)]
    search = Search(streams, TODAY, halves)
    values = {(effect, name): value for name, value in parameters.items()}
    last = fit(WindowedProblem(streams, halves), search.given.having(values))
    records = repetition.Records(streams, bags, begins)
    return search, records, last, repetition.alone(records, last)


def told_in_each(bags, effect, **parameters):
    """What the records say of an effect that a fit to all of them has from the start."""
    search, records, last, alone = fitted_to_each(bags, effect, parameters)
    gain = Gain("u", 1.0, 0.5, 50.0, 40.0, 60.0)
    found = Finding(effect, ("X",), dict.fromkeys(parameters), None, gain, True, None, (), "")
    return repetition.in_each(search, records, last, [found], alone)[0][0]


@pytest.mark.parametrize("seed", [1, *more(3, 5)])
def test_records_have_an_effect_of_their_own_only_where_they_differ(seed):
    """What is the same in each is one value, whichever way the search came to it."""
    mine, other = {"north": 0.3, "east": 0.1}, {"north": -0.2, "east": 0.2}
    for second, differs in ((other, True), (mine, False)):
        bags = [record(seed, ocean_current=mine), record(seed + 1, ocean_current=second)]
        streams, begins = joined(bags)
        spans = [(b + s, b + e) for bag, b in zip(bags, begins) for s, e in split(bag.duration)[0]]
        search = Search(streams, TODAY, spans)
        found = search.extended(search.start())
        assert search.named(found) == ["ocean_current"]
        assert found.hypothesis.owners == (frozenset({0, 1}) if differs else frozenset())
        common = search.given.having({("ocean_current", n): 0.01 for n in mine})
        again = search.extended(fit(search.problem, common))
        assert (again is not None and again.hypothesis.owners == {0, 1}) == differs


def test_what_a_record_has_of_its_own_moves_that_record_alone():
    """And its derivatives are those of the simulation, of a load, a current and the trim."""
    streams, begins = joined([record(1), record(2), record(3)])
    spans = [s for a, b in blocks(streams) for s in windows(a, b)]
    problem = WindowedProblem(streams, spans)
    own = {
        ("payload", "mass_wet@2"): 0.5,
        ("payload", "x@2"): 0.1,
        ("ocean_current", "north@3"): 0.1,
        ("cog_offset", "dx"): 0.004,
        ("thruster_gain", "gain_Z@1"): 0.8,
    }
    h, starts = Hypothesis(TODAY, own), problem.measured_starts()
    assert set(h.in_record(1).effects) == {"payload", "cog_offset"}
    assert set(h.in_record(2).effects) == {"ocean_current", "cog_offset"}
    assert set(h.in_record(0).effects) == {"thruster_gain", "cog_offset"}
    assert set(h.effects) == {"cog_offset"}
    motion = problem.motion(h, starts)
    for i, begin in enumerate(begins):
        alone = problem.motion(h.in_record(i), starts)
        mine = problem.streams.begin_of(problem.times) == begin
        assert (motion.nu[problem.nodes][mine] == alone.nu[problem.nodes][mine]).all()
    e = problem
    moved = tangent(motion, e.first, e.last, e.nodes, e.columns(h, motion, list(own)))
    for i, (key, value) in enumerate(own.items()):
        step = 1e-4
        there, here = (e.motion(h.having({key: value + s}), starts) for s in (step, -step))
        slope = (there.nu - here.nu)[e.nodes] / (2.0 * step)
        assert np.abs(slope - moved[..., i]).max() < 0.02 * np.abs(slope).max()


LADEN = {
    "payload": lambda rng: {"mass_wet": rng.uniform(0.5, 1.5), "x": rng.uniform(-0.2, 0.2)},
    "buoyancy": lambda rng: {"delta": rng.choice([-1.0, 1.0]) * rng.uniform(2.0, 5.0)},
    "thrust_scale": lambda rng: {"scale": rng.uniform(0.75, 0.95)},
    "thruster_gain": lambda rng: {f"gain_{AXES[rng.integers(6)]}": rng.uniform(0.6, 0.9)},
}


@pytest.mark.parametrize(
    ("name", "seed"),
    [
        ("payload", 51),
        *more(("thruster_gain", 51), *((n, s) for n in LADEN for s in range(52, 56))),
    ],
)
def test_what_one_dive_of_three_has_is_found_in_that_dive(name, seed):
    """Whichever of them it is. A search for one value for all three found nothing of a load, and a
    thrust that is weaker in one dive ended as other coefficients."""
    rng = np.random.default_rng(seed)
    values, laden = LADEN[name](rng), int(rng.integers(3))
    bags = [record(10 * seed + i, 60.0, **({name: values} if i == laden else {})) for i in range(3)]
    found = explain(bags, TODAY)
    (told,) = (f for f in found.findings.effects if f.effect == name)
    assert not told.repetition.same and "The records differ" in told.sentence
    for parameter, true in values.items():
        each = [of[parameter] for of in told.repetition.records]
        assert abs(each[laden].value - true) < 4.0 * each[laden].std < 0.2 * abs(true)
        assert told.parameters[parameter].value == pytest.approx(each[laden].value, rel=0.05)
    amplitude = next(iter(values))
    others = [of[amplitude] for i, of in enumerate(told.repetition.records) if i != laden]
    null = bounds((name, amplitude))[0]
    assert all(abs(v.value - null) < 4.0 * v.std for v in others)
    assert name not in found.extended.effects
    assert any(f"has {name} of its own" in note for note in found.findings.notes)


@pytest.mark.parametrize("seed", [71, *more(72, 73, 74, 75)])
def test_records_that_differ_in_what_no_effect_describes_are_said_to(seed):
    """A skid that one dive carries: retuned, a single model is wrong in each of them."""
    rng = np.random.default_rng(seed)
    name, other = str(rng.choice(["X_uu", "Y_vv", "Z_wdot", "M_qdot"])), int(rng.integers(3))
    document = configuration.to_parameters(TODAY)["coefficients"]
    skid = {name: document[name] * float(rng.uniform(1.3, 1.6))}
    bags = [record(10 * seed + i, 60.0, coefficients=skid if i == other else {}) for i in range(3)]
    told = explain(bags, TODAY).findings
    assert told.verdict == "unexplained" and not any(f.separable for f in told.effects)
    (why,) = told.contradictions
    assert "the records differ" in why and f"what differs most is {name} " in why
    alike = explain([bags[other], record(10 * seed + 3, 60.0, coefficients=skid)], TODAY).findings
    assert alike.verdict == "retuned" and not alike.contradictions


def test_what_gains_where_it_does_not_act_may_stand_for_something_else():
    """Weak heave makes roll wrong, which gains more; so would a moment that is missing there."""
    bag, key = record(71, 60.0, thruster_gain={"gain_Z": 0.7}), ("thruster_gain", "gain_Z")
    judge = Judge(WindowedProblem(bag, blocks(bag)))
    before, after = Hypothesis(TODAY, {}), Hypothesis(TODAY, {key: 0.7})
    gain = judge.gain(before, after, ("Z",))
    assert gain.component == "p"
    acts = {axes: judge.gains_elsewhere(gain, before, after, axes) for axes in ("Z", "K", "N", "")}
    assert acts == {"Z": False, "K": False, "N": True, "": True}


@pytest.mark.parametrize("seed", [81, *more(82, 83, 84)])
def test_a_velocity_sensor_of_one_dive_is_not_hidden_by_the_others(seed):
    """All together show nothing, and the verdict was that the simulation agrees."""
    rng = np.random.default_rng(seed)
    name, parameter, value = (
        ("sensor_misalignment", "pitch", float(rng.uniform(0.07, 0.15))),
        ("velocity_scale", "scale", float(rng.uniform(0.88, 0.95))),
    )[int(rng.integers(2))]
    other = int(rng.integers(3))
    null = {p.name: p.null for p in EFFECTS[name].parameters}
    off = {name: null | {parameter: value}}
    bags = [record(10 * seed + i, 60.0, **(off if i == other else {})) for i in range(3)]
    explanation = explain(bags, TODAY)
    (told,) = explanation.findings.effects
    assert told.effect == name and told.separable and not told.repetition.same
    for i, of in enumerate(told.repetition.records):
        true = value if i == other else null[parameter]
        assert abs(of[parameter].value - true) < max(4.0 * of[parameter].std, 0.01)
    assert name not in explanation.extended.effects


@pytest.mark.parametrize("seed", [61, *more(62, 63)])
def test_waves_have_a_phase_of_their_own_in_each_dive(seed):
    """With one phase for all nothing was found, as they cancel."""
    rng = np.random.default_rng(seed)
    wave = {"fx": 4.0, "fy": -3.0, "frequency": float(rng.uniform(0.1, 0.3))}
    phases = (rng.uniform(0.0, 1.0) + np.array([0.0, 2.1, 4.2])) % 6.2
    bags = [record(seed + i, wave={**wave, "phase": p}) for i, p in enumerate(phases)]
    found = explain(bags, TODAY)
    (told,) = found.findings.effects
    assert told.effect == "wave" and not told.repetition.same
    for of, phase in zip(told.repetition.records, phases):
        assert of["frequency"].value == pytest.approx(wave["frequency"], abs=0.002)
        sign = np.sign(of["fx"].value)
        for name in ("fx", "fy"):
            assert sign * of[name].value == pytest.approx(wave[name], abs=0.4)
        apart = of["phase"].value - phase + (0.0 if sign > 0.0 else np.pi)
        assert abs(np.angle(np.exp(1j * apart))) < 0.2
    assert "wave" not in found.extended.effects


def test_a_current_of_one_dive_is_said_to_be_of_that_dive():
    bags = [record(1, ocean_current={"north": 0.3}), record(2)]
    found = told_in_each(bags, "ocean_current", north=0.1, east=0.01, down=0.01)
    assert not found.repetition.same and not found.repetition.repeats
    assert not found.separable and found.manoeuvre
    for of, true in zip(found.repetition.records, (0.3, 0.0)):
        assert abs(of["north"].value - true) < 4.0 * of["north"].std < 0.2
    assert "The records differ" in found.sentence


@pytest.mark.parametrize("seed", [31, *more(5)])
def test_what_the_records_share_is_not_pulled_along_by_what_each_has_of_its_own(seed):
    """Currents of three dives, and drag that the file has wrong: what is written simulates a dive
    in still water as the truth does, and what is told of the dives is with the current of each."""
    rng = np.random.default_rng(seed)
    drag = {n: float(rng.uniform(0.6, 1.5)) for n in ("X_uu", "Y_vv", "Z_ww")}
    currents = [dict(zip(("north", "east"), rng.uniform(-0.3, 0.3, 2).tolist())) for _ in range(3)]
    document = configuration.to_parameters(TODAY)
    own = {n: v * drag.get(n, 1.0) for n, v in document["coefficients"].items()}
    guessed = configuration.from_parameters(document | {"coefficients": own})
    bags = [record(seed + i, 60.0, ocean_current=of) for i, of in enumerate(currents)]
    found = explain(bags, guessed)
    told = {f.effect: f for f in found.findings.effects}["ocean_current"].repetition
    for of, true in zip(told.records, currents):
        assert all(abs(of[n].value - true[n]) < 0.03 for n in true)
    assert "ocean_current" not in found.extended.effects
    assert any("has ocean_current of its own" in note for note in found.findings.notes)
    still = record(seed + 9, 60.0)
    judge = Judge(WindowedProblem(still, blocks(still)))
    rmse = {
        name: np.array(list(judge.rmse(Hypothesis(config, {})).values()))
        for name, config in (("true", TODAY), ("file", guessed), ("extended", found.extended))
    }
    assert np.all(rmse["extended"] < 1.1 * rmse["true"])
    assert np.any(rmse["file"] > 1.5 * rmse["true"])
    squares = []
    for bag, current in zip(bags, currents):
        dives = Judge(WindowedProblem(bag, split(bag.duration)[1]))
        values = {("ocean_current", name): value for name, value in current.items()}
        squares.append(dives.squares(Hypothesis(TODAY, values)))
    left = np.array(list(found.findings.extended.values()))
    assert np.all(left < 1.2 * np.sqrt(np.concatenate(squares).mean(axis=0)))


@pytest.mark.parametrize("seed", [3, *more(5)])
def test_a_current_that_is_always_there_is_the_same_and_repeats(seed):
    current = {"north": 0.2, "east": -0.1}
    bags = [record(seed, ocean_current=current), record(seed + 1, ocean_current=current)]
    found = told_in_each(bags, "ocean_current", north=0.1, east=0.01, down=0.01)
    assert found.repetition.same and found.repetition.repeats and found.separable
    assert "It is the same in each record." in found.sentence


def test_a_payload_of_one_dive_is_said_to_be_of_that_dive():
    """Its onset belongs to that dive alone: nothing to compare."""
    bags = [record(9, payload={"mass_wet": 0.4, "x": 0.2, "onset": 20.0}), record(10)]
    found = told_in_each(bags, "payload", mass_wet=0.2, x=0.01, y=0.01, z=0.01, onset=20.0)
    assert not found.repetition.same
    assert "mass_wet" in found.sentence and "onset" not in found.sentence


def test_headings_are_compared_between_records():
    bags = [record(7, heading_offset={"yaw": yaw}) for yaw in (0.1, 0.1, -0.5)]
    turned, headings = repetition.turned(bags, TODAY)
    assert np.abs(np.array(headings) - [0.0, 0.0, -0.6]).max() < 0.05
    assert np.abs(turned[2].orientation - turned[0].orientation).max() < 0.05
    same, none = repetition.turned(bags[:2], TODAY)
    assert none == [0.0, 0.0] and same[0] is bags[0]


def test_a_heading_is_each_dives_own():
    """With the values that were taken off before the records were compared."""
    bags = [record(seed, heading_offset={"yaw": yaw}) for seed, yaw in ((11, 0.1), (12, 0.6))]
    turned, headings = repetition.turned(bags, TODAY)
    gain = Gain("kinematic", 2.0, 1.0, 50.0, 40.0, 60.0)
    value = {"yaw": Value(0.1, 0.01, "rad")}
    found = Finding("heading_offset", (), value, None, gain, True, None, (), "")
    (own,) = repetition.of_sensors(turned, TODAY, [found], headings)
    assert not own.repetition.same and own.separable
    for of, true in zip(own.repetition.records, (0.1, 0.6)):
        assert abs(of["yaw"].value - true) < 0.02
    assert "The records differ: yaw" in own.sentence
    page = _card(own)
    assert "record 2" in page and "The records differ in it." in page


def test_a_delay_of_one_record_is_not_averaged():
    rng = np.random.default_rng(21)
    delay = rng.uniform(0.1, 0.2)
    bags = [record(15), record(16, velocity_latency={"delay": delay})]
    timed, late = repetition.in_time(bags, TODAY)
    assert len(timed) == 2
    for value, true in zip(late, (0.0, delay)):
        assert abs(value.value - true) < max(4.0 * value.std, 0.004)
    same, none = repetition.in_time([bags[1], bags[1]], TODAY)
    assert none == [] and same[0] is bags[1]


def test_delays_apart_by_less_than_a_reading_are_the_same(monkeypatch):
    """Within an interval of the IMU nothing is known of how velocities went on."""
    imu = Suite(odometry_rate=10.0, imu_rate=50.0)
    bags = [record(seed, 20.0, imu) for seed in (1, 2)]
    for apart, said in ((0.01, False), (0.06, True)):
        delays = [0.0, 0.0, apart, apart]  # each is looked for, and then fitted

        def search(*_, of=delays):
            return {"velocity_latency": {"delay": of.pop(0)}}, {("velocity_latency", "delay"): 1e-4}

        monkeypatch.setattr(sensor_consistency, "search", search)
        assert bool(repetition.in_time(bags, TODAY)[1]) == said


def test_where_one_record_ends_and_the_next_begins_the_sensors_show_nothing():
    """The position begins anew there: taken for a velocity it made a delay of milliseconds, and
    standard deviations a fifth as large as those of the records together."""
    suite = Suite(odometry_rate=20.0, imu_rate=50.0)
    adrift = {"north": 0.3, "east": -0.2}
    bags = [record(seed, 60.0, suite, ocean_current=adrift) for seed in (41, 42, 43)]
    assert np.linalg.norm(bags[0].position[-1] - bags[1].position[0]) > 10.0
    delays = []
    for bag in [*bags, joined(bags)[0]]:
        spans = windows(0.0, bag.duration)
        found, std = sensor_consistency.search(bag, TODAY, spans, ["velocity_latency"])
        delays.append((found["velocity_latency"]["delay"], std["velocity_latency", "delay"]))
    *each, (of_all, std_of_all) = delays
    weight = np.array([std for _, std in each]) ** -2.0
    mean, std = weight @ [delay for delay, _ in each] / weight.sum(), weight.sum() ** -0.5
    assert abs(of_all - mean) < std and 0.5 < std_of_all / std < 3.0


def test_what_is_not_sure_names_no_rival_that_was_refuted():
    gain = Gain("u", 1.0, 0.5, 50.0, 40.0, 60.0)
    rivals = (Alternative("lift", "fits this bag as well"), Alternative("wave", "explains 12 %"))
    found = Finding("buoyancy", ("Z",), {}, None, gain, True, None, rivals, "")
    assert unsure(found).alternatives == rivals[:1] and found.alternatives == rivals
    assert not unsure(found).separable and unsure(found).manoeuvre


def test_what_each_record_has_of_its_own_is_told():
    """A heading and a delay that only the second has: the first one's are nothing."""
    own = {"heading_offset": {"yaw": 0.4}, "velocity_latency": {"delay": 0.15}}
    bags = [record(17), record(18, **own)]
    found = explain(bags, TODAY).findings
    told = {f.effect: f for f in found.effects}
    for effect, values in own.items():
        ((name, true),) = values.items()
        first, second = (of[name].value for of in told[effect].repetition.records)
        assert not told[effect].repetition.same
        assert abs(first) < 0.02 and abs(second - true) < 0.02
    assert any("velocity_latency of its own" in note for note in found.notes)
    assert any("heading of its own" in note for note in found.notes)


def test_what_is_taken_up_between_two_dives_begins_with_the_second():
    """And not in the last seconds of the first, which no fit sees."""
    bags = [record(19), record(20, payload={"mass_wet": 0.8, "x": 0.1})]
    streams, begins = joined(bags)
    to_fit = [(b + s, b + e) for bag, b in zip(bags, begins) for s, e in split(bag.duration)[0]]
    search = Search(streams, TODAY, to_fit)
    values = {"mass_wet": 0.5, "x": 0.05, "y": 0.01, "z": 0.01, "onset": begins[1] - 3.0}
    there = search.given.having({("payload", n): v for n, v in values.items()})
    fitted = with_best_onsets(fit(search.problem, there))
    at = fitted.hypothesis.values["payload", "onset"]
    assert at == pytest.approx(begins[1], abs=0.5)
    records = repetition.Records(streams, bags, begins)
    gain = Gain("w", 1.0, 0.5, 50.0, 40.0, 60.0)
    onset = {"onset": Value(at, 0.1, "s")}
    found = Finding("payload", ("Z",), onset, at, gain, True, None, (), "")
    alone = repetition.alone(records, fitted)
    (own,), left_out = repetition.in_each(search, records, fitted, [found], alone)
    assert not own.repetition.same and "begins in record 2, 0 s" in own.sentence
    assert own.onset_s == own.parameters["onset"].value == pytest.approx(0.0, abs=0.5)
    assert left_out == ["payload"]


def test_a_thrust_scale_that_nothing_tells_stays_what_the_file_says_of_it():
    h = Search(record(22), TODAY, windows(0.0, 40.0)).given.having({THRUST_SCALE: 1.0})
    scale = TODAY.wrench.scale_std
    unsure = configuration.from_parameters(
        configuration.to_parameters(TODAY) | {"wrench": {"scale_std": 0.15}}
    )
    assert scale == 0.0  # said to be known
    width = (
        precision(dataclasses.replace(h, config=unsure), True)[h.keys.index(THRUST_SCALE)] ** -0.5
    )
    assert width == pytest.approx(0.15)


def test_without_recorded_forces_the_file_says_how_large_they_are_and_trim_is_free():
    driven = record(22)
    still = dataclasses.replace(driven, demand=np.zeros_like(driven.demand))
    assert driven.has_forces and not still.has_forces
    file = configuration.load(next(p for p in CONFIGS if p.stem == "remus100"))
    with_forces, without = (Search(s, file, windows(0.0, 40.0)).given for s in (driven, still))
    trim = {k: std for k, std in file.nuisance_std.items() if k[0] in ("buoyancy", "cog_offset")}
    assert len(trim) == 4
    assert without.keys == (*with_forces.keys, *trim)
    width = dict(zip(without.keys, precision(without, False) ** -0.5, strict=True))
    assert {k: width[k] for k in trim} == pytest.approx(trim)
    wide = precision(with_forces, True) ** -0.5
    own = [width[k] for k in with_forces.keys]
    np.testing.assert_allclose(own / wide, file.prior.relative_std / 10.0)
