"""Write the Blender extension: `python -m jawusd.plugins jawusd_blender.zip`."""

import sys
from pathlib import Path

from jawusd.plugins.extension import build_extension

if len(sys.argv) != 2 or not sys.argv[1].endswith(".zip"):
    sys.exit("usage: python -m jawusd.plugins FILE.zip")
print(build_extension(Path(sys.argv[1])))
