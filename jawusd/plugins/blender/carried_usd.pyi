# As `carried`: what needs pxr, which is not there before the add-on has registered.

from jawusd.rig.animation import write_animation as write_animation
from jawusd.rig.read import rig_of as rig_of
