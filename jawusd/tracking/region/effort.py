"""Computational effort of the rig tracker per frame, for recorded and for live images."""

from __future__ import annotations

from dataclasses import dataclass

_Gates = tuple[float, ...]


@dataclass(frozen=True)
class Effort:
    """Steps of an alignment, conditions for starting searches, and sizes of searches."""

    gates_px: _Gates  # residual gates of the steps of an alignment that starts from the prediction
    next_px: _Gates  # residual gates after one dropped frame
    far_px: _Gates  # residual gates after several dropped frames
    wide_px: _Gates | None  # residual gates for other starts and at the end of a search; None: `gates_px`
    uncertain: float  # fraction of the usual matched contour below which other starts are tried
    searched: float  # fraction below which a search starts, provided that hardly any frames were dropped
    jaws: int  # number of jaw poses tried by a search
    finalists: int  # number of jaw poses aligned fully
    heads: int  # number of head poses tried
    search_every: int  # interval between searches, in failed frames
    searches: int  # number of failed frames after which teeth count as not visible
    later_every: int  # like `search_every`, once teeth count as not visible
    in_turn: bool  # whether jaw and head are then searched for in different frames, to limit the time per frame
    learn_every: int  # interval between updates of the colours, in frames


#: Residual gates of an alignment that starts from the prediction, and of one that starts from a more distant pose [px].
NEAR_GATES_PX, FAR_GATES_PX = (6.0, 4.0, 3.0, 2.5, 2.0), (12.0, 8.0, 6.0, 4.0, 3.0, 2.5, 2.0)

#: Residual gates of the short alignments by which a search compares starts [px].
TRIAL_GATES_PX = (8.0, 6.0)

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
#: Effort for live images; searches are less frequent, since frames are dropped during a search.
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
