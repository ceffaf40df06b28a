"""The same topics for Foxglove, by its own SDK: messages are passed on as they came over DDS."""

from typing import Any

from rov_ident.bags import definition
from rov_ident.dashboard.server import HOST
from rov_ident.errors import UserError


class Foxglove:
    """A server for Foxglove on this computer; it takes nothing from who connects.

    Raises
    ------
    UserError
        If foxglove-sdk is not installed, or the port is taken.
    """

    def __init__(self, port: int) -> None:
        try:
            import foxglove
        except ImportError as error:
            raise UserError("for Foxglove install its SDK: pip install foxglove-sdk") from error
        self._context = foxglove.Context()
        self._channels: dict[str, Any] = {}
        try:
            self._server = foxglove.start_server(
                name="rov_ident", host=HOST, port=port, context=self._context
            )
        except (OSError, RuntimeError) as error:
            raise UserError(
                f"port {port} cannot be used ({error}): give another one, or 0 for any"
            ) from error

    @property
    def address(self) -> str:
        return f"ws://{HOST}:{self._server.port}"

    def forward(self, topic: str, type_name: str, data: bytes, now: int) -> None:
        """One message in CDR, received at ``now`` [ns]."""
        channel = self._channels.get(topic)
        if channel is None:
            import foxglove

            text, _ = definition(type_name)
            schema = foxglove.Schema(name=type_name, encoding="ros2msg", data=text.encode())
            channel = foxglove.Channel(
                topic, schema=schema, message_encoding="cdr", context=self._context
            )
            self._channels[topic] = channel
        channel.log(data, log_time=now)

    def close(self) -> None:
        self._server.stop()
