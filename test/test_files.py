"""Where results may be written, that they are whole or not there, and what YAML is taken."""

import os
import shutil
import subprocess
import threading
from pathlib import Path

import pytest
from test_inputs import GEOMETRY, configured

from bench import ROOT
from rov_ident import config as configuration
from rov_ident.api.comparison import compare
from rov_ident.cli import common, main
from rov_ident.consumer.formats import import_model
from rov_ident.core import yaml_file
from rov_ident.core.errors import UserError
from rov_ident.core.files import check_output, part_of, write_file
from rov_ident.io.ardupilot_log import import_log
from rov_ident.io.bag_reader import Bag
from rov_ident.io.bag_writer import BagWriter
from rov_ident.io.csv_log import import_csv, parse_columns
from rov_ident.steering import zigzag

DEMO, HEAVY = ROOT / "bags/demo.mcap", ROOT / "bench/bluerov2_heavy_known.yaml"


# ------------------------------------------------------------------ writing


def test_a_file_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "new" / "result.json"
    write_file(path, "first")
    write_file(path, "second, ψ")
    assert path.read_text("utf-8") == "second, ψ"
    write_file(tmp_path / "new" / ("n" * 255), b"\0")  # the part's name is no longer than its own

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(UserError, match=r"result\.json cannot be written: No space left on"):
        write_file(path, "third")
    assert path.read_text("utf-8") == "second, ψ"
    assert sorted(p.name for p in path.parent.iterdir()) == ["n" * 255, "result.json"]


def test_two_who_write_at_once_do_not_mix(tmp_path):
    path = tmp_path / "result"
    contents = [bytes([k]) * 300_000 for k in range(8)]
    threads = [threading.Thread(target=write_file, args=(path, c)) for c in contents]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert path.read_bytes() in contents
    assert [*tmp_path.iterdir()] == [path]


def test_what_a_killed_process_has_left_goes(tmp_path):
    """And nothing of one that is still at work, or of another file."""
    gone = subprocess.Popen(["true"])
    gone.wait()
    mine = part_of(tmp_path / "result")
    left = Path(str(mine).replace(f".{os.getpid()}.", f".{gone.pid}."))
    other = Path(str(part_of(tmp_path / "other")).replace(f".{os.getpid()}.", f".{gone.pid}."))
    for path in (mine, left, other):
        path.write_text("unfinished")
    write_file(tmp_path / "result", "whole")
    assert {*tmp_path.iterdir()} == {tmp_path / "result", mine, other}


