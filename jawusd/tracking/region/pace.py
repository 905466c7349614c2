"""How much work a tracker of pictures puts into one instant."""

from __future__ import annotations

from dataclasses import dataclass

_Gates = tuple[float, ...]


@dataclass(frozen=True)
class Pace:
    """Say how many steps are taken, and when what is searched.

    Attributes:
        gates_px: residual gate of every step from the prediction.
        next_px: the same after a frame that was left out.
        far_px: the same after more of them.
        wide_px: from other starts, and at the end of a search; None takes the gates of the prediction again.
        doubted, searched: shares of the usual contour that fits, below which other starts are tried, and poses
            searched, while hardly any frames were left out.
        jaws, finalists, heads: poses of the jaw and of the head that a search tries, and jaws followed to the end.
        search_every: failed frames per search.
        searches: failed frames after which teeth count as out of sight.
        later_every: failed frames per search then.
        in_turn: then search the jaw in one frame and the head in a later one, so that no frame waits long.
        learn_every: frames after which colours are taken up.
    """

    gates_px: _Gates
    next_px: _Gates
    far_px: _Gates
    wide_px: _Gates | None
    doubted: float
    searched: float
    jaws: int
    finalists: int
    heads: int
    search_every: int
    searches: int
    later_every: int
    in_turn: bool
    learn_every: int


#: For recorded pictures.
THOROUGH = Pace(
    gates_px=(6.0, 4.0, 3.0, 2.5, 2.0),
    next_px=(6.0, 4.0, 3.0, 2.5, 2.0),
    far_px=(6.0, 4.0, 3.0, 2.5, 2.0),
    wide_px=(12.0, 8.0, 6.0, 4.0, 3.0, 2.5, 2.0),
    doubted=0.8,
    searched=0.6,
    jaws=16,
    finalists=3,
    heads=12,
    search_every=1,
    searches=8,
    later_every=8,
    in_turn=False,
    learn_every=1,
)
#: For pictures that wait for nobody. Searches cost what passes meanwhile, so they begin later.
BRIEF = Pace(
    gates_px=(8.0, 3.0, 2.0),
    next_px=(16.0, 6.0, 2.5, 2.0),
    far_px=(24.0, 14.0, 8.0, 4.0, 2.0),
    wide_px=None,
    doubted=0.6,
    searched=0.4,
    jaws=4,
    finalists=1,
    heads=3,
    search_every=2,
    searches=4,
    later_every=6,
    in_turn=True,
    learn_every=6,
)
