"""The answers given last, so that asking for one again costs nothing."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Answer:
    """A file as it was answered.

    Attributes:
        content: its bytes.
        headers: those that belong to it, whoever asks.
    """

    content: bytes
    headers: Mapping[str, str]

    @property
    def size(self) -> int:
        """Bytes that keeping it takes, nearly."""
        return len(self.content) + sum(len(name) + len(value) for name, value in self.headers.items()) + 1024


class RecentAnswers:
    """Answers by entity tag, which names all that their bytes depend on, as many of the last ones as fit.

    Touched from the event loop only.

    Args:
        limit: most bytes of all of them together.
    """

    def __init__(self, limit: int) -> None:
        self._limit, self.size = limit, 0
        self._answers: OrderedDict[str, Answer] = OrderedDict()

    def __len__(self) -> int:
        return len(self._answers)

    def get(self, tag: str) -> Answer | None:
        """An answer, if it is still there."""
        if tag in self._answers:
            self._answers.move_to_end(tag)
        return self._answers.get(tag)

    def put(self, tag: str, answer: Answer) -> None:
        """Keep an answer instead of those that nobody has asked for the longest."""
        if old := self._answers.pop(tag, None):
            self.size -= old.size
        if answer.size > self._limit:
            return
        self._answers[tag] = answer
        self.size += answer.size
        while self.size > self._limit:
            self.size -= self._answers.popitem(last=False)[1].size
