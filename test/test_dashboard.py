"""The live page: what it keeps, who may read it, and what a browser shows of it."""

import asyncio
import contextlib
import io
import json
import math
import re
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import aiohttp
import numpy as np
import pytest
from browser import CHROMIUM, chromium
from geometry_msgs.msg import WrenchStamped
from rich.console import Console

from bench import HEAVY, ROOT
from bench.simulators.live import in_pace, same_to_rounding
from rov_ident import config
from rov_ident.core.states import State
from rov_ident.dashboard import server
from rov_ident.dashboard.store import BINS, MOST, POINTS, Estimator, Series, Status, Store, plain
from rov_ident.estimation.online import ESTIMATORS, OnlineEstimator
from rov_ident.nodes import watch_terminal
from rov_ident.simulation import virtual_sensors as sensors

CONFIGS = ROOT / "config"
HANGS = 120.0  # s; nothing takes so long, however busy the computer

# ------------------------------------------------------------------ what it keeps


def test_series_thins_out():
    """However long the run, all of it is there, evenly, in no more rows than there is room for."""
    series = Series(POINTS)
    for k in range(100_000):
        series.append(0.2 * k, k)
        assert len(series) <= POINTS
    _, rows, _ = series.since(None)
    times = np.array([t for t, _ in rows])
    assert times[0] == 0.0 and times[-1] > 0.2 * 99_000
    assert len(rows) > POINTS / 3
    assert np.diff(times).max() < 3.0 * np.median(np.diff(times))


@pytest.mark.parametrize("sliding", [False, True])
def test_series_since(sliding):
    """A reader that comes now and then has in the end just what a new one is given."""
    series, copy, mark = Series(50, sliding), [], None
    random = np.random.default_rng(3)
    t = 0.0
    for _ in range(400):
        t = 0.0 if random.random() < 0.01 else t + random.random()  # begins anew at times
        series.append(t, t)
        if random.random() < 0.3:
            anew, rows, mark = series.since(mark)
            copy = (rows if anew else copy + rows)[-50:]
    anew, rows, mark = series.since(mark)
    copy = (rows if anew else copy + rows)[-50:]
    assert copy == series.since(None)[1]
    assert series.since(mark) == (False, [], mark)


class Clock:
    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture
def report(heavy):
    return OnlineEstimator(heavy, "rls").report()


def fill(
    store, report, names=("/rls_node", "/ukf_node"), seconds=60, seed=0,
    vehicle="the_inspection_vehicle_with_the_longest_name_of_all_of_them",
):  # fmt: skip
    """What nodes would publish in so many seconds of convergence."""
    random = np.random.default_rng(seed)
    n = len(report.names)
    for name in names:
        store.add(name)
        for k in range(5 * seconds):
            known = np.exp(-k / 40.0)
            std = np.abs(report.values) * (0.002 + 0.3 * known)
            values = report.values * (1.0 + 0.3 * known * random.standard_normal(n))
            states = (State.CONVERGED if known < 0.5 else State.CONVERGING,) * n
            stamp = 10**18 + k * 200_000_000
            excitation = np.linspace(0.0, 1.0, n)
            said = replace(
                report, stamp=stamp, values=values, std=std, states=states,
                lower=values - 1.96 * std, upper=values + 1.96 * std, excitation=excitation,
            )  # fmt: skip
            store.take_report(name, vehicle, said)
            for j in range(4):
                residual = random.standard_normal(6) * [3, 3, 5, 0.3, 0.2, 0.4]
                store.take_residual(name, stamp + j * 50_000_000, residual)
        root = np.eye(n) + 0.3 * random.standard_normal((n, n))
        store.take_covariance(name, root @ root.T)
        inputs = {"odom rate": "20.0 Hz", "imu rate": "100.0 Hz", "wrench rate": "50.0 Hz"}
        store.take_status(name, "inputs", Status(0, "all messages are used", inputs))
        store.take_status(name, "estimation", Status(0, f"{n} of {n} have converged", {}))
    suspicion = {"score": "210", "penalty": "31", "share": "0.83", "alternatives": "lift coupled"}
    store.take_status(
        names[0],
        "model",
        Status(1, "residual in surge follows |u| u: <b>drag</b> missing?", suspicion),
    )


