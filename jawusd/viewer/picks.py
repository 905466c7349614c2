"""The picks one visitor makes: vertices of the scans with the pixels where cameras see them."""

from __future__ import annotations

from dataclasses import dataclass, field

from jawusd.formats.capture import Bootstrap, Pick, PickView

ROWS = ("upper", "lower")
_FEWEST, _FEWEST_VIEWS = 3, 2


@dataclass
class PickDraft:
    """Hold a pick that may still lack views.

    Attributes:
        row: "upper" or "lower".
        vertex: of its scan.
        views: pixel (x, y) by camera.
    """

    row: str
    vertex: int
    views: dict[str, tuple[float, float]] = field(default_factory=dict)


class PickBook:
    """Collect the picks of one frame.

    Attributes:
        picks: the picks, in the order they were made.
        frame: the frame of the reference camera that all pixels belong to; None before the first.
        selected: number of the pick whose pixel the next click in a picture sets; None without picks.
    """

    def __init__(self, given: Bootstrap | None = None) -> None:
        """Start with the picks of a capture."""
        self.picks: list[PickDraft] = []
        self.frame: int | None = None
        self.selected: int | None = None
        if given is not None:
            self.frame = given.frame
            for row in ROWS:
                for pick in getattr(given, row):
                    self.picks.append(PickDraft(row, pick.vertex, {v.camera: (v.x, v.y) for v in pick.views}))

    def name(self, number: int) -> str:
        """Return what a pick is called: U1, U2 .. on the upper row, L1 .. on the lower, as trackers count them."""
        row = self.picks[number].row
        return f"{row[0].upper()}{sum(pick.row == row for pick in self.picks[: number + 1])}"

    def add(self, row: str, vertex: int) -> None:
        """Begin a pick at a vertex, and select it; one that is there already is only selected."""
        same = [k for k, pick in enumerate(self.picks) if (pick.row, pick.vertex) == (row, vertex)]
        if not same:
            self.picks.append(PickDraft(row, vertex))
        self.selected = same[0] if same else len(self.picks) - 1

    def see(self, camera: str, frame: int, pixel: tuple[float, float]) -> None:
        """Say where the selected pick is seen, and select the next one that this camera has not seen.

        Args:
            camera: its name.
            frame: of the reference camera.
            pixel: x and y in the recorded picture [px].

        Raises:
            ValueError: no pick is selected, or the pixels of the others belong to another frame.
        """
        if self.selected is None:
            raise ValueError("no pick is selected: click a vertex of a scan first, or choose a pick in the list")
        others = any(pick.views for k, pick in enumerate(self.picks) if k != self.selected)
        if self.frame is not None and frame != self.frame and others:
            raise ValueError(
                f'the picks belong to frame {self.frame}, this is frame {frame}: press "their frame", or "clear" them'
            )
        pick = self.picks[self.selected]
        if frame != self.frame:
            pick.views.clear()
        self.frame = frame
        pick.views[camera] = pixel
        rest = [*range(self.selected + 1, len(self.picks)), *range(self.selected)]
        self.selected = next((k for k in rest if camera not in self.picks[k].views), self.selected)

    def turn_to(self, camera: str) -> None:
        """Select the first pick that a camera has not seen, if there is one."""
        self.selected = next((k for k, pick in enumerate(self.picks) if camera not in pick.views), self.selected)

    def forget_view(self, camera: str) -> None:
        """Take the selected pick's pixel in a camera away."""
        if self.selected is not None:
            self.picks[self.selected].views.pop(camera, None)

    def remove(self) -> None:
        """Delete the selected pick."""
        if self.selected is None:
            return
        del self.picks[self.selected]
        self.selected = min(self.selected, len(self.picks) - 1) if self.picks else None
        if not any(pick.views for pick in self.picks):
            self.frame = None

    def clear(self) -> None:
        """Delete all picks."""
        self.picks, self.frame, self.selected = [], None, None

    def lacks(self) -> str:
        """Say in a few words what is missing before the picks can be written; "" when nothing is."""
        for row in ROWS:
            whole = sum(len(pick.views) >= _FEWEST_VIEWS for pick in self.picks if pick.row == row)
            if whole < _FEWEST:
                return f"{row} teeth: {whole} picks in {_FEWEST_VIEWS} cameras, at least {_FEWEST} are needed"
        for number, pick in enumerate(self.picks):
            if len(pick.views) < _FEWEST_VIEWS:
                return f"{self.name(number)} is seen by {len(pick.views)} camera, {_FEWEST_VIEWS} are needed"
        return ""

    def bootstrap(self) -> Bootstrap:
        """Return the picks as a capture holds them.

        Raises:
            ValueError: something is missing; see `lacks`.
        """
        lacking = self.lacks()
        if lacking or self.frame is None:
            raise ValueError(f"{lacking}: the picks cannot be written yet")
        rows = {row: tuple(_finished(pick) for pick in self.picks if pick.row == row) for row in ROWS}
        return Bootstrap(frame=self.frame, **rows)


def _finished(pick: PickDraft) -> Pick:
    views = tuple(PickView(camera=name, x=round(x, 2), y=round(y, 2)) for name, (x, y) in pick.views.items())
    return Pick(vertex=pick.vertex, views=views)
