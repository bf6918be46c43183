"""Who gets the next picture, and how fine: the newest pose wins, and whoever stands still is shown finer ones.

No threads and no clock in here: the caller says what time it is.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

SETTLED = (
    0.0,
    0.25,
    0.8,
)  # seconds that a camera has to stand still for each level above that of moving
WINDOW = 2.0  # seconds that the frame rate is taken over


@dataclasses.dataclass(frozen=True)
class Task:
    """A picture to make: whose, of what, at which level; `number` tells poses of one viewer apart."""

    who: Any
    camera: Any
    level: int
    number: int


@dataclasses.dataclass
class _Seat:
    camera: Any
    since: float  # when this camera came
    number: int = 0
    shown: int = -1  # the finest level at which this camera was shown
    served: float = float("-inf")
    times: tuple[float, ...] = ()


class Desk:
    """Viewers and what they look at."""

    def __init__(self):
        self.seats: dict[Any, _Seat] = {}

    def ask(self, who: Any, camera: Any, now: float) -> None:
        """A viewer's camera is here; what it was before is of no interest any more."""
        seat = self.seats.get(who)
        if seat is None:
            self.seats[who] = _Seat(camera, now)
            return
        seat.camera, seat.since, seat.shown = camera, now, -1
        seat.number += 1

    def leave(self, who: Any) -> None:
        """A viewer is gone."""
        self.seats.pop(who, None)

    def next(self, moving: int, ready: Sequence[bool], now: float) -> Task | None:
        """What to make now: new poses first, whose viewer waited longest; then finer pictures for those who stand still."""
        fresh = [who for who, seat in self.seats.items() if seat.shown < 0]
        if fresh:
            who = min(fresh, key=lambda who: self.seats[who].served)
            return self._task(who, moving)
        due = [(level, who) for level, who in self._due(moving, len(ready), now) if ready[level]]
        if not due:
            return None
        level, who = min(due, key=lambda found: (found[0], self.seats[found[1]].served))
        return self._task(who, level)

    def wanted(self, moving: int, ready: Sequence[bool], now: float) -> int | None:
        """A level that somebody stands still for and that is not ready."""
        due = self._due(moving, len(ready), now)
        return min((level for level, _ in due if not ready[level]), default=None)

    def made(self, task: Task, now: float) -> bool:
        """A picture was made. False if its viewer is gone; it counts for the newest pose only if it shows that one."""
        seat = self.seats.get(task.who)
        if seat is None:
            return False
        seat.served = now
        seat.times = (*(t for t in seat.times if now - t <= WINDOW), now)
        if seat.number == task.number:
            seat.shown = max(seat.shown, task.level)
        return True

    def rate(self, who: Any, now: float) -> float:
        """Pictures a second that a viewer got lately; 0 for fewer than two."""
        times = [t for t in self.seats[who].times if now - t <= WINDOW] if who in self.seats else []
        span = times[-1] - times[0] if len(times) > 1 else 0.0
        return (len(times) - 1) / span if span > 0 else 0.0

    def _task(self, who: Any, level: int) -> Task:
        seat = self.seats[who]
        return Task(who, seat.camera, level, seat.number)

    def _due(self, moving: int, count: int, now: float) -> list[tuple[int, Any]]:
        """(next finer level of `count`, whose) for all cameras that have stood still long enough for it."""
        found = []
        for who, seat in self.seats.items():
            level = seat.shown + 1
            wait = SETTLED[min(max(level - moving, 0), len(SETTLED) - 1)]
            if 0 < level < count and now - seat.since >= wait:
                found.append((level, who))
        return found
