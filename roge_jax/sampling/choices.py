"""How much of the full model a run uses: what a plan chooses, and what it means for the windows of a path."""

import dataclasses
from typing import Literal, Protocol

from ..errors import UserError
from ..geometry.packing import GROUP

Span = tuple[int, int]  # frames of the path [first, last)


@dataclasses.dataclass(frozen=True)
class Choices:
    """How much of the full model a run uses; `planning.plan` makes them."""

    photos: tuple[int, ...]  # positions among the photos given; the first one is the world frame
    steps: int
    solver: str
    schedule: str
    recon: tuple[int, int]  # height, width at which the reconstruction sees photos and rays
    merge: Literal[1, 2, 4]  # `RendererConfig.merge`
    # Per window, the frames that are generated; None: none. All others are the RGB head's picture.
    generate: tuple[Span | None, ...]
    frames: int  # generated together: the model's window, or 1 + 4k fewer; shorter spans are padded to it

    @property
    def generated(self) -> int:
        """How many frames of the path are generated."""
        return sum(span[1] - span[0] for span in self.generate if span)


class Planned(Protocol):
    """What `sampling.sample` reads of a plan: `planning.plan.Plan` is one."""

    @property
    def choices(self) -> Choices: ...

    @property
    def ids(self) -> tuple[int, ...]:
        """The views of the scene, in the order of the photos, that it was made for."""
        ...


def spans(plan: Planned | None, windows: list[Span], length: int) -> tuple[list[Span], int]:
    """(the frames that are generated in each window of `length`, of none an empty span at its start; how many together).

    Raises: UserError for a plan of another path.
    """
    if plan is None:
        return windows, length
    generate, length = plan.choices.generate, plan.choices.frames
    if len(generate) != len(windows):
        raise UserError(
            f"The plan is for {len(generate)} chunks and this path has {len(windows)}: plan again for this path."
        )
    found = [span or (start, start) for span, (start, _) in zip(generate, windows)]
    for (first, last), (start, stop) in zip(found, windows, strict=True):
        whole = min(stop, first + length)  # as far as a stretch goes that begins there
        if not start <= first <= last or last not in (first, whole) or (first - start) % GROUP:
            raise UserError(
                f"The plan generates frames {first} to {last - 1}, {length} at a time, in a chunk of the frames "
                f"{start} to {stop - 1}: plan again for this path."
            )
    return found, length


def around(window: Span, span: Span) -> list[Span]:
    """What lies in a window before and after a span; nothing empty."""
    return [(a, b) for a, b in ((window[0], span[0]), (span[1], window[1])) if a < b]
