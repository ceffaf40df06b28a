"""Plain logs into bags: what is kept, what is refused, what is said."""

import numpy as np
import pytest
from program import messages_in

from bench import DATA
from rov_ident.core import frames
from rov_ident.core.errors import UserError
from rov_ident.io.csv_log import import_csv, parse_columns

BASE = ["t_s", *"uvwpqrXYZKMN"]
EULER = ["roll", "pitch", "yaw"]


def table(headings, rows=20, step=0.1, **values):
    """Columns of a log: zero but for the time and what is given (a number or an array)."""
    columns = {heading: np.zeros(rows) for heading in headings}
    columns["t_s"] = step * np.arange(rows)
    for name, value in values.items():
        columns[name] = np.broadcast_to(value, rows).astype(float)
    return columns


def save(path, columns, comment="# a log\n"):
    rows = np.column_stack(list(columns.values()))
    lines = [",".join(columns), *(",".join(map(repr, row)) for row in rows.tolist())]
    path.write_text(comment + "\n".join(lines) + "\n")
    return path


def contents(path):
    """{role: messages} on the wire."""
    found = {"odom": [], "wrench": []}
    for role, message in messages_in(path):
        found[role].append(message)
    return found


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out.mcap"


def test_every_number_arrives(tmp_path, out):
    numbers = np.random.default_rng(1)
    columns = table([*BASE, "x", "y", "z", *EULER])
    for heading in columns:
        if heading != "t_s":
            columns[heading] = 0.3 * numbers.normal(size=20)
    report = import_csv([save(tmp_path / "log.csv", columns)], out)
    assert (report.rows, report.odometry, report.masked, report.wrapped) == (20, 20, 0, 0)
    assert report.notes == ()
    assert report.duration == pytest.approx(1.9)
    got = contents(out)
    for k, (odometry, wrench) in enumerate(zip(got["odom"], got["wrench"], strict=True)):
        row = {name: column[k] for name, column in columns.items()}
        assert odometry.stamp == wrench.stamp == 10**9 + k * 10**8
        assert (odometry.frame_id, odometry.child_frame_id) == ("world_ned", "base_link_frd")
        assert wrench.frame_id == "base_link_frd"
        assert list(odometry.linear) == [row[name] for name in "uvw"]
        assert list(odometry.angular) == [row[name] for name in "pqr"]
        assert list(odometry.position) == [row[name] for name in "xyz"]
        assert list(wrench.force) == [row[name] for name in "XYZ"]
        assert list(wrench.torque) == [row[name] for name in "KMN"]
        euler = frames.quaternion_to_euler(odometry.orientation)
        np.testing.assert_allclose(euler, [row[name] for name in EULER], atol=1e-12)
        assert frames.to_core(odometry) is odometry


def test_the_quaternion_wins_over_angles(tmp_path, out):
    q = frames.quaternion_from_euler(0.1, 0.2, 0.3)
    columns = table([*BASE, *EULER], **dict(zip(["qw", "qx", "qy", "qz"], 1.0001 * q, strict=True)))
    import_csv([save(tmp_path / "log.csv", columns)], out)
    np.testing.assert_allclose(contents(out)["odom"][3].orientation, q, atol=1e-14)


def test_flu_keeps_ros_axes(tmp_path, out):
    import_csv([save(tmp_path / "log.csv", table(BASE, v=0.5, Y=2.0))], out, body_frame="flu")
    odometry = contents(out)["odom"][0]
    assert (odometry.frame_id, odometry.child_frame_id) == ("odom", "base_link")
    assert odometry.linear[1] == 0.5
    assert frames.to_core(odometry).linear[1] == -0.5
    assert frames.to_core(contents(out)["wrench"][0]).force[1] == -2.0


