"""The search for effects that the model lacks, in a thread beside a live estimator."""

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from rov_ident.core.jit import Compiler
from rov_ident.estimation.online import OnlineEstimator

_LOADING_TIME = 5.0
"""s; that a player waits for the monitor at most. A compiled one is loaded in a second; for another
to be compiled a player should not wait. No estimate depends on it."""


class ModelMonitor:
    """Attaches a monitor to an estimator once its kernels are compiled, and lends it a thread."""

    def __init__(self, online: OnlineEstimator, log: Any) -> None:
        self._online, self._log = online, log
        self._thread = ThreadPoolExecutor(1, "monitor")
        self._leaving = threading.Event()
        self._compiler: Compiler | None = None

    def begin(self) -> "Future[Any]":
        """Load the monitor in its thread, and have it compiled first if need be.

        Another process compiles: a thread of this one would hold up samples.
        """
        return self._submit(self._load)

    def wait_for_loading(self, begun: "Future[Any]", interrupted: threading.Event) -> None:
        """Until the monitor is loaded, but not for long."""
        until = time.monotonic() + _LOADING_TIME
        while not begun.done() and time.monotonic() < until and not interrupted.wait(0.01):
            pass

    def _load(self) -> None:
        from rov_ident.discrepancy import monitor  # here: the first estimates do not need it

        self._compiler = monitor.compiler()
        if self._leaving.is_set():
            self._compiler.stop()
        # Without it, for want of memory say, estimating goes on.
        if self._compiler.ensure():
            self._compiler.load()
            self._online.attach(monitor.Monitor(self._online.config, self._submit))

    def _submit(self, function: Callable[..., object], *arguments: object) -> "Future[Any]":
        job = self._thread.submit(function, *arguments)
        job.add_done_callback(self._log_failure)
        return job

    def _log_failure(self, job: "Future[Any]") -> None:
        if not job.cancelled() and (error := job.exception()):
            self._log.error(f"the search for what the model lacks failed: {error!r}")

    def finish(self) -> None:
        """Wait until it has looked at all that it was given."""
        if self._online.monitor is not None:
            self._thread.submit(int).result()

    def stop(self) -> None:
        """End it, compiling included: a process does not end before its threads do."""
        self._leaving.set()
        self._thread.shutdown(wait=False, cancel_futures=True)
        if self._compiler is not None:
            self._compiler.stop()
