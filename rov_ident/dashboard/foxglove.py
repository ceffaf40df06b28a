"""The same topics for Foxglove, by its own SDK: messages are passed on as they came over DDS.

The SDK's server answers whoever connects, so any page that a browser has open could read it. It
listens at an address within 127.0.0.0/8 that nobody is told; what is told is a door in front of it
that looks at Host and Origin.
"""

import asyncio
import contextlib
import secrets
from collections.abc import AsyncIterator
from typing import Any
from urllib.parse import urlsplit

import aiohttp
from aiohttp import web

from rov_ident.bags import definition
from rov_ident.dashboard.server import HOST, NAMES, guard, listening
from rov_ident.errors import UserError

_HOME = "foxglove.dev"
_PATIENCE = 10.0  # s; for a client to take a message
_LEAVE = 0.5  # s; for a client to answer that it is closed
_NO_PROTOCOL = "for programs that speak foxglove.sdk.v1: Foxglove of 2025 or later\n"


class Foxglove:
    """A server of the SDK that takes nothing from who connects.

    Raises
    ------
    UserError
        If foxglove-sdk is not installed.
    """

    def __init__(self) -> None:
        try:
            import foxglove
        except ImportError as error:
            raise UserError("for Foxglove install its SDK: pip install foxglove-sdk") from error
        self._sdk = foxglove
        self._context = foxglove.Context()
        self._channels: dict[str, Any] = {}
        self._hidden = ".".join(["127", *(str(1 + secrets.randbelow(254)) for _ in range(3))])
        self._server = foxglove.start_server(
            name="rov_ident", host=self._hidden, port=0, context=self._context
        )
        self.address = ""  # of the door

    def forward(self, topic: str, type_name: str, data: bytes, now: int) -> None:
        """One message in CDR, received at ``now`` [ns]."""
        channel = self._channels.get(topic)
        if channel is None:
            text, _ = definition(type_name)
            schema = self._sdk.Schema(name=type_name, encoding="ros2msg", data=text.encode())
            channel = self._sdk.Channel(
                topic, schema=schema, message_encoding="cdr", context=self._context
            )
            self._channels[topic] = channel
        channel.log(data, log_time=now)

    def close(self) -> None:
        self._server.stop()

    def door(self, port: int) -> web.Application:
        """Lets Foxglove in, from its site or from this computer, and passes everything on."""
        app = web.Application(middlewares=[guard(port, may_read, cross_site=True)])
        app.router.add_get("/", self._pass_on, allow_head=False)
        return app

    async def _pass_on(self, request: web.Request) -> web.StreamResponse:
        asked = request.headers.get("Sec-WebSocket-Protocol", "")
        protocols = [name.strip() for name in asked.split(",") if name.strip()]
        inside = f"ws://{self._hidden}:{self._server.port}"
        async with contextlib.AsyncExitStack() as stack:
            session = await stack.enter_async_context(aiohttp.ClientSession())
            try:
                connection = session.ws_connect(inside, protocols=protocols, max_msg_size=0)
                server = await stack.enter_async_context(connection)
            except aiohttp.WSServerHandshakeError as error:
                raise web.HTTPBadRequest(text=_NO_PROTOCOL) from error
            chosen = [server.protocol] if server.protocol else []
            client = web.WebSocketResponse(timeout=_LEAVE, protocols=chosen, compress=False)
            await client.prepare(request)
            ways = [
                asyncio.create_task(_pump(server, client)),
                asyncio.create_task(_pump(client, server)),
            ]
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            for way in ways:
                way.cancel()
            await asyncio.gather(*ways, return_exceptions=True)
            await client.close()
        return client


async def _pump(source: Any, sink: Any) -> None:
    """Messages from one web socket to another until either is closed."""
    with contextlib.suppress(ConnectionError, asyncio.TimeoutError):
        async for message in source:
            if message.type == aiohttp.WSMsgType.BINARY:
                await asyncio.wait_for(sink.send_bytes(message.data), _PATIENCE)
            elif message.type == aiohttp.WSMsgType.TEXT:
                await asyncio.wait_for(sink.send_str(message.data), _PATIENCE)


def may_read(origin: str) -> bool:
    """Foxglove's site, a program of this computer, or a page that this computer serves."""
    parts = urlsplit(origin)
    home = f".{parts.hostname}".endswith(f".{_HOME}") and parts.scheme == "https"
    here = parts.hostname in NAMES and parts.scheme == "http"
    return home or here or origin == "file://"


@contextlib.asynccontextmanager
async def serving(port: int) -> AsyncIterator[Foxglove]:
    """Serves Foxglove within the block. Port 0: any that is free.

    Raises
    ------
    UserError
        If foxglove-sdk is not installed, or the port is taken.
    """
    foxglove = Foxglove()
    try:
        async with listening(foxglove.door, port) as port:
            foxglove.address = f"ws://{HOST}:{port}"
            yield foxglove
    finally:
        foxglove.close()
