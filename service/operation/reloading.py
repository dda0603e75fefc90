"""Loading changed bundles while the server runs."""

from __future__ import annotations

import asyncio
import logging

from shapespace.service.operation.metrics import Metrics
from shapespace.service.repository.repository import Changes, ModelRepository

logger = logging.getLogger(__name__)
#: Seconds from a request for a reload to its beginning, in which further requests count as the same one.
SETTLE_SECONDS = 0.1


class Reloader:
    """Reloads the models on request, or when their folder changes; one reload at a time."""

    def __init__(self, repository: ModelRepository, metrics: Metrics) -> None:
        self._repository, self._metrics = repository, metrics
        self._lock, self._requested = asyncio.Lock(), False

    async def reload(self) -> None:
        """Load the folder as it is now, while requests go on. Further calls before it begins need no reload more."""
        if self._requested:
            return
        self._requested = True
        await asyncio.sleep(SETTLE_SECONDS)
        async with self._lock:
            self._requested = False
            try:
                changes = await asyncio.to_thread(self._repository.reload)
            except Exception:
                logger.exception("the reload failed, so nothing changes")
                changes = Changes(failed=True)
            self._metrics.reloaded(changes)
            numbers = map(len, (changes.loaded, changes.removed, changes.refused))
            logger.info("reloaded: %d bundles loaded, %d removed, %d refused", *numbers)

    async def watch(self, seconds: float) -> None:
        """Check the folder regularly, and reload once a change is complete: when two checks find the same.

        Checks replace notifications, which network and container file systems do not deliver.
        """
        before = self._repository.seen
        while True:
            await asyncio.sleep(seconds)
            now = await asyncio.to_thread(self._repository.signature)
            if now == before != self._repository.seen:
                await self.reload()
            before = now
