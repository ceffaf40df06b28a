"""Bags on real files: read back with the peers' readers, cut, damaged, killed."""

import contextlib
import os
import random
import resource
import signal
import struct
import subprocess
import sys
import textwrap
import time
import tracemalloc
from collections import Counter
from types import SimpleNamespace

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC, CompressionType
from mcap.writer import Writer as McapWriter
from mcap_ros2.decoder import DecoderFactory
from program import messages_in
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import Reader as RosbagsReader
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from rov_ident.config.schema import Topics
from rov_ident.core.errors import UserError
from rov_ident.core.messages import Imu, Odometry, Wrench
from rov_ident.io import bag_reader, cdr, topics
from rov_ident.io.bag_reader import Bag, _records
from rov_ident.io.bag_writer import BagWriter

STEP = 20_000_000  # ns


def odometry(stamp, x=0.0):
    level = np.array([1.0, 0.0, 0.0, 0.0])
    zero = np.zeros(3)
    return Odometry(stamp, "odom", "base_link", np.array([x, 0, 0]), level, zero, zero, np.zeros(6))


def imu(stamp):
    return Imu(stamp, "imu_link", np.array([1.0, 0, 0, 0]), *np.eye(3), np.zeros(3))


def wrench(stamp):
    return Wrench(stamp, "base_link", np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0]))


def entries(count, namespace=""):
    """(topic, type, stamp, data) of three topics, as a vehicle publishes them."""
    for k in range(count):
        stamp = 10**9 + k * STEP
        for name, type_name, message in (
            ("odom", cdr.ODOMETRY_TYPE, odometry(stamp, float(k))),
            ("imu/data", cdr.IMU_TYPE, imu(stamp + 1)),
            ("thruster_wrench", cdr.WRENCH_TYPE, wrench(stamp + 2)),
        ):
            yield f"{namespace}/{name}", type_name, message.stamp, cdr.encode(message)


def write(path, rows):
    with BagWriter(path) as writer:
        for row in rows:
            writer.write(*row)
    return path


def write_mcap(path, rows, **options):
    """The same by the mcap library, for the forms of file that BagWriter does not write."""
    with path.open("wb") as stream:
        writer = McapWriter(stream, **options)
        writer.start(profile="ros2")
        channels, schemas = {}, {}
        for topic, type_name, stamp, data in rows:
            if type_name not in schemas:
                schemas[type_name] = writer.register_schema(type_name, "ros2msg", b"")
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "cdr", schemas[type_name])
            writer.add_message(channels[topic], stamp, data, stamp)
        writer.finish()
    return path


@pytest.fixture(params=["dive.mcap", "dive"])
def bag_path(request, tmp_path):
    return write(tmp_path / request.param, entries(3000))


# --- round trips ----------------------------------------------------------------------------


def test_what_is_written_is_read(bag_path):
    bag = Bag(bag_path)
    assert {topic: tuple(info) for topic, info in bag.topics.items()} == {
        "/odom": (cdr.ODOMETRY_TYPE, 3000),
        "/imu/data": (cdr.IMU_TYPE, 3000),
        "/thruster_wrench": (cdr.WRENCH_TYPE, 3000),
    }
    assert [tuple(raw) for raw in bag.iter_raw()] == list(entries(3000))
    assert not bag.truncated
    assert bag.damage is None
    assert [raw.topic for raw in bag.iter_raw(["/imu/data"])] == ["/imu/data"] * 3000


def test_messages_come_decoded_with_their_role(bag_path):
    messages = list(messages_in(bag_path))
    assert [role for role, _ in messages[:4]] == ["odom", "imu", "wrench", "odom"]
    assert messages[3][1].position[0] == 1.0
    assert [type(m) for _, m in messages[:3]] == [Odometry, Imu, Wrench]
    chosen = {"odom": "/odom", "wrench": "/thruster_wrench"}
    without_imu = topics.messages(Bag(bag_path), chosen, topics.USUAL)
    assert [role for role, _ in without_imu] == ["odom", "wrench"] * 3000


def test_rosbags_reads_it(bag_path):
    reader = RosbagsReader(bag_path) if bag_path.is_dir() else AnyReader([bag_path])
    store = get_typestore(Stores.ROS2_JAZZY)
    with reader:
        assert reader.message_count == 9000
        rows = list(reader.messages())
        assert [(c.topic, c.msgtype, t, bytes(d)) for c, t, d in rows] == list(entries(3000))
        last = store.deserialize_cdr(rows[-3][2], cdr.ODOMETRY_TYPE)
        assert last.pose.pose.position.x == 2999.0


