# As `carried`: what needs pxr, which is not there before the add-on has registered.

from jawusd.rig.animation import write_animation as write_animation
from jawusd.rig.keys import key_times as key_times
from jawusd.rig.keys import values_at as values_at
from jawusd.rig.read import rig_of as rig_of
from jawusd.rig.schema import rig_prims as rig_prims