def test_what_the_log_does_not_tell_agrees_with_the_velocities(tmp_path, out):
    report = import_csv([save(tmp_path / "log.csv", table(BASE, rows=101, u=2.0, r=0.5))], out)
    assert len(report.notes) == 3
    assert "roll and pitch" in report.notes[0]
    assert "yaw" in report.notes[1]
    assert "x y z" in report.notes[2]
    last = contents(out)["odom"][-1]
    expected = frames.quaternion_from_euler(0.0, 0.0, 5.0)
    np.testing.assert_allclose(np.abs(last.orientation @ expected), 1.0)
    circle = 2.0 / 0.5 * np.array([np.sin(5.0), 1.0 - np.cos(5.0), 0.0])
    np.testing.assert_allclose(last.position, circle, atol=5e-3)  # of the trapezoidal rule


@pytest.mark.parametrize("given", [[], ["yaw"], ["roll", "yaw"], ["pitch"]])
def test_angles_that_the_log_lacks_follow_the_rates(tmp_path, out, given):
    """A righting moment acts on a vehicle that rolls: to take roll for zero would hide it."""
    rng = np.random.default_rng(3)
    t = 0.05 * np.arange(1200)
    angles, speeds = np.zeros((3, len(t))), np.zeros((3, len(t)))
    for i, size in enumerate((0.08, 0.05, 0.3)):  # each a few waves, and roll and pitch level
        for _ in range(3):
            pulse, phase = rng.uniform(0.5, 3.0), rng.uniform(0.0, 2.0 * np.pi)
            angles[i] += size * np.sin(pulse * t + phase)
            speeds[i] += size * pulse * np.cos(pulse * t + phase)
    (roll, pitch, _), (d_roll, d_pitch, d_yaw) = angles, speeds
    rates = {
        "p": d_roll - d_yaw * np.sin(pitch),
        "q": d_pitch * np.cos(roll) + d_yaw * np.sin(roll) * np.cos(pitch),
        "r": -d_pitch * np.sin(roll) + d_yaw * np.cos(roll) * np.cos(pitch),
    }
    noisy = {k: v + 0.003 + rng.normal(0.0, 0.005, len(t)) for k, v in rates.items()}  # a bias, too
    known = {name: angles[EULER.index(name)] for name in given}
    columns = table(BASE, len(t), 0.05, **noisy, **known)
    report = import_csv([save(tmp_path / "log.csv", columns)], out)
    lacking = [name for name in ("roll", "pitch") if name not in given]
    assert any(f"no {' and '.join(lacking)} given: integrated" in note for note in report.notes)
    got = [frames.quaternion_to_euler(message.orientation) for message in contents(out)["odom"]]
    error = np.array(got).T[:2] - angles[:2]
    # it is 1 where they are taken for zero
    assert (np.sqrt(np.mean(error**2, axis=1)) < 0.4 * np.std(angles[:2], axis=1)).all()


@pytest.mark.parametrize("name", ["roll", "pitch"])
def test_small_angles_in_degrees_are_seen_by_the_rates(tmp_path, out, name):
    """A tilt of 3 degrees is less than a radian: a number that could be one."""
    rng, t = np.random.default_rng(3), 0.05 * np.arange(1200)
    tilt = 0.05 * np.sin(0.9 * t)
    rate = 0.045 * np.cos(0.9 * t) + 0.003 + rng.normal(0.0, 0.005, len(t))
    columns = table([*BASE, *EULER], len(t), 0.05, **{"p" if name == "roll" else "q": rate})
    columns[name] = tilt + rng.normal(0.0, 0.005, len(t))
    path = save(tmp_path / "log.csv", columns)
    import_csv([path], out)
    columns[name] = np.degrees(columns[name])
    save(path, columns)
    with pytest.raises(UserError, match=f"{name} changes as the rates do in degrees"):
        import_csv([path], tmp_path / "no.mcap")
    import_csv([path], tmp_path / "yes.mcap", degrees=[name])
    assert (tmp_path / "yes.mcap").exists()
    columns |= {"p": 0.0 * t, "q": 0.0 * t}  # rates that were not measured tell nothing
    import_csv([save(path, columns)], out)


def test_a_gyro_that_drifts_far_tells_no_roll_and_pitch(tmp_path, out):
    """Its bias of 5 mrad/s would have turned the vehicle by 1.5 rad in five minutes."""
    columns = table(BASE, 3000, 0.1, p=0.005 + 0.05 * np.cos(0.3 * np.arange(3000)))
    report = import_csv([save(tmp_path / "log.csv", columns)], out)
    assert "no roll and pitch given: taken as 0" in report.notes
    last = frames.quaternion_to_euler(contents(out)["odom"][-1].orientation)
    np.testing.assert_allclose(last, 0.0, atol=1e-9)


