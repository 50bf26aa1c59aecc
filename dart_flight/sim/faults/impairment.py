"""A link that loses, delays, reorders and duplicates messages, such as datagrams, samples and setpoints."""

from __future__ import annotations

import heapq
import random
from typing import Generic, TypeVar

import msgspec

T = TypeVar("T")


class Impairment(msgspec.Struct, frozen=True):
    """The impairment of a link.

    Attributes:
        loss, reorder, duplicate: fractions of the messages that are lost, reordered or duplicated.
        reorder_s: additional delay of a reordered message.
        jitter_s: largest random delay, drawn for each message.
        down: whether the link loses every message.
    """

    loss: float = 0.0
    delay_s: float = 0.0
    reorder: float = 0.0
    reorder_s: float = 0.02
    duplicate: float = 0.0
    jitter_s: float = 0.0
    down: bool = False


class LossyLink(Generic[T]):
    """A queue that applies an impairment to messages; the caller passes seconds on any clock."""

    def __init__(self, seed: int) -> None:
        self.impairment = Impairment()
        self._random = random.Random(seed)
        self._waiting: list[tuple[float, int, T]] = []
        self._number = 0

    def push(self, now_s: float, message: T) -> None:
        impairment, chance = self.impairment, self._random.random
        if impairment.down or (impairment.loss > 0.0 and chance() < impairment.loss):
            return
        copies = 2 if impairment.duplicate > 0.0 and chance() < impairment.duplicate else 1
        for _ in range(copies):
            late_s = impairment.delay_s
            if impairment.reorder > 0.0 and chance() < impairment.reorder:
                late_s += impairment.reorder_s
            if impairment.jitter_s > 0.0:
                late_s += impairment.jitter_s * chance()
            self._number += 1
            heapq.heappush(self._waiting, (now_s + late_s, self._number, message))

    def pop(self, now_s: float) -> list[T]:
        """Return the messages that have arrived by `now_s`, in order of arrival."""
        arrived = []
        while self._waiting and self._waiting[0][0] <= now_s:
            arrived.append(heapq.heappop(self._waiting)[2])
        return arrived