def test_a_link_stays_a_link(tmp_path):
    (tmp_path / "target").write_text("old")
    (tmp_path / "link").symlink_to("target")
    write_file(tmp_path / "link", "new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "target").read_text() == "new"


# ------------------------------------------------------------------ where


@pytest.fixture
def places(tmp_path):
    """What may lie where a result is to be written, each by its name."""
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("in the way")
    shutil.copy(DEMO, tmp_path / "dive.mcap")
    shutil.copy(DEMO, tmp_path / "renamed.json")
    (tmp_path / "link").symlink_to("dive.mcap")
    (tmp_path / "loop").symlink_to("loop")
    os.link(tmp_path / "dive.mcap", tmp_path / "hard")
    for name in ("recorded", "other"):  # the second is no input
        with BagWriter(tmp_path / name) as writer:
            writer.write("/x", "std_msgs/msg/Empty", 1, b"\0\1\0\0\0")
    return tmp_path


REFUSED = {
    "fifo": "a device, a pipe or a socket",
    "folder": "it is a folder",
    "file/result": "is not a folder|Not a directory",
    "link": "would replace what it is made from",
    "hard": "would replace what it is made from",
    "dive.mcap": "would replace what it is made from",
    "renamed.json": "there is a bag",
    "recorded": "would replace what it is made from",
    "recorded/result": "lies within the bag",
    "recorded/new/result": "lies within the bag",
    "recorded/../recorded/metadata.yaml": "lies within the bag",
    "other/metadata.yaml": "lies within a bag",
    "other/result": "lies within a bag",
    "loop": "Too many levels of symbolic links",
    "a\0b": "no file can have that name",
    "x" * 256: "longer than 255 bytes",
    "none/" + "ψ" * 128: "longer than 255 bytes",
    "/dev/null": "a device, a pipe or a socket",
    "/": "it is a folder",
    ".": "it is a folder",
    "": "it is a folder",
    "..": "it is a folder",
    "~nosuchuser/x": "the shell knows no folder ~nosuchuser",
    "/proc/none/x": "/proc takes no files",
}


@pytest.mark.parametrize("name", REFUSED)
def test_places_that_are_refused(places, name):
    path = name if name in ("", ".", "..", "~nosuchuser/x") else places / name
    inputs = [places / "dive.mcap", places / "recorded", None]
    before = {p: p.stat().st_mtime_ns for p in places.iterdir() if p.exists()}

    with pytest.raises(UserError, match=REFUSED[name]) as refusal:
        check_output(path, inputs)
    assert "\n" not in str(refusal.value) and len(str(refusal.value)) < 500
    assert {p: p.stat().st_mtime_ns for p in places.iterdir() if p.exists()} == before


def test_places_that_are_not(places):
    inputs = [places / "dive.mcap", places / "recorded"]
    for name in ("new", "new/new", "file", "~", "folder/new", "folder/../new"):
        check_output(places / name, inputs)
    check_output(places / "dive.mcap", [], bag=True)
    check_output(places / "link", [], bag=True)
    assert not (places / "new").exists()


def test_a_folder_that_is_not_ours(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may write anywhere
    with pytest.raises(UserError, match="is not yours to write in"):
        check_output(tmp_path / "new" / "result")


COMMANDS = {
    "check": ([DEMO, "--config", HEAVY], ["--json", "--report"]),
    "fit": ([DEMO, "--config", HEAVY, "--estimator", "rls"], ["--json", "--save", "--report"]),
    "replay": ([DEMO, "--config", HEAVY], ["--json", "--out"]),
    "plan": (["--bag", DEMO, "--config", HEAVY], ["--json", "--report", "--out"]),
    "simulate": (["--bag", DEMO, "--config", HEAVY, "--out", "new.mcap"], ["--json", "--out"]),
    "nomoto": ([DEMO], ["--json", "--report"]),
    "forces": ([DEMO, "--config", HEAVY], ["--json", "--report", "--out"]),
    "import": ([DEMO, "--out", "new.mcap"], ["--json", "--out"]),
    "import-model": ([DEMO, "--out", "new.yaml"], ["--json", "--out"]),
    "export": (["--config", DEMO, "--format", "mss", "--out", "new.m"], ["--json", "--out"]),
    "steer": (["--config", DEMO, "--manoeuvre", "turn", "--out", "new.csv"], ["--json", "--out"]),
    "coefficients": ([], ["--json"]),
}


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_refuses_before_any_work(command, places, capsys, monkeypatch):
    monkeypatch.chdir(places)
    arguments, outputs = COMMANDS[command]
    mine = places / "mine.mcap"
    shutil.copy(DEMO, mine)
    arguments = [str(mine) if word is DEMO else str(word) for word in arguments]
    before = mine.read_bytes()
    for option in outputs:
        for path in ("fifo", "/dev/null", ".", "", "/", "a\0b", "~nosuchuser/x", "x" * 300, mine):
            assert main([command, *arguments, option, str(path)]) == 2
            said = capsys.readouterr()
            assert said.out == ""
            assert "cannot be written" in said.err and said.err.count("\n") == 1
    assert mine.read_bytes() == before


def test_results_do_not_replace_one_another(places, capsys):
    out = str(places / "new")
    arguments = [str(DEMO), "--config", str(HEAVY), "--json", out, "--report", out]
    assert main(["check", *arguments]) == 2
    assert "choose another name" in capsys.readouterr().err
    assert main(["check", "a\0b", "--config", str(HEAVY)]) == 2
    assert "cannot be read" in capsys.readouterr().err


def test_a_recording_that_never_begins_leaves_the_old_one(places):
    before = (places / "dive.mcap").read_bytes()
    with (
        pytest.raises(UserError, match="Nothing is not a message type"),
        BagWriter(places / "dive.mcap") as writer,
    ):
        writer.add_topic("/x", "no_msgs/msg/Nothing")
    assert (places / "dive.mcap").read_bytes() == before
    assert not [*places.glob(".*")]


# ------------------------------------------------------------------ YAML


def bomb():
    lines = ["a0: &a0 [lol, lol, lol, lol, lol, lol, lol, lol, lol]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 30)]
    return "\n".join(lines)


UNSAFE = {
    bomb(): "there is an anchor",
    "a: &x 1": "there is an anchor",
    "a: *x": "there is an anchor",
    "a: " + "[" * 33 + "]" * 33: "nested deeper than 32 levels",
    "[" * 100_000: "nested deeper than 32 levels",
    "{a: " * 50 + "}" * 50: "nested deeper than 32 levels",
    "a: " + "9" * 5000: "more than 100 digits",
    "a: 0x" + "f" * 5000: "more than 100 digits",
    "a: 18446744073709551617": "beyond 64 bits",
    "a: 0x_": "invalid literal",
    "a: 2024-01-01": "there is a date",
    "a: 2024-01-01 10:00:00": "there is a date",
    "a: !!binary aGk=": "there is a tag",
    "a: !!set {x}": "there is a tag",
    "a: !!int ''": "there is a tag",
    "a: !!python/object/apply:os.system [ls]": "there is a tag",
    "<<: {a: 1}\na: 2": "has a meaning of its own",
    "a: =": "has a meaning of its own",
    "a: 1\na: 2": "the key a is given twice",
    "? [1]\n: 2": "a key is a list",
    "a: \x00": "#x0000",
    "a: 1\n---\na: 2": "found another document",
    "a: '" + "x" * (1 << 20) + "'": "larger than 1 MiB",
}


@pytest.mark.parametrize("text", UNSAFE, ids=range(len(UNSAFE)))
def test_yaml_that_is_refused(tmp_path, text):
    path = tmp_path / "file.yaml"
    path.write_text(text)
    with pytest.raises(UserError, match=UNSAFE[text]) as refusal:
        yaml_file.parse_file(path)
    assert "\n" not in str(refusal.value) and len(str(refusal.value)) < 200


def test_the_bomb_is_small_and_refused_wherever_yaml_is_read(tmp_path, capsys):
    path = tmp_path / "bomb.yaml"
    path.write_text(bomb())
    assert path.stat().st_size < 2048
    assert main(["check", str(DEMO), "--config", str(path)]) == 2
    assert "anchor" in capsys.readouterr().err
    assert main(["import-model", str(path), "--out", str(tmp_path / "new.yaml")]) == 2
    assert "anchor" in capsys.readouterr().err
    with pytest.raises(UserError, match="anchor"):
        parse_columns([str(path)])
    (tmp_path / "bag").mkdir()
    path.rename(tmp_path / "bag" / "metadata.yaml")
    with pytest.raises(UserError, match="is not the metadata of a rosbag2 bag"):
        Bag(tmp_path / "bag")


def test_yaml_that_is_taken():
    text = "a: [1, -2.5, 1e-3, true, null, ! 'x', 'two: words', 18446744073709551615]\nb: {c: {}}"
    numbers = [1, -2.5, 1e-3, True, None, "x", "two: words", (1 << 64) - 1]
    assert yaml_file.parse(text) == {"a": numbers, "b": {"c": {}}}
    assert yaml_file.parse("") is None


READERS = {
    "yaml": lambda path: configuration.load(path),
    "bag": Bag,
    "csv": lambda path: import_csv([path], path.with_name("out.mcap")),
    "bin": lambda path: import_log(path, path.with_name("out.mcap"), configured(**GEOMETRY)),
    "tlog": lambda path: import_log(path, path.with_name("out.mcap"), configured(**GEOMETRY)),
    "zigzag": zigzag.read,
    "model": import_model,
    "json": lambda path: compare(path, path),
}


@pytest.mark.parametrize("kind", READERS)
def test_a_pipe_or_device_is_not_waited_for(tmp_path, kind):
    pipe = tmp_path / f"input.{kind}"
    os.mkfifo(pipe)
    endless = tmp_path / f"endless.{kind}"
    endless.symlink_to("/dev/zero")
    for path in (pipe, endless):
        with pytest.raises(UserError, match="it is a pipe or a device"):
            READERS[kind](path)
    for path in (tmp_path, Path("a\0b")):
        with pytest.raises(UserError):
            READERS[kind](path)


def test_names_do_not_reach_the_terminal_as_they_are(capsys):
    assert main(["check", "\x1b[2Ja\nb\x9b\u202e\udc80", "--config", str(HEAVY)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and r"\x1b[2Ja\nb\x9b\u202e\udc80" in said
    common.OUT.print("a\x1bb\nc")
    assert capsys.readouterr().out == "a\\x1bb\nc\n"
