from jawusd.plugins.jawusd_reader import LABELS as LABELS
from jawusd.plugins.jawusd_reader import PARAMETERS as PARAMETERS
from jawusd.plugins.jawusd_reader import Rig as Rig
from jawusd.plugins.jawusd_reader import decompose as decompose
from jawusd.plugins.jawusd_reader import find_blender_pxr as find_blender_pxr
from jawusd.plugins.jawusd_reader import find_rigs as find_rigs
from jawusd.plugins.jawusd_reader import from_json as from_json
from jawusd.plugins.jawusd_reader import from_prim as from_prim