def test_store(report):
    clock = Clock()
    store = Store(clock)
    fill(store, report, seconds=20)
    state, marks = store.changes()
    one = state["estimators"]["/rls_node"]
    assert json.loads(json.dumps(state, allow_nan=False)) == state
    assert len(one["history"]["rows"]) == 100
    t, values, std = one["history"]["rows"][-1]
    assert t == 1e9 + 19.8
    np.testing.assert_allclose(values, one["values"], rtol=1e-5)
    np.testing.assert_allclose(std, one["std"], rtol=1e-5)
    _, low, high, rms = one["residuals"]["rows"][3]
    assert len(one["residuals"]["rows"]) == pytest.approx(40, abs=2)
    assert all(a <= b and r <= max(-a, b) for a, b, r in zip(low, high, rms))
    assert np.abs(np.diag(one["correlation"])).tolist() == [1.0] * len(report.names)
    assert one["statuses"]["model"]["level"] == 1

    # What was seen is not sent again; what is new is.
    state, marks = store.changes(marks)
    assert state["estimators"]["/rls_node"]["history"] == {"anew": False, "rows": []}
    store.take_report("/rls_node", "heavy", replace(report, stamp=10**18 + 30 * 10**9))
    clock.now += 5.0
    state, marks = store.changes(marks)
    assert len(state["estimators"]["/rls_node"]["history"]["rows"]) == 1
    one = state["estimators"]["/rls_node"]
    assert one["gone"] and set(one["states"]) == {"stale"} and set(one["levels"]) == {3}
    known, _ = store.reports["/rls_node"]
    assert one["messages"] == list(known.report.messages)
    assert one["messages"][0].startswith("stale: the node is silent (before: ")
    # What goes on to a controller is kept by itself.
    bridge = Status(0, "waiting for ~/approve", {"controller": "/c", "pending": "X_u"})
    store.take_status("/controller_bridge", "bridge", bridge)
    state, _ = store.changes()
    assert state["bridges"] == {"/controller_bridge": vars(bridge)}
    assert "/controller_bridge" not in state["estimators"]
    # Others of whom only /diagnostics speaks are no estimators.
    store.take_status("/camera", "inputs", Status(0, "", {}))
    assert "/camera" not in store.changes()[0]["estimators"]


def test_residuals_of_long_runs_slide():
    store = Store(Clock())
    for k in range(20 * 600):
        store.take_residual("/rls_node", k * 50_000_000, np.full(6, float(k)))
    store.take_residual("/rls_node", 10**12, np.full(6, np.nan))
    rows = store.changes()[0]["estimators"]["/rls_node"]["residuals"]["rows"]
    assert len(rows) == BINS
    assert rows[-1][2][0] >= 20 * 599


def test_plain():
    assert plain((np.array([1.23456789, np.nan]), np.inf, "x", 3)) == [
        [1.23457, None],
        None,
        "x",
        3,
    ]
    assert plain(1_700_000_000.12345) == 1_700_000_000.123


# ------------------------------------------------------------------ who may read it


def one_by_one():
    """A session with a connection for each request: none is kept for longer than servers allow."""
    return aiohttp.ClientSession(connector=aiohttp.TCPConnector(force_close=True))


@contextlib.asynccontextmanager
async def browsing(store):
    async with server.serving(store, 0) as url, one_by_one() as session:
        yield url, int(url.rstrip("/").rpartition(":")[2]), session


def test_only_this_computer(report):
    """Every way of another page, or of another computer, to the data is shut."""
    asyncio.run(_only_this_computer(report))


