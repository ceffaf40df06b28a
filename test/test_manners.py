"""What every command does alike: quiet, progress, machine-readable results, completion."""

import asyncio
import io
import json
import os
import pty
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from browser import CHROMIUM, chromium
from program import few_manoeuvres
from rich.console import Console

import rov_ident as ri
from bench import HEAVY
from rov_ident.cli import program as cli
from rov_ident.cli.program import main
from rov_ident.reports import html, plots
from rov_ident.reports.table import Table

pytestmark = pytest.mark.usefixtures("compiled")

SHIPPED = Path(__file__).parent.parent
COMMANDS = cli._commands(cli._parser())


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_can_be_quiet_and_says_what_it_does(name):
    text = COMMANDS[name].format_help()
    assert "--quiet" in text
    for action in COMMANDS[name]._actions:
        assert action.help, f"{name} {action.dest}"


def on_a_terminal(*arguments):
    """(status, standard output, standard error) of the program, its standard error a terminal."""
    ours, theirs = pty.openpty()
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "100"}
    process = subprocess.Popen(
        [sys.executable, "-m", "rov_ident", *map(str, arguments)],
        stdout=subprocess.PIPE, stderr=theirs, stdin=subprocess.DEVNULL, env=environment,
    )  # fmt: skip
    os.close(theirs)
    said = bytearray()
    try:
        while piece := os.read(ours, 4096):
            said += piece
    except OSError:  # the other end is closed
        pass
    os.close(ours)
    out, _ = process.communicate(timeout=600)
    return process.returncode, out.decode(), said.decode()


def test_progress_is_shown_where_somebody_looks(tmp_path):
    command = ["simulate", "--config", HEAVY, "--manoeuvre", "steps", "--duration", "20"]
    command += ["--out", tmp_path / "a.mcap"]
    status, out, said = on_a_terminal(*command)
    assert (status, out) == (0, "")
    assert "simulating" in said
    status, _, said = on_a_terminal(*command, "--quiet")
    assert status == 0
    assert "simulating" not in said
    assert "messages, 20 s" in said


def test_results_as_json(tmp_path, capsys):
    """Of the commands whose result is small; the others write a file of their own."""
    bag = tmp_path / "dive.mcap"
    model = tmp_path / "model.sdf"
    results = {}
    for name, arguments in {
        "simulate": ["--config", HEAVY, "--manoeuvre", "steps", "--duration", "5", "--out", bag],
        "export": ["--config", HEAVY, "--format", "gazebo", "--out", model],
        "import-model": [model, "--out", tmp_path / "c.yaml"],
        "coefficients": [],
        "steer": [
            "--config", SHIPPED / "config" / "remus100.yaml", "--manoeuvre", "zigzag",
            "--duration", "20", "--out", tmp_path / "z.csv",
        ],
    }.items():  # fmt: skip
        path = tmp_path / f"{name}.json"
        assert main([name, *map(str, arguments), "--json", str(path)]) == 0
        results[name] = json.loads(path.read_text())
    assert results["simulate"]["duration_s"] == 5.0
    assert results["export"]["format"] == "gazebo"
    assert results["import-model"]["name"] == "bluerov2_heavy"
    assert results["coefficients"]["X_u"]["unit"] == "N s/m"
    assert results["steer"]["manoeuvre"] == "zigzag"
    capsys.readouterr()

    out = str(tmp_path / "open_loop.mcap")
    path = tmp_path / "compared.json"
    command = ["simulate", "--config", str(HEAVY), "--bag", str(bag), "--out", out]
    assert main([*command, "--channels", "surge,yaw", "--json", str(path)]) == 0
    compared = json.loads(path.read_text())
    assert list(compared["velocities"]) == ["u", "r"]
    assert compared["velocities"]["u"]["r2"] > 0.99


