"""The browser viewer: pose, drag and key a jaw rig, or inspect the footage and poses of a capture and set its picks.

`session`, `motion`, `readouts`, `plots`, `viewed` and `picking` do not depend on viser; `scene`, the
panels, the pages and `server` do. The viewer does not import other stages: the functions that it calls are passed in
through `viewed`.
"""
