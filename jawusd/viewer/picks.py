"""The picks of one visitor: vertices of the scans with their pixels in the cameras."""

from __future__ import annotations

from dataclasses import dataclass, field

from jawusd.formats.capture import Bootstrap, Pick, PickView

ARCHES = ("upper", "lower")
_FEWEST, _FEWEST_VIEWS = 3, 2


@dataclass
class PickDraft:
    """Hold a pick that may still lack views: a vertex of an arch's scan, its pixel (x, y) by camera."""

    arch: str
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
            for arch in ARCHES:
                for pick in getattr(given, arch):
                    self.picks.append(PickDraft(arch, pick.vertex, {v.camera: (v.x, v.y) for v in pick.views}))

    def name(self, number: int) -> str:
        """Return the name of a pick: U1, U2 .. on the upper arch, L1 .. on the lower, numbered as in tracking."""
        arch = self.picks[number].arch
        return f"{arch[0].upper()}{sum(pick.arch == arch for pick in self.picks[: number + 1])}"

    def add(self, arch: str, vertex: int) -> None:
        """Select the pick at a vertex, adding it if there is none."""
        same = [k for k, pick in enumerate(self.picks) if (pick.arch, pick.vertex) == (arch, vertex)]
        if not same:
            self.picks.append(PickDraft(arch, vertex))
        self.selected = same[0] if same else len(self.picks) - 1

    def see(self, camera: str, frame: int, pixel: tuple[float, float]) -> None:
        """Set the selected pick's pixel (x, y) in a camera, and select the next pick without one in this camera.

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
        """Select the first pick without a pixel in a camera, if there is one."""
        self.selected = next((k for k, pick in enumerate(self.picks) if camera not in pick.views), self.selected)

    def forget_view(self, camera: str) -> None:
        """Remove the selected pick's pixel in a camera."""
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
        """Return a few words about what is missing before the picks can be written; "" when nothing is."""
        for arch in ARCHES:
            whole = sum(len(pick.views) >= _FEWEST_VIEWS for pick in self.picks if pick.arch == arch)
            if whole < _FEWEST:
                return f"{arch} teeth: {whole} picks in {_FEWEST_VIEWS} cameras, at least {_FEWEST} are needed"
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
        upper, lower = (tuple(_finished(pick) for pick in self.picks if pick.arch == arch) for arch in ARCHES)
        return Bootstrap(frame=self.frame, upper=upper, lower=lower)


def _finished(pick: PickDraft) -> Pick:
    views = tuple(PickView(camera=name, x=round(x, 2), y=round(y, 2)) for name, (x, y) in pick.views.items())
    return Pick(vertex=pick.vertex, views=views)
