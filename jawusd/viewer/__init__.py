"""The browser viewer: see a jaw rig move, drag it, key it; see a capture's footage with its poses, set its picks.

`session`, `keytrack`, `clip`, `readouts`, `plots`, `decimate`, `picks`, `light_table` and `coverage` know nothing of
the browser; the other modules are the pages, drawn with viser.
"""
