"""The kernels of a node: compiled, or interpreted until another process has compiled them."""

import gc
import time
from typing import Any

from rov_ident.config import Config
from rov_ident.core.jit import interpret, only_run
from rov_ident.estimation.compilation import compiler, ensure_compiled
from rov_ident.estimation.online import Kind

_RETRY_PERIOD = 60.0
"""s; the least time between two attempts after a failure: what fails for want of memory must not
keep a small computer busy with failing (compiling takes half a minute, docs/speed.md)."""


class CompileState:
    """The compiler of an estimator in the life of its node.

    To be made before the first kernel is called: where nothing is compiled yet, all kernels of this
    process are interpreted from then on.
    """

    def __init__(self, kind: Kind) -> None:
        only_run()
        self._kind = kind
        self._compiler = compiler(kind)
        self._began = time.monotonic()
        self._retry_at = 0.0
        self.interpreting = not self._compiler.compiled
        if self.interpreting:
            interpret()

    def begin(self, config: Config, log: Any, wait: bool) -> None:
        """Load what is compiled; else compile, in the background unless told to ``wait``."""
        if not self.interpreting or wait:
            if self.interpreting:
                log.info("compiling: about half a minute at the first start on a computer")
            ensure_compiled(config, self._kind)
            self.interpreting = False
            return
        log.info(
            "compiling: about half a minute at the first start on a computer; until then kernels "
            "are interpreted and the estimates lag behind"
        )
        self._compiler.start()

    def switched(self, config: Config, log: Any) -> bool:
        """Whether this call has gone over from interpreted to compiled kernels.

        What is learnt and all that is under way stay as they are: both use the same arrays. A
        compiler that fails, for want of memory say, is started again.
        """
        if not self.interpreting or (status := self._compiler.poll()) is None:
            return False
        if status:
            if (now := time.monotonic()) > self._retry_at:
                log.warning(f"compiling failed with status {status}: trying again")
                self._retry_at = now + _RETRY_PERIOD
                self._compiler.start()
            return False
        self.interpreting = False
        self._compiler.load(config)
        settle()
        log.info(f"compiled after {time.monotonic() - self._began:.1f} s")
        return True

    def stop(self) -> None:
        self._compiler.stop()


def settle() -> None:
    """Exempt what is there now from garbage collection, which would hold up samples."""
    gc.collect()
    gc.freeze()
