"""Recordings whose writer was killed, or had no room: what is complete is read, the loss told."""

import os
import random
import resource
import shutil
import signal
import struct
import subprocess
import sys
import time

import pytest
import zstandard
from program import run

from bench import DEMO
from rov_ident.core.errors import UserError
from rov_ident.io.bag_reader import Bag
from rov_ident.io.bag_writer import BagWriter

pytestmark = pytest.mark.usefixtures("compiled")

PROGRAM = [sys.executable, "-m", "rov_ident"]


def complete(path):
    """Log times of the messages in whole chunks: a walk of our own through the file."""
    data = path.read_bytes()
    assert data.startswith(b"\x89MCAP0\r\n")
    at, times = 8, []
    while at + 9 <= len(data):
        opcode, size = struct.unpack_from("<BQ", data, at)
        at += 9
        if at + size > len(data):
            break
        if opcode == 0x06:  # chunk: start, end, size, crc, compression, records
            (length,) = struct.unpack_from("<I", data, at + 28)
            assert data[at + 32 : at + 32 + length] == b"zstd"
            begin = at + 32 + length + 8
            records = (
                zstandard.ZstdDecompressor().decompressobj().decompress(data[begin : at + size])
            )
            place = 0
            while place < len(records):
                inner, inner_size = struct.unpack_from("<BQ", records, place)
                if inner == 0x05:
                    times.append(struct.unpack_from("<Q", records, place + 9 + 6)[0])
                place += 9 + inner_size
        at += size
    return times


def test_a_replay_killed_while_recording(domain, heavy_path, tmp_path):
    """kill -9 of the recorder at a random time: all chunks are read again, and checks go on."""
    out = tmp_path / "recorded.mcap"
    command = [*PROGRAM, "replay", DEMO, "--config", heavy_path, "--out", out, "--rate", "4"]
    process = subprocess.Popen(
        list(map(str, command)), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    end = time.monotonic() + 300.0
    while not out.exists() or out.stat().st_size < 20_000:
        assert process.poll() is None and time.monotonic() < end
        time.sleep(0.05)
    time.sleep(random.Random(os.getpid()).uniform(0.0, 1.0))
    process.kill()
    process.wait()
    whole = complete(out)
    bag = Bag(out)
    assert sorted(whole) == [raw.log_time for raw in bag.iter_raw()]
    assert len(whole) > 100
    assert bag.truncated and bag.lost_bytes > 0
    assert "its writer was killed" in bag.damage


def test_a_cut_bag_is_used_and_the_loss_told(heavy_path, tmp_path):
    """`check` and `fit` read what is there, and say how much is not, in bytes and seconds."""
    data = DEMO.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: int(0.8 * len(data))])
    lost = Bag(cut).lost_bytes
    assert 0 < lost < 0.1 * len(data)
    for command in (
        ["check", cut, "--config", heavy_path],
        ["fit", cut, "--config", heavy_path, "--estimator", "rls", "--json", tmp_path / "fit.json"],
    ):
        done = run(*command)
        said = " ".join((done.stdout + done.stderr).split())
        assert done.returncode == 0, said
        assert f"its writer was killed, the last {lost} bytes" in said


def test_the_disk_is_full_while_recording(tmp_path):
    """What was written before stays readable, and the user is told; another bag is not touched."""
    before = tmp_path / "before.mcap"
    shutil.copy(DEMO, before)
    there = before.read_bytes()
    rows = [(r.topic, r.type_name, r.log_time, r.data) for r in Bag(DEMO).iter_raw()][:20_000]

    def record(path, live):
        with BagWriter(path) as writer:
            if live:
                writer.go_live()
            writer._flushed = -1e9
            for row in rows:
                writer.write(*row)
                writer._flushed = min(writer._flushed, time.monotonic() - 0.99)

    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    live = tmp_path / "live.mcap"
    resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, limits[1]))
    try:
        with pytest.raises(UserError, match="File too large"):
            record(live, live=True)
        with pytest.raises(UserError, match="File too large"):
            record(before, live=False)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert before.read_bytes() == there
    got = [raw.log_time for raw in Bag(live).iter_raw()]
    assert len(got) > 100
    assert got == [row[2] for row in rows[: len(got)]]
    assert {path.name for path in tmp_path.iterdir()} == {"before.mcap", "live.mcap"}


def test_the_disk_is_full_in_a_replay(domain, heavy_path, tmp_path):
    """The replay says so in one sentence, ends its nodes and leaves with status 2."""
    out = tmp_path / "recorded.mcap"
    command = [*PROGRAM, "replay", DEMO, "--config", heavy_path, "--out", out, "--rate", "0"]

    def no_room():
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, resource.RLIM_INFINITY))

    done = subprocess.run(
        list(map(str, command)), capture_output=True, text=True, timeout=600, preexec_fn=no_room
    )
    assert done.returncode == 2, done.stderr
    assert "File too large" in done.stderr
    assert "Traceback" not in done.stderr
    assert sum(1 for _ in Bag(out).iter_raw()) > 0
    assert signal.SIGKILL  # the nodes are gone with it: see test_replay.py