def test_depth_alone_is_kept(tmp_path, out):
    report = import_csv(
        [save(tmp_path / "log.csv", table([*BASE, *EULER, "z"], z=3.0, u=1.0))], out
    )
    np.testing.assert_allclose(contents(out)["odom"][-1].position, [1.9, 0.0, 3.0])
    assert "no x y given" in report.notes[0]


def test_flicker_is_left_out_but_its_wrench_stays(tmp_path, out):
    rates = np.zeros(20)
    rates[[4, 5, 11]] = 1.6, -1.7, 9.0
    path = save(tmp_path / "log.csv", table([*BASE, *EULER], q=rates))
    report = import_csv([path], out, mask_rates_above=1.5)
    assert (report.masked, report.odometry) == (3, 17)
    got = contents(out)
    assert len(got["wrench"]) == 20
    assert {m.stamp for m in got["wrench"]} - {m.stamp for m in got["odom"]} == {
        10**9 + k * 10**8 for k in (4, 5, 11)
    }
    with pytest.raises(UserError, match="raise the limit"):
        import_csv([save(path, table(BASE, q=2.0))], out, mask_rates_above=1.5)


def test_angles_averaged_across_their_wrap_are_left_out(tmp_path, out):
    yaw = frames.wrap_angle(np.linspace(2.8, 3.6, 20))
    first_negative = int(np.argmax(yaw < 0))
    yaw[first_negative] = 0.02  # the mean of +179 and -177 degrees
    path = save(tmp_path / "log.csv", table([*BASE, *EULER, *"xyz"], yaw=yaw))
    report = import_csv([path], out)
    assert report.wrapped == 1
    assert "averaged" in report.notes[0]
    stamps = [message.stamp for message in contents(out)["odom"]]
    assert 10**9 + first_negative * 10**8 not in stamps
    assert len(stamps) == 19


def test_wrench_as_a_mean_changes_midway(tmp_path, out):
    columns = table(BASE, X=np.arange(20.0))
    columns["t_s"][10:] += 0.3  # an uneven step
    path = save(tmp_path / "log.csv", columns)
    import_csv([path], out, wrench_timing="mean")
    got = contents(out)
    t = columns["t_s"]
    expected = 1.0 + np.concatenate([[0.0], 0.5 * (t[1:] + t[:-1])])
    np.testing.assert_allclose([m.stamp for m in got["wrench"]], 1e9 * expected, atol=1)
    assert [m.force[0] for m in got["wrench"]] == list(range(20))
    np.testing.assert_allclose([m.stamp for m in got["odom"]], 1e9 * (1.0 + t), atol=1)


def test_rows_as_means_over_bins_put_the_motion_into_their_middle(tmp_path, out):
    columns = table(BASE, X=np.arange(20.0))
    columns["t_s"][10:] += 0.1  # a bin twice as wide
    columns["t_s"][15:] += 0.5  # a gap
    import_csv([save(tmp_path / "log.csv", columns)], out, wrench_timing="bin")
    got = contents(out)
    t = columns["t_s"]
    half = np.full(20, 0.05)
    half[9] = 0.1
    np.testing.assert_allclose([m.stamp for m in got["wrench"]], 1e9 * (1.0 + t), atol=1)
    np.testing.assert_allclose([m.stamp for m in got["odom"]], 1e9 * (1.0 + t + half), atol=1)


