# The names of jawusd that the extension uses. `jawusd.plugins.extension` turns this stub into a module of the zip, and
# adds the modules that it imports.

from jawusd.base.arrays import Array as Array
from jawusd.base.errors import JawusdError as JawusdError
from jawusd.base.errors import naming_file as naming_file
from jawusd.evaluator import JawRig as JawRig
from jawusd.geometry.se3 import transform_point as transform_point
from jawusd.geometry.so3 import continuous_wxyz as continuous_wxyz
from jawusd.geometry.so3 import wxyz_from_matrix as wxyz_from_matrix
from jawusd.plugins.jawusd_reader import LABELS as LABELS
from jawusd.plugins.jawusd_reader import PARAMETERS as PARAMETERS
from jawusd.plugins.jawusd_reader import find_blender_pxr as find_blender_pxr
