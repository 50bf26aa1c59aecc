"""A link that loses, delays, reorders and duplicates: for datagrams, samples and setpoints alike."""

from __future__ import annotations

import heapq
import random
from typing import Generic, TypeVar

import msgspec

T = TypeVar("T")


class Impairment(msgspec.Struct, frozen=True):
    """What is wrong with a link.

    Attributes:
        loss, reorder, duplicate: share of the messages that it befalls, 0 to 1.
        delay_s: every message comes this much later.
        reorder_s: how much later than the others a reordered message comes.
        jitter_s: every message comes up to this much later, each its own.
        down: nothing comes through.
    """

    loss: float = 0.0
    delay_s: float = 0.0
    reorder: float = 0.0
    reorder_s: float = 0.02
    duplicate: float = 0.0
    jitter_s: float = 0.0
    down: bool = False


class LossyLink(Generic[T]):
    """Messages in, messages out when they are due; the caller brings the time, any clock, seconds."""

    def __init__(self, seed: int) -> None:
        self.impairment = Impairment()
        self._random = random.Random(seed)
        self._waiting: list[tuple[float, int, T]] = []
        self._number = 0

    def push(self, now_s: float, message: T) -> None:
        """A message enters the link."""
        is_, chance = self.impairment, self._random.random
        if is_.down or (is_.loss > 0.0 and chance() < is_.loss):
            return
        copies = 2 if is_.duplicate > 0.0 and chance() < is_.duplicate else 1
        for _ in range(copies):
            late_s = is_.delay_s
            if is_.reorder > 0.0 and chance() < is_.reorder:
                late_s += is_.reorder_s
            if is_.jitter_s > 0.0:
                late_s += is_.jitter_s * chance()
            self._number += 1
            heapq.heappush(self._waiting, (now_s + late_s, self._number, message))

    def pop(self, now_s: float) -> list[T]:
        """What has arrived by now, in order of arrival."""
        arrived = []
        while self._waiting and self._waiting[0][0] <= now_s:
            arrived.append(heapq.heappop(self._waiting)[2])
        return arrived