async def _only_this_computer(report):
    store = Store(Clock())
    fill(store, report, seconds=1)
    async with browsing(store) as (url, port, session):
        own = f"http://127.0.0.1:{port}"

        async def status(path="", method="GET", **headers):
            headers = {name.replace("_", "-"): value for name, value in headers.items()}
            async with session.request(method, url + path, headers=headers) as answer:
                assert "Access-Control-Allow-Origin" not in answer.headers
                return answer.status

        async with session.get(url) as answer:
            policy = answer.headers["Content-Security-Policy"]
            assert answer.headers["Cache-Control"] == "no-store"
            assert answer.headers["X-Content-Type-Options"] == "nosniff"
            assert answer.headers["Cross-Origin-Resource-Policy"] == "same-origin"
        assert policy.startswith("default-src 'none'; script-src 'self'; style-src 'self';")
        assert "unsafe" not in policy and "frame-ancestors 'none'" in policy
        for path in ("", "page.js", "page.css", "state.json"):
            assert await status(path) == 200
            assert await status(path, Host=f"localhost:{port}") == 200
            # A name that was pointed at 127.0.0.1 (DNS rebinding), and this one on another port.
            for host in ("evil.example", f"evil.example:{port}", "127.0.0.1",
                         f"127.0.0.1:{port + 1}", f"localhost.evil.example:{port}"):  # fmt: skip
                assert await status(path, Host=host) == 421, (path, host)
            for origin in ("http://evil.example", "null", f"http://127.0.0.1:{port + 1}",
                           f"https://127.0.0.1:{port}"):  # fmt: skip
                assert await status(path, Origin=origin) == 403, (path, origin)
            assert await status(path, Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="no-cors") == 403
            assert await status(path, Sec_Fetch_Site="same-site", Sec_Fetch_Mode="cors") == 403
            for method in ("POST", "PUT", "DELETE", "PATCH"):
                assert await status(path, method) == 405
        assert await status("../cli.py") == 404
        assert await status("page/index.html") == 404
        assert await status("%2e%2e/%2e%2e/store.py") == 404

        for origin in ("http://evil.example", "null", f"http://localhost:{port}.evil.example"):
            with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
                await session.ws_connect(url + "live", headers={"Origin": origin})
            assert refused.value.status == 403
        for origin in (own, f"http://localhost:{port}"):
            async with session.ws_connect(url + "live", headers={"Origin": origin}) as live:
                state = await asyncio.wait_for(live.receive_json(), HANGS)
                assert state == store.changes()[0]
                # It listens to nobody.
                await live.send_str("reset")
                closed = await asyncio.wait_for(_close_code(live), HANGS)
                assert closed == aiohttp.WSCloseCode.POLICY_VIOLATION


async def _close_code(live):
    async for _ in live:
        pass
    return live.close_code


def test_many_pages(report):
    """So many and no more; what is closed makes room; the end of the server closes all."""
    asyncio.run(_many_pages(report))


def test_numbers_of_others_are_data(report):
    """Whatever they are, the state is JSON; a good covariance comes back."""
    store = Store(Clock())
    fill(store, report, seconds=1)
    n = len(report.names)
    random = np.random.default_rng(0)
    for _ in range(300):
        matrix = np.diag(10.0 ** random.uniform(-320.0, 300.0, n))
        matrix[random.integers(n), random.integers(n)] = random.choice([-1e300, 1e300, 1e-320, 0.0])
        store.take_covariance("/rls_node", matrix)
        store.take_residual("/rls_node", random.integers(2**40), 10 ** random.uniform(0, 308, 6))
        server._to_json(store.changes()[0])
    store.take_covariance("/rls_node", np.eye(n) + 0.25)
    store.take_covariance("/rls_node", 1e300 * (np.eye(n) - 2.0))  # no covariance
    correlation = store.changes()[0]["estimators"]["/rls_node"]["correlation"]
    np.testing.assert_allclose(correlation, np.eye(n) + 0.2 * (1.0 - np.eye(n)))