def test_mcap_ros2_support_reads_it_from_the_schema_text(bag_path):
    path = next(bag_path.glob("*.mcap")) if bag_path.is_dir() else bag_path
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        assert reader.get_header().library == "rov_ident"
        assert reader.get_header().profile == "ros2"
        decoded = list(reader.iter_decoded_messages())
    assert len(decoded) == 9000
    assert decoded[2].decoded_message.wrench.torque.z == 6.0
    assert decoded[-3].decoded_message.header.frame_id == "odom"


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_bag_by_rosbags(tmp_path, storage):
    store = get_typestore(Stores.ROS2_JAZZY)
    path = tmp_path / "dive"
    with RosbagsWriter(path, version=9, storage_plugin=storage) as writer:
        connections = {}
        for topic, type_name, stamp, data in entries(10):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_name, typestore=store)
            writer.write(connections[topic], stamp, data)
    (file,) = (p for p in path.iterdir() if p.suffix != ".yaml")
    for place in (path, file):
        bag = Bag(place)
        assert [tuple(raw) for raw in bag.iter_raw()] == list(entries(10))
        assert bag.damage is None and len(bag.sha256) == 64


@pytest.mark.parametrize(
    "options",
    [
        {"use_chunking": False},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE},
        {"use_statistics": False},
        {"repeat_channels": False},
        {"enable_crcs": False},
        {"chunk_size": 1000},
    ],
)
def test_every_form_of_mcap(tmp_path, options):
    path = write_mcap(tmp_path / "dive.mcap", entries(2000), **options)
    bag = Bag(path)
    assert bag.topics["/odom"].message_count == 2000
    assert [tuple(raw) for raw in bag.iter_raw()] == list(entries(2000))
    assert not bag.truncated


@pytest.mark.parametrize("chunking", [True, False])
def test_messages_come_in_order_of_log_time(tmp_path, chunking):
    rows = list(entries(3000))
    shuffled = rows.copy()
    random.Random(3).shuffle(shuffled)
    path = write_mcap(tmp_path / "dive.mcap", shuffled, chunk_size=100_000, use_chunking=chunking)
    assert [tuple(raw) for raw in Bag(path).iter_raw()] == rows


def test_messages_of_equal_time_keep_their_order(tmp_path):
    rows = [("/odom", cdr.ODOMETRY_TYPE, 5, cdr.encode(odometry(k))) for k in range(5000)]
    path = write_mcap(tmp_path / "dive.mcap", rows, chunk_size=50_000)
    assert [tuple(raw) for raw in Bag(path).iter_raw()] == rows


def test_a_directory_of_several_files(tmp_path):
    rows = list(entries(1200))
    directory = tmp_path / "dive"
    directory.mkdir()
    for k in range(12):
        write(directory / f"dive_{k}.mcap", rows[k * 300 : (k + 1) * 300])
    bag = Bag(directory)
    assert [tuple(raw) for raw in bag.iter_raw()] == rows
    assert bag.topics["/odom"].message_count == 1200


def test_a_part_that_a_power_cut_left_empty(tmp_path):
    rows = list(entries(200))
    (tmp_path / "dive").mkdir()
    write(tmp_path / "dive" / "dive_0.mcap", rows)
    (tmp_path / "dive" / "dive_1.mcap").write_bytes(b"")
    bag = Bag(tmp_path / "dive")
    assert [tuple(raw) for raw in bag.iter_raw()] == rows
    assert "killed" in bag.damage


def test_bytes_are_reproducible(tmp_path):
    first = write(tmp_path / "a.mcap", entries(500))
    time.sleep(0.01)
    second = write(tmp_path / "b.mcap", entries(500))
    assert first.read_bytes() == second.read_bytes()
    assert Bag(first).sha256 == Bag(second).sha256
    other = write(tmp_path / "c.mcap", entries(501))
    assert Bag(other).sha256 != Bag(first).sha256


