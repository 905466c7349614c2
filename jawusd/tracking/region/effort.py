"""Computational effort of the rig tracker per frame, for recorded and for live images."""

from __future__ import annotations

from dataclasses import dataclass

_Gates = tuple[float, ...]


@dataclass(frozen=True)
class Effort:
    """Steps of an alignment, conditions for starting searches, and sizes of searches.

    Attributes:
        gates_px: residual gates of the steps of an alignment that starts from the prediction.
        next_px: residual gates after one dropped frame.
        far_px: residual gates after several dropped frames.
        wide_px: residual gates for other starts and at the end of a search; None to use the gates for the prediction.
        uncertain, searched: fractions of the usual matched contour below which other starts are tried, and below which
            a search starts, provided that hardly any frames were dropped.
        jaws, finalists, heads: numbers of jaw poses tried by a search, of jaw poses aligned fully, and of head poses
            tried.
        search_every: interval between searches, in failed frames.
        searches: number of failed frames after which teeth count as not visible.
        later_every: like `search_every`, once teeth count as not visible.
        in_turn: whether jaw and head are searched for in different frames once teeth count as not visible, to limit the
            time per frame.
        learn_every: interval between updates of the colours, in frames.
    """

    gates_px: _Gates
    next_px: _Gates
    far_px: _Gates
    wide_px: _Gates | None
    uncertain: float
    searched: float
    jaws: int
    finalists: int
    heads: int
    search_every: int
    searches: int
    later_every: int
    in_turn: bool
    learn_every: int


#: Residual gates of an alignment that starts from the prediction, and of one that starts from a more distant pose [px].
NEAR_GATES_PX, FAR_GATES_PX = (6.0, 4.0, 3.0, 2.5, 2.0), (12.0, 8.0, 6.0, 4.0, 3.0, 2.5, 2.0)

#: Effort for recorded images.
THOROUGH = Effort(
    gates_px=NEAR_GATES_PX,
    next_px=NEAR_GATES_PX,
    far_px=NEAR_GATES_PX,
    wide_px=FAR_GATES_PX,
    uncertain=0.8,
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
#: Effort for live images. Since frames are dropped during a search, searches are less frequent than for recorded
#: images.
FAST = Effort(
    gates_px=(8.0, 3.0, 2.0),
    next_px=(16.0, 6.0, 2.5, 2.0),
    far_px=(24.0, 14.0, 8.0, 4.0, 2.0),
    wide_px=None,
    uncertain=0.6,
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