def test_what_others_invent_is_bounded(report):
    store = Store(Clock())
    fill(store, report, seconds=1)
    values = {f"{k}": "x" * 10_000 for k in range(2_000)}
    for k in range(2_000):
        status = Status(0, "x" * 100_000, values if k < 3 else {})
        store.take_status("/rls_node", f"kind {k}", status)
        store.take_status(f"/invented_{k}", "bridge", status)
        store.add(f"/invented_{k}")
        store.take_report(f"/invented_{k}", "heavy", report)
        store.take_status("/real", "bridge", Status(0, "well", {}))
    state = store.changes()[0]
    assert len(state["bridges"]) == len(state["estimators"]) == MOST
    assert state["bridges"]["/real"]["message"] == "well"
    assert set(state["estimators"]["/rls_node"]["statuses"]) == {"inputs", "estimation", "model"}
    store.take_status("/rls_node", "inputs", Status(0, "x" * 100_000, values))
    assert len(server._to_json(store.changes()[0])) < 4e6


def test_slow_connections_are_not_held(report, monkeypatch):
    monkeypatch.setattr(server, "PATIENCE", 2.0)
    asyncio.run(_slow_connections(report))


async def _slow_connections(report):
    store = Store(Clock())
    fill(store, report, seconds=1)
    async with aiohttp.ClientSession() as session, server.serving(store, 0) as url:
        page = await session.ws_connect(url + "live")
        port = int(url.rstrip("/").rpartition(":")[2])
        slow = [await asyncio.open_connection(server.HOST, port) for _ in range(300)]
        for _, writer in slow:
            writer.write(b"GET / HTTP/1.1\r\n")  # and no more
        ends = [asyncio.create_task(_ended(reader)) for reader, _ in slow]
        await asyncio.sleep(0.5)
        assert sum(not end.done() for end in ends) < server.CONNECTIONS
        await asyncio.wait_for(asyncio.gather(*ends), HANGS)
        async with session.get(url) as answer:
            assert answer.status == 200
        assert (await asyncio.wait_for(page.receive_json(), HANGS))["estimators"]
        for _, writer in slow:
            writer.close()


async def _ended(reader):
    with contextlib.suppress(ConnectionError):
        await reader.read()


async def _many_pages(report):
    store = Store(Clock())
    fill(store, report, seconds=1)
    async with aiohttp.ClientSession() as session:
        async with server.serving(store, 0) as url:
            sockets = [await session.ws_connect(url + "live") for _ in range(server.CLIENTS)]
            with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
                await session.ws_connect(url + "live")
            assert refused.value.status == 503
            await sockets.pop().close()
            sockets.append(await session.ws_connect(url + "live"))
            first = await asyncio.wait_for(sockets[0].receive_json(), HANGS)
            assert first["estimators"]["/rls_node"]["history"]["anew"]
            then = await asyncio.wait_for(sockets[0].receive_json(), HANGS)
            assert not then["estimators"]["/rls_node"]["history"]["anew"]
            reading = [asyncio.create_task(_close_code(one)) for one in sockets]
            await asyncio.sleep(0.1)
        codes = await asyncio.wait_for(asyncio.gather(*reading), HANGS)
        assert codes == [aiohttp.WSCloseCode.GOING_AWAY] * server.CLIENTS


def test_listens_on_loopback_only():
    asyncio.run(_listens_on_loopback_only())


async def _listens_on_loopback_only():
    async with server.serving(Store(Clock()), 0) as url:
        port = int(url.rstrip("/").rpartition(":")[2])
        listening = [
            line.split()[1]
            for table in ("/proc/net/tcp", "/proc/net/tcp6")
            for line in Path(table).read_text().splitlines()[1:]
            if line.split()[3] == "0A" and line.split()[1].endswith(f":{port:04X}")
        ]
        assert listening == [f"0100007F:{port:04X}"]
        with pytest.raises(server.UserError, match="cannot be used"):
            async with server.serving(Store(Clock()), port):
                pass