def test_pages_of_check_and_plan(tmp_path, capsys, monkeypatch):
    """Whole, self-contained, and with every axis in it."""
    few_manoeuvres(monkeypatch)
    bag = tmp_path / "dive.mcap"
    simulate = ["simulate", "--config", str(HEAVY), "--manoeuvre", "steps", "--duration", "20"]
    assert main([*simulate, "--out", str(bag)]) == 0
    page = tmp_path / "check.html"
    assert main(["check", str(bag), "--config", str(HEAVY), "--report", str(page)]) == 0
    text = page.read_text()
    assert "Check of dive.mcap for bluerov2_heavy" in text
    assert text.count("<svg") >= 16
    for name in ("X against u", "N against r", "X_uu", "good: odometry: 20.0 Hz"):
        assert name in text
    page = tmp_path / "plan.html"
    command = ["plan", "--config", str(HEAVY), "--duration", "10", "--report", str(page)]
    assert main(command) == 0
    text += page.read_text()
    assert "Next manoeuvre for bluerov2_heavy" in text
    assert "from above" in text
    library = (SHIPPED / "rov_ident/reports/uplot/uPlot.iife.min.js").read_text()
    assert text.count(library) == 2
    for outside in ("http:", "https:", "src=", "@import"):
        assert outside not in text.replace("http://www.w3.org", "").replace(library, "")
    capsys.readouterr()


TABLE = """U_mps,beta_deg,X,Y,N
0.5,-10,-41.2,1.61,0.03
0.5,0,-42.1,0.0,0.0
0.5,10,-41.3,-1.63,-0.03
1.0,-10,-151.0,6.54,0.13
1.0,0,-154.7,0.01,0.0
1.0,10,-151.2,-6.55,-0.13
1.5,-10,-329.0,14.7,0.29
1.5,0,-337.8,0.0,0.0
1.5,10,-329.3,-14.7,-0.29
"""
SMALLEST = """
Math.min(...[...document.querySelectorAll("figure text, .u-title, .u-value")].map(
  text => text.getBoundingClientRect().height).filter(height => height > 0))
"""

HIDDEN = """
Math.max(...[...document.querySelectorAll(".scroll")].map(s => s.scrollWidth - s.clientWidth))
"""


@pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")
def test_pages_in_a_browser(tmp_path, capsys):
    """As wide as a screen and a telephone, light and dark, and on paper."""
    (tmp_path / "table.csv").write_text(TABLE)
    bag, zigzag = tmp_path / "dive.mcap", tmp_path / "zigzag.csv"
    remus = SHIPPED / "config" / "remus100.yaml"
    for command in (
        ["simulate", "--config", HEAVY, "--manoeuvre", "steps", "--duration", 20, "--out", bag],
        ["steer", "--config", remus, "--manoeuvre", "zigzag", "--duration", 40, "--out", zigzag],
        ["check", bag, "--config", HEAVY, "--report", tmp_path / "check.html"],
        ["fit", bag, "--config", HEAVY, "--estimator", "ls", "--report", tmp_path / "fit.html"],
        ["plan", "--config", HEAVY, "--duration", 10, "--report", tmp_path / "plan.html"],
        ["nomoto", zigzag, "--report", tmp_path / "nomoto.html"],
        ["forces", tmp_path / "table.csv", "--report", tmp_path / "forces.html"],
    ):
        assert main([*map(str, command)]) == 0
    capsys.readouterr()
    pages = sorted(tmp_path.glob("*.html"))
    assert len(pages) == 5
    asyncio.run(_look_at(pages))


@pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")
def test_curves_are_read_out_and_zoomed_together(tmp_path):
    t = np.linspace(0.0, 60.0, 600)
    panels = [
        plots.zoomable(plots.motion(t, np.sin(t), {"rls": np.sin(t + k)}, "u [m/s]"), f"m{k}")
        for k in range(2)
    ]
    path = tmp_path / "page.html"
    path.write_text(html.page("curves", "", [html.panels(panels, "")], ""))
    assert path.stat().st_size < 5e6
    asyncio.run(_zoom(path))


@pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")
def test_charts_begin_with_the_limits_that_are_drawn(tmp_path):
    """A simulation that diverges leaves the measurement to be seen, and errors begin at zero."""
    t = np.linspace(0.0, 60.0, 600)
    run, error = {"retuned": np.exp(t / 5.0)}, {"retuned": 0.1 + 1e-3 * np.sin(t)}
    axes = "", "time [s]", "u [m/s]"
    panels = [
        plots.zoomable(plots.curves(t, run, *axes, measured=np.sin(t)), "run"),
        plots.zoomable(plots.curves(t, error, *axes, marker="o"), "error"),
    ]
    path = tmp_path / "page.html"
    path.write_text(html.page("curves", "", [html.panels(panels, "")], ""))

    async def written():
        async with chromium() as browser:
            await browser.send("Page.addScriptToEvaluateOnNewDocument", source=KEEP_WHAT_IS_WRITTEN)
            await browser.open(path.as_uri())
            return await browser.until("written.filter(t => t == 'time [s]').length > 1 && written")

    told = asyncio.run(written())
    assert not [text for text in told if "000" in text]
    assert "0.02" in told


def test_no_curve_leads_across_a_pause():
    """Nor is an error lost between two pauses: it is a point."""
    t = np.concatenate([np.arange(0.0, 10.0, 0.1), [20.0], np.arange(3600.0, 3610.0, 0.1)])
    drawn = plots.curves(t, {"retuned": np.sin(t)}, "u", "time [s]", "u [m/s]", measured=np.cos(t))
    for line in drawn.axes[0].get_lines():
        x, y = line.get_data()
        broken = np.isnan(y)
        np.testing.assert_allclose(x[broken], [14.95, 1810.0])
        np.testing.assert_array_equal(x[~broken], t)
    error = np.where(t == 20.0, 0.1, np.nan)
    drawn = plots.curves(t, {"retuned": error}, "u", "time [s]", "error", marker="o")
    (chart,) = json.loads(re.search(r"'curves'>(.*)</script>", plots.zoomable(drawn))[1])
    assert [line["marked"] for line in chart["lines"]] == [True]
    assert 0.1 in chart["lines"][0]["y"]


def _long_names():
    names = [*ri.load(HEAVY).model.names, "thruster_lag.time_constant", "velocity_latency.delay"]
    rows = [[n, "-0.0000007", "0.000088", "N m s2/rad2", "-1.19", "converging"] for n in names]
    return Table("fit", ["", "value", "± 95 %", "unit", "configured", "state"], rows, text=(3, 5))


@pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")
def test_a_table_with_long_names_shows_all_of_its_columns(tmp_path):
    table = _long_names().html()
    path = tmp_path / "page.html"
    beside = html.beside_table([table], [html.bullets(["What to do next."])])
    path.write_text(html.page("table", "", [beside], ""))
    hidden = "(s => s.scrollWidth - s.clientWidth)(document.querySelector('.scroll'))"

    async def look():
        async with chromium() as browser:
            await browser.open(path.as_uri(), 1425)
            await browser.until("document.readyState == 'complete'")
            assert await browser.evaluate(hidden) <= 0

    asyncio.run(look())


@pytest.mark.parametrize("width", [120, 80, 66, 40])
def test_no_name_and_no_state_is_cut_in_a_terminal(width):
    """Where there is no room the units go first; then what is widest is folded."""
    table = _long_names()
    console = Console(file=io.StringIO(), width=width)
    console.print(table)
    lines = console.file.getvalue().splitlines()
    assert max(map(len, lines)) <= width and not any("…" in line for line in lines)
    assert any("N m s2/rad2" in line for line in lines) == (width > 100)
    cells = [[c.strip() for c in line.split("│")] for line in lines if "│" in line]
    if width > 100:  # framed
        cells = [row[1:-1] for row in cells]
    for i in (0, -1):
        assert "".join(row[i] for row in cells) == "".join(row[i] for row in table.rows)
    if width > 60:
        assert [row[-1] for row in cells if row[-1]] == ["converging"] * len(table.rows)


KEEP_WHAT_IS_WRITTEN = """
window.written = [];
const { fillText } = CanvasRenderingContext2D.prototype;
CanvasRenderingContext2D.prototype.fillText = function (text, ...where) {
  written.push(text);
  fillText.call(this, text, ...where);
};
"""


