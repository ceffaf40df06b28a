"""Serves the live page to browsers on this computer, and to nobody else.

Loopback only, nothing can be written, and no other page that a browser has open may read it: the
Host header must name this computer (else a name that an attacker points at 127.0.0.1 would be of
the same origin), the Origin of a web socket must be ours (a browser lets any page open one), and
there is no CORS. The page takes no script but its own.
"""

import asyncio
import contextlib
import json
import socket
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from importlib.resources import files
from typing import Any

from aiohttp import WSCloseCode, web

from rov_ident.core.errors import UserError
from rov_ident.dashboard.store import Store

HOST = "127.0.0.1"
PERIOD = 0.5  # s; between two messages to a page: curves that look alive, at little cost
CLIENTS = 16  # pages open at a time; each costs a message every PERIOD
CONNECTIONS = 8 * CLIENTS  # a browser opens six at a time
PATIENCE = 10.0  # s; for a page to take a message, or ask for anything: twenty times PERIOD
_LEAVE = 0.5  # s; for a page to answer that it is closed
_LARGEST = 4096  # bytes of a message to us, of which there should be none
_PAGE = files("rov_ident.dashboard") / "page"
_FILES = {
    "/": ("index.html", "text/html"),
    "/page.css": ("page.css", "text/css"),
    "/page.js": ("page.js", "text/javascript"),
}
NAMES = (HOST, "localhost")  # the names of this computer that a request may give

_Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]

PORT = web.AppKey("port", int)
STORE = web.AppKey("store", Store)
PAGES: web.AppKey[dict[web.WebSocketResponse, asyncio.Protocol]] = web.AppKey("pages")
"""Those that are open, each with its connection."""


def application(store: Store, port: int) -> web.Application:
    """The page at `/`, the state at `/state.json`, what is new at `/live` (web socket)."""
    app = web.Application(middlewares=[_guard(port)], client_max_size=_LARGEST)
    app[PORT], app[STORE] = port, store
    app[PAGES] = {}
    app.on_response_prepare.append(_protect)
    app.on_shutdown.append(_hang_up)
    for path in _FILES:
        app.router.add_get(path, _file)
    app.router.add_get("/state.json", _state)
    app.router.add_get("/live", _live, allow_head=False)
    return app


def _guard(port: int) -> Any:
    """Middleware that answers only requests to this computer by its name, of our own origin.

    Browsers give the origin of every web socket; programs need not.
    """
    hosts = {f"{name}:{port}" for name in NAMES}
    origins = {f"http://{host}" for host in hosts}

    @web.middleware
    async def check(request: web.Request, handler: _Handler) -> web.StreamResponse:
        hosts_given = request.headers.getall("Host", [])
        if len(hosts_given) != 1 or hosts_given[0].lower() not in hosts:
            raise web.HTTPMisdirectedRequest(text="ask for http://localhost or 127.0.0.1\n")
        site = request.headers.get("Sec-Fetch-Site", "none")
        foreign = site not in ("none", "same-origin")
        if request.headers.get("Sec-Fetch-Mode") == "navigate":
            foreign = False  # a link on another page may lead here
        if foreign or not origins.issuperset(request.headers.getall("Origin", [])):
            raise web.HTTPForbidden(text="not for other pages\n")
        return await handler(request)

    return check


async def _protect(request: web.Request, response: web.StreamResponse) -> None:
    # Not every browser takes a web socket of the page's own origin for 'self'.
    sockets = " ".join(f"ws://{name}:{request.app[PORT]}" for name in NAMES)
    response.headers.update(
        {
            "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
            f"img-src 'self' data:; connect-src 'self' {sockets}; base-uri 'none'; "
            "form-action 'none'; frame-ancestors 'none'",
            "X-Content-Type-Options": "nosniff",
            "X-Frame-Options": "DENY",
            "Referrer-Policy": "no-referrer",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Cross-Origin-Opener-Policy": "same-origin",
            "Cache-Control": "no-store",
        }
    )


async def _file(request: web.Request) -> web.Response:
    name, kind = _FILES[request.path]
    return web.Response(text=(_PAGE / name).read_text("utf-8"), content_type=kind, charset="utf-8")


async def _state(request: web.Request) -> web.Response:
    state, _ = request.app[STORE].changes()
    return web.Response(text=_to_json(state), content_type="application/json")


async def _live(request: web.Request) -> web.StreamResponse:
    """Send the whole state, then what is new; a page that is slow gets fewer messages."""
    pages = request.app[PAGES]
    if len(pages) >= CLIENTS:
        raise web.HTTPServiceUnavailable(text=f"{CLIENTS} pages are open: close one\n")
    page = web.WebSocketResponse(
        timeout=_LEAVE, heartbeat=20.0, max_msg_size=_LARGEST, compress=False
    )
    pages[page] = request.protocol
    try:
        await page.prepare(request)
        sender = asyncio.create_task(_send(page, request.app[STORE]))
        try:
            async for _ in page:  # only to notice that it closes: nothing can be asked for
                await page.close(code=WSCloseCode.POLICY_VIOLATION, message=b"read only")
        finally:
            sender.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await sender
    finally:
        del pages[page]
    return page


async def _send(page: web.WebSocketResponse, store: Store) -> None:
    marks = None
    with contextlib.suppress(ConnectionError, asyncio.TimeoutError):
        while not page.closed:
            state, marks = store.changes(marks)
            await asyncio.wait_for(page.send_str(_to_json(state)), PATIENCE)
            await asyncio.sleep(PERIOD)
        return
    await page.close(code=WSCloseCode.GOING_AWAY)


async def _hang_up(app: web.Application) -> None:
    pages = app[PAGES]
    gone, words = WSCloseCode.GOING_AWAY, b"the dashboard has ended"
    await asyncio.gather(*(page.close(code=gone, message=words) for page in pages))


def _to_json(state: Any) -> str:
    return json.dumps(state, allow_nan=False, separators=(",", ":"))


@contextlib.asynccontextmanager
async def serving(store: Store, port: int) -> AsyncIterator[str]:
    """Serves within the block; gives the address. Port 0: any that is free.

    Raises UserError if the port is taken.
    """
    with socket.socket() as own:
        own.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            own.bind((HOST, port))
        except OSError as error:
            raise UserError(
                f"port {port} cannot be used ({error.strerror}): give another one, or 0 for any"
            ) from None
        port = own.getsockname()[1]
        app = application(store, port)
        runner = web.AppRunner(app, access_log=None, shutdown_timeout=2.0)
        await runner.setup()
        assert runner.server is not None
        pages = app[PAGES]
        accept = _accept(runner.server, pages)
        door = await asyncio.get_running_loop().create_server(accept, sock=own)
        try:
            yield f"http://{HOST}:{port}/"
        finally:
            door.close()
            await runner.cleanup()


def _accept(
    server: web.Server, pages: Mapping[web.WebSocketResponse, asyncio.Protocol]
) -> Callable[[], asyncio.Protocol]:
    """What answers a connection: nothing beyond so many, and for so long unless it is a page."""

    def end(handler: Any) -> None:
        if handler not in pages.values():
            handler.force_close()

    def accept() -> asyncio.Protocol:
        if len(server.connections) >= CONNECTIONS:
            return _Closed()
        handler = server()
        asyncio.get_running_loop().call_later(PATIENCE, end, handler)
        return handler

    return accept


class _Closed(asyncio.Protocol):
    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        transport.close()