class Links(HTMLParser):
    def __init__(self):
        super().__init__()
        self.found, self.inline = [], []

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.found += [values[key] for key in ("src", "href") if values.get(key)]
        self.inline += [key for key in values if key.startswith("on") or key == "style"]


def test_page_is_self_contained():
    """It fetches nothing but its own two files, and makes no markup out of what it is told."""
    links = Links()
    links.feed((server._PAGE / "index.html").read_text("utf-8"))
    assert sorted(links.found) == ["data:,", "page.css", "page.js"]
    assert not links.inline
    script = (server._PAGE / "page.js").read_text("utf-8")
    style = (server._PAGE / "page.css").read_text("utf-8")
    assert not re.search(r"innerHTML|outerHTML|insertAdjacent|document\.write|eval\(", script)
    addresses = re.findall(r"https?://[^\s\"'`]+", script + style)
    assert addresses == ["http://www.w3.org/2000/svg"]
    assert "@import" not in style and "url(" not in style


# ------------------------------------------------------------------ in a browser


@pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")
def test_in_a_browser(report):
    asyncio.run(_in_a_browser(report))


async def _in_a_browser(report):
    store = Store(time.monotonic)
    async with server.serving(store, 0) as url, chromium() as page:
        await page.open(url)
        await page.until("document.body?.innerText.includes('No estimator is heard yet')")
        fill(store, report, ("/rov1/rls_node", "/rov1/ukf_node", "/rov2/rls_node"), seconds=20)
        cards = "document.querySelectorAll('[data-coefficient]').length"
        await page.until(f"{cards} == {len(report.names)}")
        # Each coefficient's card has two curves with as many points as there were reports, and
        # the last values as they are.
        await page.until("document.querySelectorAll('nav button').length == 2")
        drawn = await page.evaluate(
            "[...document.querySelector('[data-coefficient=X_u]').querySelectorAll('.curve')]"
            ".map((curve) => curve.getAttribute('d').split('L').length)"
        )
        assert drawn == [100, 100]
        state = store.changes()[0]["estimators"]["/rov1/rls_node"]
        value = state["values"][report.names.index("X_u")]
        shown = await page.evaluate(
            "document.querySelector('[data-coefficient=X_u] .row').innerText.replace('−', '-')"
        )
        assert float(shown.split()[0]) == pytest.approx(value, rel=5e-3)
        # Read aloud, a name is apart from its unit, and a state is a word.
        card = "document.querySelector('[data-coefficient=X_u]')"
        assert await page.evaluate(f"{card}.querySelector('h3').textContent") == "X_u N s/m"
        spoken = await page.evaluate(f"{card}.querySelector('.state').getAttribute('aria-label')")
        assert spoken == "converged"
        # Numbers are written without powers of ten where they need none, and nothing is minus zero.
        for expression, text in (
            ("interval(70)", "140"), ("interval(3)", "5.9"), ("interval(1e9)", "2.0e9"),
            ("written(-1e-9, 0.01)", "0.000"), ("written(-0.2, 0.01)", "−0.200"),
        ):  # fmt: skip
            assert await page.evaluate(expression) == text
        assert "chance reaches 31" in await page.evaluate(
            "document.querySelector('.note').textContent"
        )
        # Under the pointer is the value of that time.
        box = await page.evaluate(
            "JSON.parse(JSON.stringify(document.querySelector('[data-coefficient=X_u] svg')"
            ".getBoundingClientRect()))"
        )
        middle = {"x": box["x"] + 0.5 * box["width"], "y": box["y"] + 0.5 * box["height"]}
        await page.send("Input.dispatchMouseEvent", type="mouseMoved", **middle)
        await page.until(
            "document.querySelector('[data-coefficient=X_u] .state').innerText.endsWith('s ago')"
        )
        await page.send("Input.dispatchMouseEvent", type="mouseMoved", x=1, y=1)
        # Noise around zero; then a steady force.
        words = "document.querySelector('.grid.six .state').innerText"
        await page.until(f"{words} == 'around zero'")
        for k in range(240):
            store.take_residual("/rov1/rls_node", 10**18 + (400 + k) * 50_000_000, np.full(6, 9.0))
        await page.until(f"{words}.startsWith('above zero')")
        bridge = Status(1, "stale", {"controller": "/c", "pending": "X_u"})
        store.take_status("/rov1/controller_bridge", "bridge", bridge)
        bridge_note = "[...document.querySelectorAll('.note')].map((n) => n.innerText)"
        await page.until(f"{bridge_note}.some((t) => t.includes('pending: X_u'))")
        # What a node says is text.
        assert await page.evaluate("document.querySelector('.note').innerText.includes('<b>drag')")
        assert await page.evaluate("document.querySelectorAll('.note b').length") == 0
        for width in (1440, 390):
            for dark in (False, True):
                await page.show(width, dark)
                wide = "Math.max(...[...document.querySelectorAll('main *')]"
                wide += ".map((e) => e.getBoundingClientRect().right))"
                # The pictures take the new width with the next frame, not with innerWidth.
                await page.until(f"innerWidth == {width} && {wide} <= {width}")
                ink, paper = await page.evaluate(
                    "[getComputedStyle(document.body).color, "
                    "getComputedStyle(document.body).backgroundColor]"
                )
                assert (brightness(ink) > brightness(paper)) == dark
                smallest = await page.evaluate(
                    "Math.min(...[...document.querySelectorAll('main p, main span, main text')]"
                    ".map((e) => parseFloat(getComputedStyle(e).fontSize)))"
                )
                assert smallest >= 11.0
        # A link leads to its part, on a phone below the head that stays.
        await page.evaluate("document.querySelectorAll('#parts a')[2].click()")
        assert await page.evaluate("document.querySelectorAll('h2')[2].innerText") == "Excitation"
        top = "document.querySelectorAll('h2')[2].getBoundingClientRect().top"
        head = "document.querySelector('header').getBoundingClientRect().bottom"
        await page.until(f"{head} <= {top} && {top} < 0.5 * innerHeight")
        # The other vehicle, on a click.
        await page.evaluate("document.querySelectorAll('nav button')[1].click()")
        await page.until("document.querySelectorAll('.tile').length == 1")
        assert await page.evaluate("document.activeElement.textContent") == "/rov2"
        # A page of elsewhere gets nothing, whatever it tries.
        other = url.replace("127.0.0.1", "localhost")
        tried = await page.evaluate(
            f"fetch('{other}state.json').then(() => 'read', () => 'refused')"
        )
        assert tried == "refused"
        refusals = [text for text in page.complaints if "localhost" not in text]
        assert refusals == []