@pytest.mark.skipif(not DATA.is_dir(), reason="the measured data are not on this machine")
@pytest.mark.parametrize(("timing", "agrees"), [("bin", True), ("held", False)])
def test_the_measured_rows_are_means_over_bins(out, timing, agrees):
    """With uneven bins the way between rows tells at what time each of them stands."""
    log = DATA / "bluerov2-heavy-tank" / "11_57_50_3dof.csv"
    import_csv([log], out, wrench_timing=timing)
    messages = contents(out)["odom"]
    time = 1e-9 * np.array([m.stamp for m in messages])
    position = np.array([m.position for m in messages])
    rotation = frames.quaternion_to_matrix(np.array([m.orientation for m in messages]))
    velocity = np.einsum("nij,nj->ni", rotation, np.array([m.linear for m in messages]))
    mean = 0.5 * (velocity[1:] + velocity[:-1])
    fast = np.linalg.norm(mean, axis=1) > 0.15
    elapsed = np.sum(np.diff(position, axis=0) * mean, axis=1)[fast] / np.sum(mean**2, axis=1)[fast]
    error = np.median(np.abs(elapsed - np.diff(time)[fast]))
    assert (error < 0.005) == agrees


def test_other_headings_and_constants(tmp_path, out):
    columns = table(BASE, u=0.7)
    columns["surge speed"] = columns.pop("u")
    del columns["p"]
    path = save(tmp_path / "log.csv", columns, comment="\ufeff# a byte order mark\n\n")
    import_csv([path], out, columns={"u": "surge speed", "p": "0.25"})
    odometry = contents(out)["odom"][0]
    assert odometry.linear[0] == 0.7
    assert odometry.angular[0] == 0.25


def test_map_items(tmp_path):
    mapping = tmp_path / "map.yaml"
    mapping.write_text("u: surge\np: 0\n")
    assert parse_columns([str(mapping), "u=speed=fast"]) == {"u": "speed=fast", "p": "0"}
    for wrong in (str(tmp_path / "none.yaml"), str(save(tmp_path / "a.csv", table(BASE)))):
        with pytest.raises(UserError):
            parse_columns([wrong])


def test_files_that_continue_each_other(tmp_path, out):
    first, second = table(BASE), table(BASE)
    second["t_s"] += 2.0
    paths = [save(tmp_path / "a.csv", first), save(tmp_path / "b.csv", second)]
    assert import_csv(paths, out).rows == 40
    with pytest.raises(UserError, match=r"a\.csv, line 3: t_s goes from 3\.9 to 0"):
        import_csv(paths[::-1], out)
    save(paths[1], {**second, **table(EULER)})
    with pytest.raises(UserError, match="other columns"):
        import_csv(paths, out)


def test_columns_that_are_left_out_are_named(tmp_path, out):
    columns = table([*BASE, "x", "y", "z", *EULER, "rudder_rad", "yaw_deg", "depth"])
    path = save(tmp_path / "log.csv", columns)
    (note,) = import_csv([path], out).notes
    assert note == "columns left out (--map names them): rudder_rad, yaw_deg, depth"
    (note,) = import_csv([path], out, depths=["depth"]).notes
    assert note.endswith(": rudder_rad, yaw_deg")
    mapped = import_csv([path], out, {"delta_r": "rudder_rad"}).notes
    assert mapped[0].endswith(": yaw_deg, depth")


def test_headings_that_numpy_wrote_as_a_comment_are_headings(tmp_path, out):
    columns = table([*BASE, "x", "y", "z", *EULER])
    path, rows = tmp_path / "log.csv", np.column_stack(list(columns.values()))
    np.savetxt(path, rows, delimiter=",", header="of a dive\n" + ",".join(columns))
    report = import_csv([path], out)
    assert (report.rows, report.notes) == (20, ())
    path.write_text("# m s, N\n" + "\n".join(",".join(map(str, row)) for row in rows))
    with pytest.raises(UserError):  # a comment of other length has no headings
        import_csv([path], out)


def test_times_before_zero_are_moved(tmp_path, out):
    columns = table(BASE)
    columns["t_s"] -= 5.0
    report = import_csv([save(tmp_path / "log.csv", columns)], out)
    assert "moved" in report.notes[0]
    assert contents(out)["odom"][0].stamp == 10**9