async def _zoom(path):
    async with chromium() as browser:

        async def mouse(kind, share, held=0):
            left, top, width = await browser.evaluate(
                "(({left, top, width}) => [left, top, width])"
                "(document.querySelector('.u-over').getBoundingClientRect())"
            )
            how = {"button": "none", "buttons": 0} if kind == "mouseMoved" and not held else {}
            how = {"button": "left", "buttons": held, "clickCount": 1} | how
            at = {"x": left + share * width, "y": top + 50.0}
            await browser.send("Input.dispatchMouseEvent", type=kind, **at, **how)

        async def shown():
            return await browser.evaluate(
                "[...document.querySelectorAll('.uplot canvas')].map(each => each.toDataURL())"
            )

        await browser.send("Page.addScriptToEvaluateOnNewDocument", source=KEEP_WHAT_IS_WRITTEN)
        await browser.open(path.as_uri())
        await browser.until("document.querySelectorAll('.uplot').length == 2")
        await browser.until("['time [s]', 'u [m/s]'].every(text => written.includes(text))")
        whole = await shown()
        assert await browser.evaluate("document.querySelector('.zoom > svg').clientHeight") == 0
        await mouse("mouseMoved", 0.5)
        told = "[...document.querySelectorAll('.u-legend .u-value')].map(each => each.textContent)"
        await browser.until(f"{told}.every(text => text != '\u2013')")  # in both charts
        read = float((await browser.evaluate(told))[0].removesuffix(" s"))
        assert abs(read - 30.0) < 0.2  # a sample and a pixel are 0.1 s each
        await mouse("mousePressed", 0.4, 1)
        for share in (0.5, 0.6):
            await mouse("mouseMoved", share, 1)
        await mouse("mouseReleased", 0.6)
        await asyncio.sleep(0.3)
        assert all(now != before for now, before in zip(await shown(), whole, strict=True))
        assert browser.complaints == []
        await browser.send("Emulation.setEmulatedMedia", media="print")
        assert await browser.evaluate("document.querySelector('.zoom > svg').clientHeight") > 0
        assert await browser.evaluate("document.querySelector('.uplot').clientHeight") == 0


async def _look_at(pages):
    async with chromium() as browser:
        for path in pages:
            for width, dark in ((1440, False), (1440, True), (390, False), (390, True)):
                await browser.open(path.as_uri(), width, dark)
                await browser.until("document.readyState == 'complete'")
                assert await browser.evaluate("document.title"), path.name
                assert browser.complaints == []
                assert await browser.evaluate("document.documentElement.scrollWidth") <= width
                assert await browser.evaluate(SMALLEST) > 6.0, (path.name, width)
                if width == 1440 and path.stem in ("check", "plan"):
                    assert await browser.evaluate(HIDDEN) <= 0, path.name
                paper = await browser.evaluate("getComputedStyle(document.body).backgroundColor")
                assert (paper == "rgb(255, 255, 255)") != dark
            printed = await browser.send("Page.printToPDF")
            assert printed["data"].startswith("JVBERi")  # %PDF


COMPLETE = """
source "{script}"
COMP_WORDS=(rov-ident {words}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1))
_shtab_rov_ident
echo "${{COMPREPLY[@]}}"
"""


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("exp", {"explain", "export"}),
        ("fit --est", {"--estimator"}),
        ("export --format g", {"gazebo"}),
        ("fit --estimator u", {"ukf"}),
    ],
)
def test_a_real_shell_completes(tmp_path, capsys, words, expected):
    assert main(["completion", "bash"]) == 0
    script = tmp_path / "completion.sh"
    script.write_text(capsys.readouterr().out)
    program = COMPLETE.format(script=script, words=words)
    answer = subprocess.run(["bash", "-c", program], capture_output=True, text=True, check=True)
    assert set(answer.stdout.split()) == expected


def test_the_completion_of_zsh_knows_every_command(capsys):
    assert main(["completion", "zsh"]) == 0
    script = capsys.readouterr().out
    assert script.startswith("#compdef rov-ident")
    for name in COMMANDS:
        assert f"_shtab_rov_ident_{name.replace('-', '_')}_options" in script