def test_latched_topics_say_so(tmp_path):
    path = tmp_path / "dive"
    with BagWriter(path) as writer:
        writer.add_topic("/odom", cdr.ODOMETRY_TYPE, latched=True)
        writer.write("/odom", cdr.ODOMETRY_TYPE, 5, cdr.encode(odometry(5)))
        writer.write("/other", cdr.ODOMETRY_TYPE, 5, cdr.encode(odometry(5)))
    with RosbagsReader(path) as reader:
        profiles = {c.topic: c.ext.offered_qos_profiles for c in reader.connections}
    assert profiles["/odom"][0].durability.name == "TRANSIENT_LOCAL"
    assert profiles["/other"] == []


# --- damage ---------------------------------------------------------------------------------


@pytest.mark.parametrize("chunking", [True, False])
def test_a_file_cut_anywhere_gives_what_is_complete(tmp_path, chunking):
    rows = list(entries(2000))
    whole = write_mcap(
        tmp_path / "whole.mcap", rows, chunk_size=20_000, use_chunking=chunking
    ).read_bytes()
    cut = tmp_path / "cut.mcap"
    numbers = random.Random(7)
    for size in [*(numbers.randrange(len(whole) // 4, len(whole)) for _ in range(30)), -1]:
        cut.write_bytes(whole[:size])
        bag = Bag(cut)
        got = [tuple(raw) for raw in bag.iter_raw()]
        # Nothing is lost where only the summary at the end is cut.
        assert bag.truncated == (got != rows)
        assert got == rows[: len(got)]
        assert sum(info.message_count for info in bag.topics.values()) == len(got)
        # Of an evenly filled file the share that is read is about the share that is left.
        assert len(got) / len(rows) > size / len(whole) - 0.06


def test_zeros_left_by_a_power_cut_end_the_file(tmp_path):
    whole = write_mcap(tmp_path / "whole.mcap", entries(500), chunk_size=20_000).read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: len(whole) // 2] + bytes(100_000))
    bag = Bag(cut)
    assert bag.lost_bytes > 90_000
    assert "killed" in bag.damage
    assert sum(1 for _ in bag.iter_raw()) > 0


@pytest.mark.parametrize("summary", [True, False])
def test_a_damaged_chunk_is_passed_over(tmp_path, summary):
    rows = list(entries(2000))
    path = write_mcap(
        tmp_path / "dive.mcap", rows, chunk_size=50_000, compression=CompressionType.NONE
    )
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 0xFF  # within the messages of some chunk
    path.write_bytes(data if summary else data[:-1])
    bag = Bag(path)
    got = [tuple(raw) for raw in bag.iter_raw()]
    assert bag.damaged_chunks == 1
    assert "1 damaged" in bag.damage
    assert 0.9 * len(rows) < len(got) < len(rows)
    assert set(got) < set(rows)


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_a_decompression_bomb_is_passed_over(tmp_path, compression):
    """A chunk whose megabytes of zeros claim to be few, and one that claims to be endless."""
    rows = list(entries(500))
    path = write_mcap(tmp_path / "dive.mcap", rows, chunk_size=10_000, compression=compression)
    zeros = bytes(200_000_000)
    small = {
        CompressionType.ZSTD: zstandard.compress(zeros),
        CompressionType.LZ4: lz4.frame.compress(zeros),
    }[compression]
    del zeros
    name = compression.name.lower().encode()
    for claimed in (1000, 1 << 62):
        body = struct.pack("<QQQI", 0, 1, claimed, 0)
        body += struct.pack("<I", len(name)) + name + struct.pack("<Q", len(small)) + small
        bomb = struct.pack("<BQ", 6, len(body)) + body
        data = path.read_bytes()
        bag_path = tmp_path / "bomb.mcap"
        bag_path.write_bytes(data[:8] + bomb + data[8:-1])  # cut, so that it is walked through
        tracemalloc.start()
        bag = Bag(bag_path)
        got = [tuple(raw) for raw in bag.iter_raw()]
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert got == rows
        assert bag.damaged_chunks == 1
        assert peak < 20_000_000


@pytest.mark.parametrize("name", ["dive.mcap", "dive"])
def test_a_killed_recorder_leaves_a_readable_bag(tmp_path, name):
    path = tmp_path / name
    program = textwrap.dedent(
        f"""
        import time
        from rov_ident.io.bag_writer import BagWriter
        from test_bags import entries
        writer = BagWriter({str(path)!r})
        writer.go_live()
        begin = time.monotonic()
        for k, row in enumerate(entries(10**6)):
            writer.write(*row)
            if k == 300:
                time.sleep(1.1)
            elif k > 300:
                print(k, flush=True)
                time.sleep(0.001)
        """
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE, env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    for _ in range(50):
        process.stdout.readline()
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    process.stdout.close()
    bag = Bag(path)
    got = [tuple(raw) for raw in bag.iter_raw()]
    assert bag.truncated
    assert len(got) >= 300
    assert got == list(entries(1000))[: len(got)]


def test_undecodable_messages_are_counted(tmp_path):
    rows = list(entries(2))
    rows[1] = (*rows[1][:3], rows[1][3][:-20])
    bag, counts = Bag(write(tmp_path / "dive.mcap", rows)), Counter()
    messages = topics.messages(bag, topics.select(bag, topics.USUAL), topics.USUAL, counts)
    assert [role for role, _ in messages] == ["odom", "wrench", "odom", "imu", "wrench"]
    assert counts == {"imu: bytes that are no sensor_msgs/msg/Imu": 1}


# --- other formats ---------------------------------------------------------------------------


def write_ros1(path, rows):
    store, ros1 = get_typestore(Stores.ROS2_JAZZY), get_typestore(Stores.ROS1_NOETIC)
    with Ros1Writer(path) as writer:
        topics = {}
        for topic, kind, stamp, data in rows:
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=ros1)
            writer.write(topics[topic], stamp, bytes(store.cdr_to_ros1(data, kind)))
    return path


def test_a_bag_of_ros_1(tmp_path):
    rows = list(entries(40))
    path = write_ros1(tmp_path / "dive.bag", rows)
    bag = Bag(path)
    assert bag.topics == Bag(write(tmp_path / "dive.mcap", rows)).topics
    assert [raw[:3] for raw in bag.iter_raw()] == [row[:3] for row in rows]
    read = [cdr.encode(message) for _, message in messages_in(path)]
    assert read == [row[3] for row in rows]
    assert {m.topic for m in bag.iter_raw(["/imu/data"])} == {"/imu/data"}


def test_split_bags_of_ros_1_with_a_topic_in_the_first_alone(tmp_path):
    """As a latched /tf_static is: the second file does not know it."""
    rows, folder = list(entries(40)), tmp_path / "dive"
    folder.mkdir()
    write_ros1(folder / "dive_0.bag", rows[:60])
    write_ros1(folder / "dive_1.bag", [row for row in rows[60:] if row[0] != "/imu/data"])
    bag = Bag(folder)
    for topic in bag.topics:
        read = list(bag.iter_raw([topic]))
        assert {raw.topic for raw in read} == {topic}
        assert len(read) == bag.topics[topic].message_count
    assert not list(bag.iter_raw([]))


def from_ros1(path, kind, fields, *values):
    """What a bag of ROS 1 with one message, its header stamped 5 s and 6 ns, gives."""
    header, ros1 = "std_msgs/msg/Header", get_typestore(Stores.EMPTY)
    ros1.register({header: get_typestore(Stores.ROS1_NOETIC).fielddefs[header]})
    ros1.register(get_types_from_msg(f"std_msgs/Header header\n{fields}", kind))
    stamp = ros1.types["builtin_interfaces/msg/Time"](sec=5, nanosec=6)
    message = ros1.types[kind](ros1.types[header](seq=3, stamp=stamp, frame_id=""), *values)
    with Ros1Writer(path) as writer:
        topic = writer.add_connection("/topic", kind, typestore=ros1)
        writer.write(topic, 1, bytes(ros1.serialize_ros1(message, kind)))
    (raw,) = Bag(path).iter_raw()
    return raw.data


def test_types_of_ros_1_that_ros_2_does_not_ship(tmp_path):
    """As mavros publishes its outputs: the bag itself says what they are."""
    channels = np.array([1500, 1600], np.uint16)
    data = from_ros1(tmp_path / "rc.bag", "mavros_msgs/msg/RCOut", "uint16[] channels\n", channels)
    stamp, values = cdr.decode_channels(data)
    assert stamp == 5_000_000_006 and values.tolist() == [1500.0, 1600.0]


def test_a_type_that_had_other_fields_in_ros_1(tmp_path):
    """BatteryState had no temperature before Noetic."""
    fields = "float32 voltage\nfloat32 current\nfloat32[] cell_voltage\nstring location\n"
    values = 15.5, -3.0, np.full(4, 3.875, np.float32), "hull"
    data = from_ros1(tmp_path / "old.bag", "sensor_msgs/msg/BatteryState", fields, *values)
    assert cdr.decode_voltage(data) == 15.5


# --- wrong files ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "killed"),
        (b"t_s,u,v\n0,1,2\n", "not an MCAP"),
        (b"SQLite format 3\0....", "damaged"),
        (b"#ROSBAG V2.0\n", "damaged"),
        (b"\x89MCAP0\r\n", "killed"),
    ],
)
def test_a_file_that_is_no_bag(tmp_path, content, words):
    path = tmp_path / "dive.mcap"
    path.write_bytes(content)
    with pytest.raises(UserError, match=words) as caught:
        Bag(path)
    assert str(path) in str(caught.value)


def test_a_place_where_nothing_is(tmp_path):
    with pytest.raises(UserError, match=r"nowhere\.mcap cannot be read"):
        Bag(tmp_path / "nowhere.mcap")
    with pytest.raises(UserError, match=r"no \.mcap file"):
        Bag(tmp_path)


def test_a_bag_without_messages(tmp_path):
    path = tmp_path / "dive.mcap"
    with BagWriter(path) as writer:
        writer.add_topic("/odom", cdr.ODOMETRY_TYPE)
    with pytest.raises(UserError, match="no ROS 2 message"):
        Bag(path)


def test_bad_metadata(tmp_path):
    path = write(tmp_path / "dive", entries(3))
    metadata = path / "metadata.yaml"
    text = metadata.read_text()
    metadata.write_text(text.replace("compression_mode: ''", "compression_mode: FILE"))
    with pytest.raises(UserError, match="rosbags-convert --src .*dive --dst NEW"):
        Bag(path)
    metadata.write_text(text.replace("dive_0.mcap", "dive_1.mcap"))
    with pytest.raises(UserError, match=r"dive_1\.mcap cannot be read: it is not there.*remove"):
        Bag(path)
    metadata.write_text(text.replace("dive_0.mcap", "../other/dive_0.mcap"))
    with pytest.raises(UserError, match="outside the bag"):
        Bag(path)
    metadata.write_text("{")
    with pytest.raises(UserError, match="metadata"):
        Bag(path)
    metadata.unlink()
    assert sum(1 for _ in Bag(path).iter_raw()) == 9


# --- writing --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["dive.mcap", "dive"])
def test_an_exception_leaves_nothing_behind(tmp_path, name):
    with pytest.raises(TypeError):
        write(tmp_path / name, [*entries(1), None])
    assert list(tmp_path.iterdir()) == []


def test_the_old_file_stays_until_the_new_one_is_complete(tmp_path):
    path = write(tmp_path / "dive.mcap", entries(3))
    with BagWriter(path) as writer:
        writer.write(*next(entries(1)))
        assert sum(1 for _ in Bag(path).iter_raw()) == 9
    assert sum(1 for _ in Bag(path).iter_raw()) == 1


def test_places_that_cannot_be_written(tmp_path):
    write(tmp_path / "dive", entries(3))
    with pytest.raises(UserError, match="exists already"):
        BagWriter(tmp_path / "dive")
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be written"):
        BagWriter(tmp_path / "file" / "dive.mcap")


def test_an_unknown_type_is_refused(tmp_path):
    with (
        pytest.raises(UserError, match="no_msgs/msg/Nothing"),
        BagWriter(tmp_path / "dive.mcap") as writer,
    ):
        writer.write("/odom", "no_msgs/msg/Nothing", 1, b"")


# --- choice of topics -----------------------------------------------------------------------


def bag_of(tmp_path, **topics):
    types = {"odom": cdr.ODOMETRY_TYPE, "imu": cdr.IMU_TYPE, "wrench": cdr.WRENCH_TYPE}
    rows = [(topic, types[kind], 1, b"") for kind, names in topics.items() for topic in names]
    return Bag(write(tmp_path / "dive.mcap", rows))


def chosen(bag, roles=(), **names):
    """The topics by role, where the configuration has these names."""
    usual = SimpleNamespace(**vars(topics.USUAL) | {"topics": Topics(**names)})
    return topics.select(bag, usual, roles)


def test_topics_in_a_namespace_by_name_and_by_type(tmp_path):
    bag = bag_of(
        tmp_path,
        odom=["/rov/odom", "/rov/odom/filtered"],
        imu=["/rov/imu/data", "/rov/imu/raw"],
        wrench=["/rov/tau"],
    )
    assert chosen(bag) == {"odom": "/rov/odom", "imu": "/rov/imu/data", "wrench": "/rov/tau"}
    found = chosen(bag, odom="rov/odom/filtered")
    assert found["odom"] == "/rov/odom/filtered"
    assert found["imu"] == "/rov/imu/data"


def test_of_two_vehicles_the_one_whose_odometry_is_named(tmp_path):
    """And of two IMUs the vehicle's own; what else could have been chosen is said."""
    bag = bag_of(
        tmp_path,
        odom=["/rov1/odom", "/rov2/odom"],
        imu=["/rov1/imu/data", "/rov2/imu/data"],
        wrench=["/rov1/thruster_wrench", "/rov2/thruster_wrench"],
    )
    for name in ("/rov1", "/rov2"):
        found = chosen(bag, odom=f"{name}/odom")
        assert found["imu"] == f"{name}/imu/data"
        assert found["wrench"] == f"{name}/thruster_wrench"
    usual = SimpleNamespace(**vars(topics.USUAL) | {"topics": Topics(odom="/rov2/odom")})
    assert topics.doubts(bag, found, usual) == [
        "dive.mcap: imu is /rov2/imu/data; topics.imu chooses another of its type: /rov1/imu/data",
        "dive.mcap: wrench is /rov2/thruster_wrench; topics.wrench chooses another of its type: "
        "/rov1/thruster_wrench",
    ]


def test_numbers_of_one_vehicle_beside_the_thrust_of_another(tmp_path):
    """Arrays that are not of thrusters are passed over, whoever publishes them."""
    at, numbers = 10**12, "std_msgs/msg/Float64MultiArray"
    array = b"\0\1\0\0" + bytes(12)  # no dimension, no offset, no number
    rows = [
        ("/rov1/odom", cdr.ODOMETRY_TYPE, at, cdr.encode(odometry(at))),
        ("/rov1/gains", numbers, at, array),
        ("/rov2/thrust", numbers, at, array),
    ]
    seen, _ = topics.survey(Bag(write(tmp_path / "dive.mcap", rows)))
    assert seen["wrench"].topic == "/rov2/thrust"


@pytest.mark.parametrize("ahead", [0.5, -3.0, 1.7e9])
def test_topics_of_different_clocks_are_named(tmp_path, ahead):
    at, off = 10**12, round(ahead * 1e9)
    rows = [
        ("/odom", cdr.ODOMETRY_TYPE, at, cdr.encode(odometry(at))),
        ("/thruster_wrench", cdr.WRENCH_TYPE, at + 1, cdr.encode(wrench(at + off))),
    ]
    bag = Bag(write(tmp_path / "dive.mcap", rows))
    said = topics.doubts(bag, chosen(bag), topics.USUAL)
    assert bool(said) == (abs(ahead) > 1.0)
    if said:
        order = "after" if ahead > 0 else "before"
        assert f"/thruster_wrench is stamped {abs(ahead):.3g} s {order} /odom" in said[0]


def test_imu_may_be_absent(tmp_path):
    assert "imu" not in chosen(bag_of(tmp_path, odom=["/odom"], wrench=["/w"]))


@pytest.mark.parametrize(
    ("has", "names", "words"),
    [
        ({"odom": ["/odom"]}, {}, "no thruster_wrench topic.*/odom"),
        ({"wrench": ["/thruster_wrench"]}, {}, "no odom topic"),
        ({"odom": ["/a/odom", "/b/odom"], "wrench": ["/w"]}, {}, "several.*/a/odom, /b/odom"),
        ({"odom": ["/o"], "wrench": ["/v", "/w"]}, {}, "several.*/v, /w"),
        ({"wrench": ["/odom", "/w"]}, {}, "/odom in .* is geometry_msgs/msg/WrenchStamped"),
        ({"odom": ["/o"], "wrench": ["/w"]}, {"odom": "/x"}, "no messages on /x"),
        ({"odom": ["/o"], "wrench": ["/w"]}, {"odom": "/w"}, "/w in .* is geometry_msgs"),
    ],
)
def test_a_choice_that_cannot_be_made(tmp_path, has, names, words):
    bag = bag_of(tmp_path, **has)
    with pytest.raises(UserError, match=words):
        chosen(bag, **names)


def test_a_damaged_schema_or_channel_outside_chunks_is_passed_over(tmp_path):
    """Each of its bytes in turn, and its length: what is left is read, or refused in words."""
    path = tmp_path / "dive.mcap"
    write_mcap(path, entries(20), use_chunking=False)
    data = path.read_bytes()[: -len(MCAP0_MAGIC)]  # no summary: the walk
    records = [r for r in _records(data, len(MCAP0_MAGIC)) if r[0] in (3, 4)][:6]
    for _, _, body, end in records:
        for at in range(body, min(end, body + 40)):
            for value in (0, 255):
                path.write_bytes(data[:at] + bytes([value]) + data[at + 1 :])
                with contextlib.suppress(UserError):
                    for raw in Bag(path).iter_raw():
                        assert raw.topic


def test_a_complete_bag_is_not_walked_through(tmp_path):
    """Its summary says where everything is: a damaged chunk is met when it is read."""
    path = tmp_path / "dive.mcap"
    write(path, entries(20))
    data = path.read_bytes()
    chunk = next(r for r in _records(data, len(MCAP0_MAGIC)) if r[0] == 6)
    path.write_bytes(data[: chunk[3] - 1] + bytes([data[chunk[3] - 1] ^ 255]) + data[chunk[3] :])
    bag = Bag(path)
    assert bag.topics["/odom"].message_count == 20 and bag.damaged_chunks == 0
    assert not list(bag.iter_raw()) and bag.damaged_chunks == 1


def test_numbers_in_names_may_be_of_any_script(tmp_path):
    (tmp_path / "bag").mkdir()
    for name in ("²0a", "٣", "dive_10", "dive_2"):
        write(tmp_path / "bag" / f"{name}.mcap", entries(5))
    assert Bag(tmp_path / "bag").topics["/odom"].message_count > 0


def test_a_bag_of_more_files_than_may_be_open(tmp_path):
    (tmp_path / "bag").mkdir()
    for k in range(40):
        write(tmp_path / "bag" / f"dive_{k}.mcap", entries(1))
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    used = len(os.listdir("/proc/self/fd"))
    resource.setrlimit(resource.RLIMIT_NOFILE, (used + 10, before[1]))
    try:
        bag = Bag(tmp_path / "bag")
        assert sum(1 for _ in bag.iter_raw()) == sum(t.message_count for t in bag.topics.values())
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


def test_chunks_that_overlap_in_time_are_bounded(tmp_path, monkeypatch):
    rows = [(topic, kind, STEP, data) for topic, kind, _, data in entries(200)]
    path = write_mcap(tmp_path / "dive.mcap", rows, chunk_size=500)
    assert sum(1 for _ in Bag(path).iter_raw()) == len(rows)
    monkeypatch.setattr(bag_reader, "LARGEST_OVERLAP", 10_000)
    with pytest.raises(UserError, match="out of order: bring it in order"):
        list(Bag(path).iter_raw())


def test_a_bag_of_many_topics_is_refused_in_a_sentence(tmp_path):
    rows = [(f"/topic_{k}", cdr.WRENCH_TYPE, STEP, cdr.encode(wrench(STEP))) for k in range(2_000)]
    path = write_mcap(tmp_path / "dive.mcap", rows)
    for names in ({}, {"wrench": "/none"}, {"odom": "/topic_1"}):
        with pytest.raises(UserError) as refusal:
            chosen(Bag(path), ["wrench", "odom"], **names)
        assert len(str(refusal.value)) <= 2_000


def test_sixty_thousand_topics(tmp_path, heavy):
    """Listed in one go, and not all named in the sentence that refuses them."""
    rows = ((f"/t{k}", "std_msgs/msg/String", k, b"\0\1\0\0\1\0\0\0\0") for k in range(60_000))
    bag = Bag(write_mcap(tmp_path / "many.mcap", rows))
    assert len(bag.topics) == 60_000
    with pytest.raises(UserError, match="has no odom topic") as refused:
        topics.select(bag, heavy)
    assert len(str(refused.value)) <= 2000