def with_cell(columns, heading, row, text):
    lines = [",".join(columns)]
    for k in range(len(columns["t_s"])):
        cells = [text if (h, k) == (heading, row) else repr(float(columns[h][k])) for h in columns]
        lines.append(",".join(cells))
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "has no rows below its headings"),
        ("t_s,u\n0,1\n", "has no column `v`: it has t_s, u"),
        (with_cell(table(BASE), "w", 3, "fast"), r"line 5, column `w`: `fast` is not a number"),
        (with_cell(table(BASE), "w", 3, ""), r"line 5, column `w`"),
        (with_cell(table(BASE), "w", 3, "nan"), r"line 5, column `w`"),
        (with_cell(table(BASE), "w", 3, "1,2"), r"line 5: 14 cells under 13 headings"),
        (with_cell(table(BASE), "t_s", 3, "0.2"), r"line 5: t_s is 0\.2 as in the row before"),
        (with_cell(table(BASE, step=100.0), "u", 0, "0"), "must be in seconds"),
        (with_cell(table(BASE, step=5.0), "u", 0, "0"), "must be in seconds"),  # ms at 200 Hz
        (with_cell(table([*BASE, *EULER], pitch=30.0), "u", 0, "0"), "line 2: pitch is 30.*rad"),
        (
            with_cell(table([*BASE, *EULER], yaw=5.7 * np.arange(20), r=1.0), "u", 0, "0"),
            r"line 4: yaw is 11\.4.*rad",
        ),
        (with_cell(table([*BASE, "qw", "qx", "qy", "qz"]), "u", 0, "0"), "length 1"),
        (",".join(BASE), "has no rows below its headings"),
        (with_cell(table(BASE), "u", 3, "1e308"), "line 5: no vehicle has this odom, not finite"),
        (with_cell(table(BASE), "X", 3, "-1e200"), "line 5: no vehicle has this wrench"),
        (with_cell(table([*BASE, "x"]), "x", 3, "1e12"), "line 5: no vehicle has this odom"),
    ],
)
def test_a_log_that_cannot_be_used(tmp_path, out, text, words):
    path = tmp_path / "log.csv"
    path.write_text(text)
    with pytest.raises(UserError, match=words) as caught:
        import_csv([path], out)
    assert str(path) in str(caught.value)
    assert not out.exists()


def test_an_unwrapped_yaw_in_radians_is_accepted(tmp_path, out):
    yaw = 0.1 * 5.0 * np.arange(20)
    import_csv([save(tmp_path / "log.csv", table([*BASE, *EULER], yaw=yaw, r=5.0))], out)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"body_frame": "ned"}, "`frd` or `flu`"),
        ({"wrench_timing": "late"}, "`held`, `mean` or `bin`"),
        ({"mask_rates_above": 0.0}, "positive"),
        ({"columns": {"speed": "u"}}, "`speed` cannot be mapped"),
        ({"columns": {"u": "speed"}}, "no column `speed`"),
        ({"columns": {"yaw": "heading"}}, "no column `heading`"),
    ],
)
def test_options_that_cannot_be(tmp_path, out, options, words):
    path = save(tmp_path / "log.csv", table(BASE))
    with pytest.raises(UserError, match=words):
        import_csv([path], out, **options)


def test_files_that_cannot_be_read(tmp_path, out):
    with pytest.raises(UserError, match="cannot be read"):
        import_csv([tmp_path / "none.csv"], out)
    binary = tmp_path / "binary.csv"
    binary.write_bytes(b"\x89MCAP0\r\n\xff\xfe")
    with pytest.raises(UserError, match="not a CSV"):
        import_csv([binary], out)


@pytest.mark.skipif(not DATA.is_dir(), reason="the measured data are not on this machine")
def test_measured_logs(out):
    tank = DATA / "bluerov2-heavy-tank"
    report = import_csv([tank / "11_40_38_6dof.csv"], out, mask_rates_above=1.5)
    assert (report.rows, report.wrapped) == (1055, 3)
    assert report.masked == 22
    core = [frames.to_core(message) for message in contents(out)["odom"]]
    # Upright most of the time: world down is body down.
    down = frames.gravity_direction(np.array([message.orientation for message in core]))
    assert np.median(down[:, 2]) > 0.9
    report = import_csv([DATA / "sonia-auv" / "yaw_10_1.csv"], out)
    assert len(report.notes) == 3