def brightness(colour):
    return sum(int(part) for part in re.findall(r"\d+", colour)[:3])


# ------------------------------------------------------------------ live, over DDS


@pytest.fixture
def command(domain):
    """Starts a command; in the end it must end well on an interrupt."""
    started = []

    def start(*arguments):
        process = subprocess.Popen(
            [sys.executable, "-m", *arguments],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        started.append(process)
        return process

    yield start
    for process in started:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
            _, said = process.communicate(timeout=600)
            assert "Traceback" not in said
        assert process.returncode == 0


ROLES = ("odom", "imu", "wrench")
VEHICLES = {"rov1": (HEAVY, 1), "rov2": (CONFIGS / "remus100.yaml", 2)}
ESTIMATED = {"rov1": ESTIMATORS, "rov2": ("rls",)}
NODES = {f"/{v}/{kind}_node": (v, kind) for v, kinds in ESTIMATED.items() for kind in kinds}


def test_two_vehicles(command):
    """Three nodes in two namespaces, each with its own vehicle's numbers; and the
    page, the table and its JSON show all of them."""
    configs = {vehicle: path for vehicle, (path, _) in VEHICLES.items()}
    dives = {
        vehicle: sensors.dive(config.load(configs[vehicle]), duration=8.0, seed=seed).messages
        for vehicle, (_, seed) in VEHICLES.items()
    }
    expected = {}
    for node, (vehicle, kind) in NODES.items():
        online = OnlineEstimator(config.load(configs[vehicle]), kind)
        for _, role, message in dives[vehicle]:
            online.push(role, message)
        online.flush()
        expected[node] = online.report()
        options = ["--ros-args", "--params-file", str(configs[vehicle]), "-r", f"__ns:=/{vehicle}"]
        options += ["-p", "qos.reliability:=reliable", "-p", "timeout:=3.0"]
        command("rov_ident.nodes", f"{kind}_node", *options)
    table = command("rov_ident", "watch")
    dashboard = command("rov_ident", "dashboard", "--port", "0", "--json")
    page = json.loads(dashboard.stdout.readline())["page"]

    with publishing(dives) as publish:
        asyncio.run(_until_all_are_shown(page, expected, publish))
        lines = command("rov_ident", "watch", "--once", "--json", "--wait", "30")
    table.send_signal(signal.SIGINT)
    _, shown = table.communicate(timeout=600)
    assert all(f"{node} (" in shown for node in NODES)
    said, _ = lines.communicate(timeout=600)
    state = json.loads(said)["estimators"]
    assert sorted(state) == sorted(NODES)
    for node, report in expected.items():
        assert state[node]["vehicle"] == config.load(configs[NODES[node][0]]).name
        assert state[node]["stamp_ns"] == report.stamp
        given = [state[node]["coefficients"][name] for name in report.names]
        same_to_rounding(*(np.array([g[key] for g in given]) for key in ("value", "std")), report)
        assert {g["level"] for g in given} == {"STALE"}  # the dives are over
        assert set(state[node]["health"]) == {"inputs", "estimation", "model"}


@contextlib.contextmanager
def publishing(dives):
    """Gives what publishes the dives, as fast as all nodes can use them."""
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from rov_ident.io import cdr
    from rov_ident.nodes.common import STREAM, Executor, subscribed
    from rov_ident.nodes.conversions import from_time

    context = rclpy.Context()
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("drivers", context=context)
    executor = Executor(context=context)
    executor.add_node(node)
    publishers = {
        (vehicle, role): node.create_publisher(type_, f"/{vehicle}/{topic}", STREAM)
        for vehicle in dives
        for role, (topic, type_) in subscribed(config.load(VEHICLES[vehicle][0]).inputs).items()
    }
    used = dict.fromkeys(NODES, -math.inf)
    for name in NODES:

        def take(residual, name=name):
            used[name] = from_time(residual.header.stamp)

        node.create_subscription(WrenchStamped, f"{name}/wrench_residual", take, STREAM)
    messages = sorted(
        (
            (arrival, (vehicle, role), message)
            for vehicle, dive in dives.items()
            for arrival, role, message in dive
        ),
        key=lambda entry: entry[0],
    )

    def publish():
        def listen(seconds):
            executor.spin_once(timeout_sec=seconds)

        # The nodes know of the publishers; what these send before they know of the nodes is lost.
        end = time.monotonic() + 300.0
        while any(
            p.get_subscription_count() < len(ESTIMATED[v]) for (v, _), p in publishers.items()
        ):
            assert time.monotonic() < end, "a publisher does not find the nodes"
            listen(0.1)
        for _, to, message in in_pace(messages, lambda: min(used.values()), listen):
            publishers[to].publish(cdr.encode(message))

    yield publish
    executor.shutdown()
    node.destroy_node()
    rclpy.try_shutdown(context=context)


async def _until_all_are_shown(url, expected, publish):
    end, published = time.monotonic() + 300.0, False
    async with one_by_one() as session:
        while True:
            await asyncio.sleep(0.2)
            async with session.get(url + "state.json") as answer:
                state = (await answer.json())["estimators"]
            inputs = [known["statuses"].get("inputs", {"values": {}}) for known in state.values()]
            connected = [s["values"].get(f"{r} publishers") for s in inputs for r in ROLES]
            if not published and connected == ["1"] * len(NODES) * len(ROLES):
                publish()
                published = True
            told = {node for node, known in state.items() if known["statuses"].keys() >= {"model"}}
            stamps = {node: known.get("stamp") for node, known in state.items() if node in told}
            if stamps == {node: report.stamp * 1e-9 for node, report in expected.items()}:
                break
            assert time.monotonic() < end, stamps
    for node, report in expected.items():
        np.testing.assert_allclose(state[node]["values"], report.values, rtol=1e-5)
        assert len(state[node]["correlation"]) == len(report.names)
        assert len(state[node]["residuals"]["rows"]) > 5
        assert len(state[node]["history"]["rows"]) >= 1


@pytest.mark.parametrize("kinds", [["rls"], ["rls", "ukf"]])
def test_watch_cuts_no_name_and_no_state_in_a_narrow_terminal(kinds):
    given = config.load(CONFIGS / "bluerov2_heavy.yaml")
    heard = {}
    for kind in kinds:
        report = OnlineEstimator(given, kind).report()
        states = tuple(State.CONVERGING for _ in report.names)
        known = Estimator(f"/{kind}_node", "heavy", replace(report, states=states))
        heard[f"/{kind}_node"] = known, 0.1
    assert "thruster_lag.time_constant" in report.names
    for width, units in ((200, True), (80, len(kinds) == 1)):
        console = Console(file=io.StringIO(), width=width)
        console.print(watch_terminal._picture(heard, console))
        lines = console.file.getvalue().splitlines()
        text = "\n".join(lines)
        assert "…" not in text and max(map(len, lines)) <= width
        assert text.count("converging") == len(kinds) * len(report.names)
        assert ("N s2/m2" in text) == units
        if units:
            assert all(name in text for name in report.names)


def test_watch_prints_every_report(monkeypatch):
    """Nodes publish at 5 Hz by default, and a look at 4 Hz had missed one of five."""
    given = config.load(CONFIGS / "bluerov2_heavy.yaml")
    report, store, interrupts = OnlineEstimator(given, "rls").report(), Store(Clock()), []

    def spin(seconds):
        for _ in range(2):
            store.take_report("/rls_node", "heavy", replace(report, stamp=len(interrupts)))
            interrupts.append(2)

    monkeypatch.setattr(
        watch_terminal, "_listening", lambda: contextlib.nullcontext((store, spin, interrupts))
    )
    out = io.StringIO()
    watch_terminal.watch(True, Console(file=out), Console(file=io.StringIO()))
    lines = [json.loads(line)["estimators"]["/rls_node"] for line in out.getvalue().splitlines()]
    assert [line["stamp_ns"] for line in lines] == [0, 1]


def test_watch_hears_nobody(domain):
    ended = subprocess.run(
        [sys.executable, "-m", "rov_ident", "watch", "--once", "--wait", "0.5"],
        capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert ended.returncode == 2 and not ended.stdout
    assert "no estimator was heard within 0.5 s: start rls_node" in ended.stderr


@pytest.mark.parametrize(
    "command, sentence",
    [
        (["rov_ident", "dashboard", "--port", "{taken}"], "cannot be used (Address already in"),
        (
            ["rov_ident.nodes", "dashboard_node", "--ros-args", "-p", "port:=99999"],
            "dashboard_node: port is 99999, but must be between 0 and 65535",
        ),
        (
            ["rov_ident.nodes", "dashboard_node", "--ros-args", "-p", "port:=auto"],
            "dashboard_node: port is 'auto' (text), but must be a whole number",
        ),
    ],
)
def test_refused(domain, command, sentence):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        arguments = [text.format(taken=other.getsockname()[1]) for text in command]
        ended = subprocess.run(
            [sys.executable, "-m", *arguments], capture_output=True, text=True, timeout=600
        )
    assert ended.returncode == 2, ended.stderr
    assert sentence in " ".join(ended.stderr.split())
    assert "Traceback" not in ended.stderr
