# Like `vendored`, for modules that import pxr, which is unavailable until the add-on is registered.

from jawusd.rig.animation import write_animation as write_animation
from jawusd.rig.attributes import key_times as key_times
from jawusd.rig.attributes import values_at as values_at
from jawusd.rig.layout import rig_prims as rig_prims
from jawusd.rig.read import rig_of as rig_of
