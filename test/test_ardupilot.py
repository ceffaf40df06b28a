"""Logs of an autopilot into bags: written here as ArduPilot writes them, read by pymavlink."""

import struct

import numpy as np
import pytest
from program import messages_in
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from test_inputs import DIRECTION, GEOMETRY, POSITION, configured, estimate

from bench import HEAVY
from rov_ident import config
from rov_ident.cli.program import main
from rov_ident.core.errors import UserError
from rov_ident.core.frames import quaternion_to_euler, quaternion_to_matrix, to_core
from rov_ident.core.messages import IMU, ODOMETRY, WRENCH, Imu, Odometry, Wrench, fault
from rov_ident.io.ardupilot_log import import_log
from rov_ident.io.write_messages import write_messages
from rov_ident.model import thruster_allocation as thrusters

VOLTAGE = 15.2
FORMATS = {  # type: (name, format, columns), as ArduPilot's LogStructure.h has them
    128: ("FMT", "BBnNZ", "Type,Length,Name,Format,Columns"),
    1: ("XKF1", "QBccCfffffffccce", "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD,dPD,PN,PE,PD,GX,GY,GZ,OH"),
    2: ("XKQ", "QBffff", "TimeUS,C,Q1,Q2,Q3,Q4"),
    3: ("IMU", "QBffffffIIfBBHH", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz"),
    4: ("RCOU", "Q" + 14 * "H", "TimeUS," + ",".join(f"C{i}" for i in range(1, 15))),
    5: ("BAT", "QBff", "TimeUS,Inst,Volt,VoltR"),
    6: ("ATT", "QccccCCCC", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw,ErrRP,ErrYaw"),
}
SIZES = {**dict(zip("BbHhIifdQq", "BbHhIifdQq", strict=True)), "c": "h", "C": "H", "e": "i",
         "n": "4s", "N": "16s", "Z": "64s"}  # fmt: skip


def structure(kind, kinds=FORMATS):
    return struct.Struct("<" + "".join(SIZES[c] for c in kinds[kind][1]))


def record(kind, *values, kinds=FORMATS):
    return bytes([0xA3, 0x95, kind]) + structure(kind, kinds).pack(*values)


def dataflash(path, rows, kinds=FORMATS):
    """A log of (type, *values); the formats of ``kinds`` are declared first."""
    head = [
        record(128, kind, 3 + structure(kind, kinds).size, *(text.encode() for text in kinds[kind]))
        for kind in kinds
    ]
    path.write_bytes(b"".join(head + [record(*row, kinds=kinds) for row in rows]))
    return path


@pytest.fixture(scope="module")
def dive(short_dive):
    """What the autopilot knows, in its axes: [(time [us], role, core message or pulses)].

    The odometry has the gyro's rates, and no variances: a log holds neither.
    """
    matrix = thrusters.allocation(np.array(POSITION), np.array(DIRECTION))
    curve = thrusters.t200(VOLTAGE)
    inverse = np.linalg.pinv(matrix)
    core = [(m.stamp // 1000 - 1_000_000, role, to_core(m)) for _, role, m in short_dive]
    gyro_t = np.array([t for t, role, _ in core if role == IMU])
    gyro = np.array([m.angular_velocity for _, role, m in core if role == IMU])
    rows = []
    for t, role, m in sorted(core, key=lambda row: (row[0], row[1] != WRENCH)):
        if role == WRENCH:
            m = 1100 + np.searchsorted(curve, inverse @ np.concatenate([m.force, m.torque]))
        elif role == ODOMETRY:
            if not gyro_t[0] <= t <= gyro_t[-1]:
                continue
            rates = np.array([np.interp(t, gyro_t, column) for column in gyro.T])
            m = m._replace(angular=rates, twist_variance=np.zeros(6))
        rows.append((t, role, m))
    return rows


def expected(path, dive, quantise=lambda role, t, m: (t, m)):
    """The report from a bag of the same numbers that never were in a log."""
    matrix = thrusters.allocation(np.array(POSITION), np.array(DIRECTION))
    curve = thrusters.t200(VOLTAGE)
    messages = []
    for t, role, m in dive:
        t, m = quantise(role, t, m)
        stamp = 1000 * (t + 1_000_000)
        if role == WRENCH:
            tau = matrix @ curve[m - 1100]
            m = Wrench(stamp, "base_link_frd", tau[:3], tau[3:])
        elif role == IMU:
            zero = np.zeros(3)
            m = Imu(stamp, "imu_frd", np.zeros(4), m.angular_velocity, m.linear_acceleration,
                    zero, zero)  # fmt: skip
        else:
            m = m._replace(stamp=stamp, frame_id="world_ned", child_frame_id="base_link_frd")
        messages.append((stamp, role, m))
    write_messages(path, messages)
    return estimate(path, config.load(HEAVY))


def assert_close(report, reference, rtol):
    assert report.stamp == reference.stamp
    np.testing.assert_allclose(report.values, reference.values, rtol=rtol)
    np.testing.assert_allclose(report.std, reference.std, rtol=rtol)


def rows_of(dive, quaternion=True):
    """What ArduSub logs of the dive; a second core, IMU and battery say something else."""
    yield 5, 0, 0, VOLTAGE, VOLTAGE
    yield 5, 1, 1, 3.3, 3.3
    for t, role, m in dive:
        if role == WRENCH:
            yield 4, t, *m.tolist(), *[0] * 6
        elif role == IMU:
            yield 3, t, 0, *m.angular_velocity, *m.linear_acceleration, 0, 0, 40.0, 1, 1, 100, 100
            yield 3, t, 1, *[9.0] * 6, 0, 0, 40.0, 1, 1, 100, 100
        else:
            degrees = np.degrees(quaternion_to_euler(m.orientation))
            roll, pitch, yaw = np.round(100 * degrees).astype(int).tolist()
            if quaternion:
                yield 2, t, 0, *m.orientation
                yield 2, t, 1, 1.0, 0.0, 0.0, 0.0
            else:
                yield 6, t, 0, roll, 0, pitch, 0, yaw % 36000, 0, 0
            v = quaternion_to_matrix(m.orientation) @ m.linear
            yield 1, t, 0, 0, 0, 0, *v, 0.0, *m.position, 0, 0, 0, 0
            yield 1, t, 1, 0, 0, 0, *[5.0] * 7, 0, 0, 0, 0


def test_a_dataflash_log(tmp_path, dive):
    """The estimate of the dive itself, to the single precision of the log."""
    path = dataflash(tmp_path / "00000012.BIN", rows_of(dive))
    report = import_log(path, tmp_path / "log.mcap", configured(**GEOMETRY))
    counts = {role: sum(own == role for _, own, _ in dive) for role in (ODOMETRY, IMU, WRENCH)}
    assert (report.odometry, report.imu, report.wrench) == tuple(counts.values())
    assert report.notes == (f"battery from {VOLTAGE} to {VOLTAGE} V, as measured",)
    reference = expected(tmp_path / "direct.mcap", dive)
    assert_close(estimate(tmp_path / "log.mcap", config.load(HEAVY)), reference, 2e-5)


def test_an_attitude_in_hundredths_of_a_degree(tmp_path, dive):
    """Without the EKF's quaternion the autopilot's angles serve: 0.005 deg at most off."""
    kinds = {kind: own for kind, own in FORMATS.items() if kind != 2}
    path = dataflash(tmp_path / "log.bin", rows_of(dive, quaternion=False), kinds)
    report = import_log(path, tmp_path / "log.mcap", configured(**GEOMETRY))
    assert "the attitude is the autopilot's angles" in report.notes[-1]
    reference = expected(tmp_path / "direct.mcap", dive)
    found = estimate(tmp_path / "log.mcap", config.load(HEAVY))
    assert found.stamp == reference.stamp
    assert np.all(np.abs(found.values - reference.values) < 0.3 * reference.std)


def telemetry(path, dive, offset=0):
    """A .tlog: for each message the time of arrival [us], big-endian, and the packet."""
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    station = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    data = bytearray()

    def add(t, message, sender=mav):
        data.extend(struct.pack(">Q", 1_700_000_000_000_000 + t) + message.pack(sender))

    add(offset, mav.attitude_encode(offset // 1000, *[0.0] * 6))
    for t, role, m in dive:
        t += offset
        ms = round(t / 1000)
        if role == WRENCH:
            pulses = m.tolist()
            servo = mav.servo_output_raw_encode(t % 2**32, 0, *pulses, *[0] * 8)
            add(t, servo)
        elif role == IMU:
            force = np.round(1000 * m.linear_acceleration / 9.80665).astype(int).tolist()
            gyro = np.round(1000 * m.angular_velocity).astype(int).tolist()
            add(t, mav.raw_imu_encode(t, *force, *gyro, 0, 0, 0))
        else:
            angles = quaternion_to_euler(m.orientation).tolist()
            add(t, mav.attitude_encode(ms, *angles, *m.angular.tolist()))
            v = (quaternion_to_matrix(m.orientation) @ m.linear).tolist()
            add(t, mav.local_position_ned_encode(ms, *m.position.tolist(), *v))
            add(t, station.attitude_encode(5 + ms, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0), station)
            status = [0, 0, 0, 0, round(1000 * VOLTAGE), 0, 0, 0, 0, 0, 0, 0, 0]
            add(t, mav.sys_status_encode(*status))
    path.write_bytes(bytes(data))
    return path


def quantised(offset=0):
    """What MAVLink makes of the numbers: milliseconds, mrad/s, thousandths of g."""

    def quantise(role, t, m):
        t += offset
        if role == ODOMETRY:
            return 1000 * round(t / 1000), m
        if role == IMU:
            return t, m._replace(
                angular_velocity=np.round(1000 * m.angular_velocity) / 1000,
                linear_acceleration=np.round(1000 * m.linear_acceleration / 9.80665) * 9.80665e-3,
            )
        return t, m

    return quantise


@pytest.mark.parametrize("offset", [0, 2**32 - 4_000_000])
def test_a_telemetry_log(tmp_path, dive, offset):
    """As the dataflash log; also where the 32 bits of the servos' clock run over."""
    path = telemetry(tmp_path / "dive.tlog", dive, offset)
    report = import_log(path, tmp_path / "log.mcap", configured(**GEOMETRY))
    assert report.wrench == sum(role == WRENCH for _, role, _ in dive)
    # The log's odometry takes the rates of the quantised gyro at its own, whole milliseconds.
    reference = expected(tmp_path / "direct.mcap", dive, quantised(offset))
    found = estimate(tmp_path / "log.mcap", config.load(HEAVY))
    assert found.stamp == reference.stamp
    assert np.all(np.abs(found.values - reference.values) < 0.3 * reference.std)


def test_rates_are_those_that_come_more_often(tmp_path, dive):
    """By default, RAW_IMU comes at 2 Hz, ATTITUDE with its rates at 10 Hz."""
    slow = [row for k, row in enumerate(dive) if row[1] != IMU or k % 50 == 0]
    path = telemetry(tmp_path / "slow.tlog", slow)
    report = import_log(path, tmp_path / "log.mcap", configured(**GEOMETRY))
    rates = [m.angular for _, role, m in dive if role == ODOMETRY]
    found = [m.angular for role, m in messages_in(tmp_path / "log.mcap") if role == ODOMETRY]
    assert report.odometry == len(rates)
    np.testing.assert_allclose(found, rates, atol=1e-6)


def test_no_rates_are_made_up_in_a_pause_of_the_imu(tmp_path, dive):
    """Half a second and more: as of the attitude."""
    paused = [row for row in rows_of(dive) if not (row[0] == 3 and 4_000_000 < row[1] < 6_000_000)]
    path = dataflash(tmp_path / "log.bin", paused)
    report = import_log(path, tmp_path / "log.mcap", configured(**GEOMETRY))
    stamps = [m.stamp for role, m in messages_in(tmp_path / "log.mcap") if role == ODOMETRY]
    assert not any(5_000_000_000 < stamp < 7_000_000_000 for stamp in stamps)
    lost = sum(role == ODOMETRY for _, role, _ in dive) - len(stamps)
    assert f"{lost} velocities without attitude or rates around them" in report.notes[-1]


def test_an_autopilot_that_starts_again(tmp_path, dive):
    """The dive after its restart is the longer one, and is not mixed with what was before."""
    first = telemetry(tmp_path / "first.tlog", dive[: len(dive) // 3]).read_bytes()
    path = telemetry(tmp_path / "dive.tlog", dive)
    settings = configured(**GEOMETRY)
    alone = import_log(path, tmp_path / "alone.mcap", settings)
    path.write_bytes(first + path.read_bytes())
    report = import_log(path, tmp_path / "log.mcap", settings)
    assert report.odometry == alone.odometry and report.duration == alone.duration
    assert any("the autopilot started 2 times" in note for note in report.notes)
    assert (tmp_path / "log.mcap").read_bytes() == (tmp_path / "alone.mcap").read_bytes()


def test_the_command(tmp_path, dive, capsys):
    config.dump(configured(**GEOMETRY), tmp_path / "c.yaml")
    path = str(dataflash(tmp_path / "log.BIN", rows_of(dive)))
    out, result = str(tmp_path / "log.mcap"), tmp_path / "log.json"
    command = ["import", path, "--config", str(tmp_path / "c.yaml"), "--out", out]
    for option in (
        ("--map", "u=x"), ("--body-frame", "flu"), ("--wrench-timing", "bin"),
        ("--mask-rates-above", "1"),
    ):  # fmt: skip
        assert main([*command, *option]) == 2
        assert f"{option[0]} is for a CSV alone" in capsys.readouterr().err
    assert main([*command, "--json", str(result)]) == 0
    assert '"odometry": ' in result.read_text()
    assert "odometry" in capsys.readouterr().err
    assert main(["import", path, "--out", out]) == 2
    assert "--config names the parameter file whose" in capsys.readouterr().err
    assert main(["import", path, path, "--config", "c", "--out", out]) == 2
    assert "one by one" in capsys.readouterr().err


def test_what_is_missing_is_named(tmp_path, dive):
    settings = configured(**GEOMETRY)
    rows = list(rows_of(dive))
    for kind, words in (
        (1, "no velocity of an EKF"),
        (4, "no thruster output"),
        (2, "no attitude"),
        (3, "no angular rates"),
    ):
        path = dataflash(tmp_path / "log.bin", [row for row in rows if row[0] != kind])
        with pytest.raises(UserError, match=words):
            import_log(path, tmp_path / "out.mcap", settings)
    with pytest.raises(UserError, match="thrusters has no allocation"):
        import_log(path, tmp_path / "out.mcap", config.load(HEAVY))
    unmeasured = dataflash(tmp_path / "log.bin", [row for row in rows if row[0] != 5])
    report = import_log(unmeasured, tmp_path / "out.mcap", settings)
    assert report.notes[0] == "no voltage of the battery: taken as 16 V (thrusters.voltage)"


@pytest.mark.parametrize(("flown_by", "speed"), [(None, 1.0), (3.0, 1.0), (2.0, 2.0)])
def test_two_filters_side_by_side(tmp_path, dive, flown_by, speed):
    """EKF2 here says twice the velocity of EKF3; the parameter tells which one flies."""
    formats = {**FORMATS, 7: ("NKF1", *FORMATS[1][1:]), 8: ("PARM", "QNf", "TimeUS,Name,Value")}
    rows = []
    for row in rows_of(dive):
        rows.append(row)
        if row[0] == 1 and row[2] == 0:
            rows.append((7, row[1] + 50, *row[2:6], *(2.0 * v for v in row[6:9]), *row[9:]))
    if flown_by:
        rows.append((8, 1, b"AHRS_EKF_TYPE", flown_by))
    path = dataflash(tmp_path / "log.bin", rows, formats)
    report = import_log(path, tmp_path / "log.mcap", configured(**GEOMETRY))
    true = [np.linalg.norm(m.linear) for _, role, m in dive if role == ODOMETRY]
    odometry = [m for role, m in messages_in(tmp_path / "log.mcap") if role == ODOMETRY]
    assert report.odometry == len(odometry) >= len(true) - 1
    found = [np.linalg.norm(m.linear) for m in odometry]
    np.testing.assert_allclose(found, speed * np.array(true[: len(found)]), atol=1e-5)


@pytest.mark.parametrize("odd", [9.5, 18.5])
def test_one_voltage_that_no_battery_has(tmp_path, dive, odd):
    """The one before goes on; a battery that always has it needs another curve."""
    rows, settings = list(rows_of(dive)), configured(**GEOMETRY)
    rows.insert(1000, (5, rows[1000][1], 0, odd, odd))
    report = import_log(dataflash(tmp_path / "l.bin", rows), tmp_path / "odd.mcap", settings)
    assert report.notes == (
        f"battery from {VOLTAGE} to {VOLTAGE} V, as measured",
        "the T200 has no curve for 1 of the voltages: the one before is taken",
    )
    import_log(dataflash(tmp_path / "l.bin", rows_of(dive)), tmp_path / "o.mcap", settings)
    wrenches = [
        [m for role, m in messages_in(tmp_path / name) if role == WRENCH]
        for name in ("odd.mcap", "o.mcap")
    ]
    np.testing.assert_equal(*wrenches)
    always = [*rows[:1], *((5, t, 0, odd, odd) for t in range(1, 5)), *rows[1:]]
    with pytest.raises(UserError, match=f"or the battery of a log, is {odd} V, but the curve"):
        import_log(dataflash(tmp_path / "l.bin", always), tmp_path / "x.mcap", settings)


def test_the_battery_that_is_measured(tmp_path, dive):
    """The first instance may be a monitor to which nothing is connected."""
    rows = [(*r[:3], *2 * [0.0 if r[2] == 0 else 14.0]) if r[0] == 5 else r for r in rows_of(dive)]
    report = import_log(
        dataflash(tmp_path / "log.bin", rows), tmp_path / "log.mcap", configured(**GEOMETRY)
    )
    assert report.notes == ("battery from 14.0 to 14.0 V, as measured",)


@pytest.mark.parametrize("name", ["log.bin", "log.tlog", "log.log"])
@pytest.mark.parametrize("data", [b"", b"\xa3\x95\x80", b"nothing of the kind" * 99, bytes(4000)])
def test_what_is_no_log_is_refused(tmp_path, capfd, name, data):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(UserError, match=r"is no log|holds no"):
        import_log(tmp_path / name, tmp_path / "out.mcap", configured(**GEOMETRY))
    assert capfd.readouterr() == ("", "")
    assert not (tmp_path / "out.mcap").exists()


def test_a_cut_log_is_read_to_its_end(tmp_path, dive):
    path = dataflash(tmp_path / "log.bin", rows_of(dive))
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2 + 5])
    report = import_log(path, tmp_path / "log.mcap", configured(**GEOMETRY))
    assert 4.0 < report.duration < 6.0


def test_pulses_that_are_none(tmp_path, dive):
    rows = [(4, row[1], *[3] * 14) if row[0] == 4 else row for row in rows_of(dive)]
    with pytest.raises(UserError, match="the thruster outputs hold a pulse that is none"):
        import_log(dataflash(tmp_path / "l.bin", rows), tmp_path / "o.mcap", configured(**GEOMETRY))


def test_an_odometry_in_the_bag_is_an_ordinary_one(tmp_path, dive):
    import_log(
        dataflash(tmp_path / "log.bin", rows_of(dive)), tmp_path / "b.mcap", configured(**GEOMETRY)
    )
    found = next(m for role, m in messages_in(tmp_path / "b.mcap") if role == ODOMETRY)
    assert isinstance(found, Odometry)
    assert (found.frame_id, found.child_frame_id) == ("world_ned", "base_link_frd")


@pytest.mark.parametrize(
    ("kind", "column", "value"), [(1, 6, 1e30), (2, 3, 0.0), (3, 3, 1e30), (1, 1, 1 << 63)]
)
def test_what_no_vehicle_does_is_left_out(tmp_path, dive, kind, column, value):
    """A velocity, a quaternion of zeros, a rate, a time: once, and what follows is read."""
    rows = [list(row) for row in rows_of(dive)]
    damaged = [row for row in rows if row[0] == kind and row[2] == 0][5]
    if kind == 2:
        damaged[3:7] = 4 * [value]
    else:
        damaged[column] = value
    path = dataflash(tmp_path / "log.bin", rows)
    report = import_log(path, tmp_path / "log.mcap", configured(**GEOMETRY))
    assert "left out" in report.notes[-1]
    whole = [role for _, role, _ in dive]
    assert report.odometry >= whole.count(ODOMETRY) - 3 and report.imu >= whole.count(IMU) - 1
    for role, message in messages_in(tmp_path / "log.mcap"):
        assert not fault(message), role


def test_a_log_of_zero_quaternions_is_refused(tmp_path, dive):
    rows = [[*row[:3], 0.0, 0.0, 0.0, 0.0] if row[0] == 2 else row for row in rows_of(dive)]
    with pytest.raises(UserError, match="holds no odometry"):
        import_log(
            dataflash(tmp_path / "log.bin", rows), tmp_path / "x.mcap", configured(**GEOMETRY)
        )
    assert not (tmp_path / "x.mcap").exists()


# ------------------------------------------------------------------ PX4

ULOG = {  # of each topic: its fields, and their layout behind the time, as PX4 1.15 writes them
    "vehicle_local_position": (
        "uint64_t timestamp_sample;float x;float y;float z;float[2] delta_xy;float delta_z;"
        "float vx;float vy;float vz;bool xy_valid;bool z_valid;bool v_xy_valid;bool v_z_valid;"
        "uint8_t xy_reset_counter;uint8_t z_reset_counter;uint8_t vxy_reset_counter;"
        "uint8_t vz_reset_counter;", "Q9f4?4B"),
    "vehicle_attitude": ("uint64_t timestamp_sample;float[4] q;", "Q4f"),
    "sensor_combined": ("float[3] gyro_rad;float[3] accelerometer_m_s2;", "6f"),
    "actuator_motors": ("uint64_t timestamp_sample;float[12] control;uint16_t reversible_flags;",
                        "Q12fH"),
    "battery_status": ("float voltage_v;", "f"),
    "vehicle_status": ("uint8_t arming_state;", "B"),
}  # fmt: skip
LATE = 2000  # us; EKF2 publishes after the sample that it is about


def ulog(
    path, dive, parameters, command=lambda pulses: (pulses - 1500) / 400.0, reversible=0xFF,
    place=lambda k: ((0.0, 0.0, 0.0), (0, 0, 0, 0)), without=(), tail=b"",
):  # fmt: skip
    """A log as PX4's logger writes it (docs.px4.io, "ULog File Format").

    ``place``: of the k-th position, what its resets have added, and their counters.
    """
    data = bytearray(b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0))
    number = {(name, 0): k for k, name in enumerate(ULOG)} | {("battery_status", 1): len(ULOG)}

    def add(kind, content):
        data.extend(struct.pack("<Hc", len(content), kind) + content)

    def say(topic, t, *values, instance=0):
        layout = struct.Struct("<HQ" + ULOG[topic][1])
        if topic not in without:
            add(b"D", layout.pack(number[topic, instance], t, *values))

    for name, (fields, _) in ULOG.items():
        add(b"F", f"{name}:uint64_t timestamp;{fields}".encode())
    for name, value in parameters.items():
        whole = isinstance(value, int)
        key = f"{'int32_t' if whole else 'float'} {name}".encode()
        add(b"P", bytes([len(key)]) + key + struct.pack("<i" if whole else "<f", value))
    for (name, instance), k in number.items():
        add(b"A", struct.pack("<BH", instance, k) + name.encode())
    say("battery_status", 0, 0.0)  # the first has no battery
    say("battery_status", 0, VOLTAGE, instance=1)
    say("vehicle_status", 0, 2)
    positions = 0
    for t, role, m in dive:
        if role == WRENCH:
            say("actuator_motors", t, t, *command(m), *[np.nan] * 4, reversible)
        elif role == IMU:
            say("sensor_combined", t, *m.angular_velocity, *m.linear_acceleration)
        else:
            shift, counters = place(positions)
            positions += 1
            v = quaternion_to_matrix(m.orientation) @ m.linear
            say("vehicle_attitude", t + LATE, t, *m.orientation)
            say("vehicle_local_position", t + LATE, t, *(m.position + shift), *shift, *v,
                True, True, True, True, *counters)  # fmt: skip
    path.write_bytes(bytes(data) + tail)
    return path


def rotors(turned=()):
    """The geometry that PX4's parameters have, some thrusters the other way."""
    found = {"CA_ROTOR_COUNT": len(DIRECTION)}
    for i in range(found["CA_ROTOR_COUNT"]):
        sign = -1.0 if i in turned else 1.0
        for k, axis in enumerate("XYZ"):
            found[f"CA_ROTOR{i}_P{axis}"] = float(POSITION[i][k])
            found[f"CA_ROTOR{i}_A{axis}"] = sign * float(DIRECTION[i][k])
    return found


def test_a_log_of_px4(tmp_path, dive):
    """The estimate of the dive itself, to the single precision of the log, of its geometry too."""
    path = ulog(tmp_path / "log.ulg", dive, rotors())
    report = import_log(path, tmp_path / "log.mcap", configured(**GEOMETRY))
    counts = {role: sum(own == role for _, own, _ in dive) for role in (ODOMETRY, IMU, WRENCH)}
    assert (report.odometry, report.imu, report.wrench) == tuple(counts.values())
    reference = expected(tmp_path / "direct.mcap", dive)
    assert_close(estimate(tmp_path / "log.mcap", config.load(HEAVY)), reference, 1e-4)
    turned = ulog(tmp_path / "turned.ulg", dive, rotors(turned=(0,)))
    report = import_log(turned, tmp_path / "turned.mcap", configured(**GEOMETRY))
    assert any("thruster 1 pushes the other way" in note for note in report.notes)


def outputs(low=1000, high=2000, reverse=0):
    """PX4's parameters of eight motors on outputs 8 to 1."""
    found = {"PWM_MAIN_REV": reverse}
    for k in range(1, 9):
        found |= {
            f"PWM_MAIN_FUNC{k}": 109 - k, f"PWM_MAIN_MIN{k}": low, f"PWM_MAIN_MAX{k}": high,
        }  # fmt: skip
    return found


def imported(tmp_path, path):
    report = import_log(path, tmp_path / f"{path.stem}.mcap", configured(**GEOMETRY))
    return report, estimate(tmp_path / f"{path.stem}.mcap", config.load(HEAVY))


@pytest.mark.parametrize("case", ["range", "curve", "one way", "reversed"])
def test_pulses_are_those_of_px4s_mixer(tmp_path, dive, case):
    """1000 to 2000 us as PX4 has it unless told; THR_MDL_FAC; motors of one way; PWM_MAIN_REV."""
    parameters, options = rotors() | outputs(), {}

    def half(pulses):
        return (pulses - 1500) / 500.0

    options["command"] = half
    if case == "curve":
        parameters["THR_MDL_FAC"] = 0.3
        options["command"] = lambda pulses: (
            np.sign(half(pulses)) * (0.3 * half(pulses) ** 2 + 0.7 * np.abs(half(pulses)))
        )
    elif case == "one way":
        options["command"] = lambda pulses: 0.5 * (half(pulses) + 1.0)
        options["reversible"] = 0
    elif case == "reversed":  # output 8, which is motor 1: its propeller is the other way round
        parameters = rotors(turned=(0,)) | outputs(reverse=0x80)
        options["command"] = lambda pulses: half(pulses) * [-1, *[1] * 7]
    path = ulog(tmp_path / "log.ulg", dive, parameters, **options)
    report, found = imported(tmp_path, path)
    assert report.notes == (
        f"battery from {VOLTAGE} to {VOLTAGE} V, as measured",
        "100 % of the log is armed; the rest is left out",
    )
    assert_close(found, expected(tmp_path / "direct.mcap", dive), 1e-3)


@pytest.mark.parametrize("parameters", [rotors(), {"CA_ROTOR_COUNT": 0}])
def test_a_motor_without_an_output_is_said(tmp_path, dive, parameters):
    """A count of zero is one that is not told."""
    path = ulog(tmp_path / "log.ulg", dive, parameters)
    report = import_log(path, tmp_path / "log.mcap", configured(**GEOMETRY))
    assert "no PWM outputs of the motors" in report.notes[0]


def test_positions_that_px4_sets_anew(tmp_path, dive):
    """They go on from where they were, and a velocity that jumps is said."""

    def place(k):
        again = int(k >= 40)
        return (3.0 * again, -2.0 * again, 0.5 * again), (again, again, again, 0)

    path = ulog(tmp_path / "log.ulg", dive, rotors() | outputs(1100, 1900), place=place)
    report, _ = imported(tmp_path, path)
    assert "EKF2 set its velocity anew 1 times: it jumps there without a force" in report.notes
    read = [m.position for role, m in messages_in(tmp_path / "log.mcap") if role == ODOMETRY]
    true = [m.position for _, role, m in dive if role == ODOMETRY]
    np.testing.assert_allclose(read, true, atol=1e-5)


def test_dropouts_and_a_cut_of_a_log_of_px4(tmp_path, dive):
    dropout = struct.pack("<HcH", 2, b"O", 1500)
    path = ulog(tmp_path / "log.ulg", dive, rotors() | outputs(), tail=dropout)
    report, _ = imported(tmp_path, path)
    assert "the logger lost 1.5 s in 1 dropouts" in report.notes
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    report, _ = imported(tmp_path, path)
    assert 4.0 < report.duration < 6.0


def test_what_a_log_of_px4_lacks_is_named_as_px4_does(tmp_path, dive):
    for topic, words in (
        ("vehicle_local_position", "no valid velocity of EKF2"),
        ("actuator_motors", r"actuator_motors.*SDLOG_PROFILE"),
        ("vehicle_attitude", "vehicle_attitude"),
        ("sensor_combined", "sensor_combined"),
    ):
        path = ulog(tmp_path / "log.ulg", dive, rotors(), without=(topic,))
        with pytest.raises(UserError, match=words):
            import_log(path, tmp_path / "out.mcap", configured(**GEOMETRY))


def test_what_is_no_log_of_px4(tmp_path):
    (tmp_path / "bad.ulg").write_bytes(b"ULog but not really")
    with pytest.raises(UserError, match=r"bad\.ulg is no log of PX4"):
        import_log(tmp_path / "bad.ulg", tmp_path / "bag.mcap", configured(**GEOMETRY))
