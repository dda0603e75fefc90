"""The order in which work gets a thread: every client in turn, and some threads for short work only."""

from __future__ import annotations

import asyncio
from collections import Counter
from dataclasses import dataclass


@dataclass(frozen=True, eq=False)
class Turn:
    """One piece of work that waits for a thread, or has one: ``begun`` is done when it may begin."""

    client: str
    long: bool
    begun: asyncio.Future[None]


class Turns:
    """Turns for work of two kinds on ``threads`` threads, two at least; for the event loop only.

    At most half of the threads run long work, so that short work always finds the others. The next turn goes to the
    client with the fewest running turns, and among equals to the client that has waited longest for one. So a client
    with many requests holds at most half of what others wait for, as soon as its running work ends.
    """

    def __init__(self, threads: int) -> None:
        self.threads, self.long = threads, threads // 2
        #: Turns that wait, by client. The client whose turn ended last is the last.
        self._waiting: dict[str, list[Turn]] = {}
        self._running: set[Turn] = set()

    def ask(self, client: str, long: bool) -> Turn:
        """Return a turn that begins once there is a thread for it. `end` has to follow in any case."""
        turn = Turn(client, long, asyncio.get_running_loop().create_future())
        self._waiting.setdefault(client, []).append(turn)
        self._go_on()
        return turn

    def end(self, turn: Turn) -> None:
        """End a turn, whether it has begun or not."""
        if turn in self._running:
            self._running.remove(turn)
            if waiting := self._waiting.pop(turn.client, None):
                self._waiting[turn.client] = waiting
        else:
            self._take(turn)
        self._go_on()

    def _go_on(self) -> None:
        while turn := self._next():
            self._take(turn)
            self._running.add(turn)
            if not turn.begun.done():
                turn.begun.set_result(None)

    def _next(self) -> Turn | None:
        if len(self._running) == self.threads:
            return None
        full = sum(turn.long for turn in self._running) == self.long
        held = Counter(turn.client for turn in self._running)
        first = (next((turn for turn in turns if not (full and turn.long)), None) for turns in self._waiting.values())
        return min(filter(None, first), key=lambda turn: held[turn.client], default=None)

    def _take(self, turn: Turn) -> None:
        waiting = self._waiting[turn.client]
        waiting.remove(turn)
        if not waiting:
            del self._waiting[turn.client]
