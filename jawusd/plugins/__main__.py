"""Write the files that run inside other programs.

python -m jawusd.plugins jawusd_blender.zip    the Blender extension
python -m jawusd.plugins FOLDER                the reader, and recipes for Maya, Houdini and Unreal
"""

import sys
from pathlib import Path

from jawusd.plugins.extension import build_extension, copy_scripts

if len(sys.argv) != 2 or sys.argv[1].startswith("-"):
    sys.exit("usage: python -m jawusd.plugins FILE.zip|FOLDER")
target = Path(sys.argv[1])
if target.suffix == ".zip":
    print(build_extension(target))
else:
    print(*copy_scripts(target), sep="\n")
