"""Messages over Zenoh, between processes of one machine unless asked otherwise.

Nothing is searched for on the network and no port is open to it: the loop listens on 127.0.0.1 and
the robot's program connects there.
"""

import json
import time
from collections import deque
from collections.abc import Sequence
from typing import Any

from palpate.errors import PalpateError, extra_module

LISTEN = "tcp/127.0.0.1:7447"
STATE, COMMAND = "palpate/state", "palpate/command"
_KEPT = 64  # messages that nobody has fetched; older ones are dropped


class ZenohLink:
    """One topic in, one topic out.

    Args:
        receive, send: names of the topics.
        listen: endpoint to open, such as `LISTEN`; "" for none.
        connect: endpoint to connect to, again and again until it is there; "" for none.

    Raises:
        PalpateError: Zenoh is not installed, or the endpoint cannot be opened.
    """

    clock = staticmethod(time.perf_counter)

    def __init__(self, receive: str, send: str, listen: str = "", connect: str = ""):
        zenoh = extra_module("zenoh", "zenoh")
        zenoh.init_log_from_env_or("off")  # what goes wrong is raised, not printed
        self.configuration = configuration = zenoh.Config()
        self._received: deque[tuple[float, bytes]] = deque(maxlen=_KEPT)
        try:
            for key, value in (
                ("mode", '"peer"'),
                ("scouting/multicast/enabled", "false"),
                ("scouting/gossip/enabled", "false"),
                ("listen/endpoints", json.dumps([listen] if listen else [])),
                ("connect/endpoints", json.dumps([connect] if connect else [])),
                ("connect/exit_on_failure", "false"),
                ("connect/timeout_ms", "-1"),
                ("connect/retry", '{"period_init_ms": 50, "period_max_ms": 200}'),
            ):
                configuration.insert_json5(key, value)
            self._session = zenoh.open(configuration)
        except zenoh.ZError as error:
            verb = "listen at" if listen else "connect to"
            raise PalpateError(
                f"cannot {verb} {listen or connect}: expected a free address, such as {LISTEN}"
            ) from error
        self._publisher = self._session.declare_publisher(
            send,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME,
            express=True,
        )
        self._subscriber = self._session.declare_subscriber(receive, self._keep)

    def __enter__(self) -> "ZenohLink":
        return self

    def __exit__(self, *error: Any) -> None:
        self._session.close()

    def _keep(self, sample: Any) -> None:  # called on a thread of Zenoh's
        self._received.append((self.clock(), bytes(sample.payload)))

    def arrivals(self) -> Sequence[tuple[float, bytes]]:
        """What came since the last call, as (s on `clock`, message), oldest first."""
        received, found = self._received, []
        while received:
            found.append(received.popleft())
        return found

    def send(self, data: bytes) -> None:
        """Publish; dropped if the peer cannot keep up, which sequence numbers will show."""
        self._publisher.put(data)
